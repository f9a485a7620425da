"""A submission holds, or what was edited in it is named; other items or panels are not ranked together."""

from __future__ import annotations

import hashlib
import io
import json
import re
import time
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.build.errors import raises
from tests.conftest import SMALL, Checkout
from tests.providers.server import Provider
from traps_pipeline.base.archives import unzip_bytes
from traps_pipeline.base.archives import zip_bytes as zipped
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.judging.verdicts import verdicts_of
from traps_pipeline.models.registry.judges import BY_RULES, RULES_VERSION
from traps_pipeline.release.content import content_of
from traps_pipeline.release.folder import Options, write_release
from traps_pipeline.release.released_rows import SUBMITTED
from traps_pipeline.release.submission import (
    ABOUT,
    MAX_TABLE_BYTES,
    MAX_TEXT_BYTES,
    TABLES,
    pack_submission,
    read_submission,
    table_bytes,
)
from traps_pipeline.release.submissions import gather, write_board
from traps_pipeline.release.verification import NOT_RECOMPUTED, released_items, verify, verify_file
from traps_pipeline.scoring.score_rows import LEADERBOARD
from traps_pipeline.scoring.scores import score
from traps_pipeline.storage.tables import records
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow
Frames = dict[str, pd.DataFrame]
ITEM = "occlusion:domino_chain-0001:control"


@pytest.fixture(scope="module")
def packed(small: Checkout, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("submissions") / "small.zip"
    pack_submission(Workspace.open(small.workspace), path, "small")
    return path


@pytest.fixture(scope="module")
def release(small: Checkout, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("release") / "small"
    write_release(content_of(Workspace.open(small.workspace)), folder, Options())
    return folder


def forged(
    packed: Path, target: Path, change: Callable[[Frames], None], *, rescore: bool = False, **about: object
) -> Path:
    """A submission whose tables were changed by somebody who also corrects the digests, and the numbers if asked."""
    submission = read_submission(packed)
    frames = {name: frame.copy() for name, frame in submission.tables.items()}
    change(frames)
    if rescore:
        items, answers, votes = (frames[f"{name}.parquet"] for name in ("items", "responses", "votes"))
        own = [c for c in items.columns if c not in answers.columns or c in ("item_id", "benchmark_version")]
        scored = score(verdicts_of(items[own], answers.drop(columns="benchmark_version"), votes))
        tables = {"metrics": scored.metrics, "leaderboard": scored.board, "two_way": scored.two_way}
        frames |= {f"{name}.parquet": frame for name, frame in tables.items()}
    content = {name: table_bytes(TABLES[name], frame) for name, frame in frames.items()}
    digests = {name: hashlib.sha256(data).hexdigest() for name, data in content.items()}
    said = json.loads(submission.about.model_dump_json()) | {"files": digests} | about
    target.write_bytes(zipped({ABOUT: json.dumps(said).encode(), **content}))
    return target


def put(frames: Frames, name: str, column: str, value: object, **where: object) -> None:
    """Change one cell of a table."""
    frame = frames[f"{name}.parquet"]
    chosen = pd.concat([frame[key] == wanted for key, wanted in where.items()], axis=1).all(axis=1)
    assert chosen.sum() >= 1
    frame.loc[chosen[chosen].index[:1], column] = value


def problems(path: Path, release: Path | None = None) -> list[str]:
    return verify(read_submission(path), release and released_items(release)).problems


@pytest.mark.promise
def test_a_study_packed_twice_is_the_same_file_and_holds_against_its_release(
    packed: Path, release: Path, small: Checkout, tmp_path: Path
) -> None:
    again = tmp_path / "again.zip"
    packing = small.traps("publish", "submit", again, "--name", "small")
    assert packing.code == 0 and again.read_bytes() == packed.read_bytes()
    finished = small.traps("publish", "verify", again, "--release", release)
    *told, last = finished.out.splitlines()
    assert finished.code == 0 and last.startswith(f"{again}: ")
    assert len(told) == 1 + 3  # what was checked, and three things that nobody can check
    # 12 scenarios x 2 datasets x 2 sides; 3 models x 2 regimes; three judges on two tasks of a control, one of a void
    rows = {name: len(frame) for name, frame in read_submission(again).tables.items()}
    assert (rows["items.parquet"], rows["responses.parquet"], rows["votes.parquet"]) == (48, 288, 144 * 9)


def test_a_table_that_is_not_the_packed_one_is_named(packed: Path, tmp_path: Path) -> None:
    submission = read_submission(packed)
    about = json.loads(submission.about.model_dump_json())
    about["files"]["votes.parquet"] = "0" * 64
    content = {name: table_bytes(TABLES[name], frame) for name, frame in submission.tables.items()}
    (tmp_path / "f.zip").write_bytes(zipped({ABOUT: json.dumps(about).encode(), **content}))
    (problem,) = problems(tmp_path / "f.zip")
    assert "votes.parquet" in problem


def test_an_edited_answer_is_named(packed: Path, tmp_path: Path) -> None:
    def edit(frames: Frames) -> None:
        put(frames, "responses", "text", "The answer is: left.", item_id=ITEM, model="prior", regime="standard")

    found = problems(forged(packed, tmp_path / "f.zip", edit))
    # the answer of prior does not stand before the votes of its three judges on two tasks
    judges = ("rule-1", "rule-2", "rule-3")
    assert [f"prior (standard, run 1) on {ITEM}" in one for one in found] == [True] * 6
    assert [sum(judge in one for one in found) for judge in judges] == [2, 2, 2]
    assert not [one for one in found if "correctness" in one or "abstention" in one]  # the answer is at fault, no vote


def test_an_edited_vote_is_named_though_all_numbers_were_made_anew(packed: Path, tmp_path: Path) -> None:
    def edit(frames: Frames) -> None:
        for judge in ("rule-1", "rule-2", "rule-3"):
            put(frames, "votes", "correct", True, model="prior", task="correctness", correct=False, judge=judge)

    found = problems(forged(packed, tmp_path / "f.zip", edit, rescore=True))
    assert len(found) == 3
    told = ("rule-1", "correctness", "prior", "True", "False")  # what the vote says, and what its rules do
    assert [name for name in told if name not in found[0]] == []


def test_an_edited_number_is_named(packed: Path, tmp_path: Path) -> None:
    def edit(frames: Frames) -> None:
        put(frames, "leaderboard", "pecs", 0.75, model="prior", regime="json", dataset="overall")

    (problem,) = problems(forged(packed, tmp_path / "f.zip", edit))
    assert [name for name in ("leaderboard prior json overall", "pecs", "0.75", "0.0") if name not in problem] == []


def test_an_edited_question_and_a_missing_answer_are_named(packed: Path, tmp_path: Path) -> None:
    def edit(frames: Frames) -> None:
        put(frames, "items", "question", "Is it easy?", item_id=ITEM)
        frame = frames["responses.parquet"]
        gone = (frame["model"] == "oracle") & (frame["regime"] == "json") & (frame["item_id"] == ITEM)
        frames["responses.parquet"] = frame.loc[~gone]

    found = problems(forged(packed, tmp_path / "f.zip", edit))
    unanswered = f"oracle (json, run 1) on {ITEM}"
    assert ITEM in found[0] and "oracle" not in found[0]
    assert unanswered in found[1] and "rule-" not in found[1]
    assert any(unanswered in one and "rule-" in one for one in found[2:])  # a vote on what is not there


def test_items_of_another_benchmark_are_told_from_the_release(
    packed: Path, released: Path, release: Path, tmp_path: Path
) -> None:
    found = problems(packed, released)  # the demo's release has more scenarios
    named = {id_ for one in found[:-1] for id_ in re.findall(r"\w+:[\w-]+:(?:control|void)", one)}
    assert len(named) == len(found) - 1 > 0
    assert not named & {*read_submission(packed).tables["items.parquet"]["item_id"]}

    def edit(frames: Frames) -> None:
        put(frames, "items", "media_digest", "0" * 64, item_id=ITEM)

    path = forged(packed, tmp_path / "f.zip", edit)
    (foreign,) = {*problems(path, release)} - {*problems(path)}
    assert ITEM in foreign
    (clip, *_) = (release / "clips").glob("plinko-0001/control*.mp4")
    content = clip.read_bytes()
    try:
        clip.write_bytes(b"other")
        with raises(TrapsError, "release.verification.released_items", "clips/plinko-0001/control"):
            problems(packed, release)
    finally:
        clip.write_bytes(content)


def test_prompts_and_judges_of_another_version_are_named(packed: Path, tmp_path: Path) -> None:
    path = forged(packed, tmp_path / "f.zip", lambda frames: None, prompts={"standard": "0" * 16, "json": "1" * 16})
    assert [regime in one for regime, one in zip(("standard", "json"), problems(path), strict=True)] == [True, True]
    seats = [{"id": f"rule-{k}", "backend": "rule", "endpoint": "rule", "params": {"rules": 1}} for k in "123"]
    found = problems(forged(packed, tmp_path / "g.zip", lambda frames: None, judges=seats))
    assert any(one.count("rules@") == 2 for one in found)  # the panel that voted, and the one of these judges
    assert any("'rules'" in one and str(RULES_VERSION) in one for one in found)


def test_a_zip_with_other_names_is_refused(packed: Path, tmp_path: Path) -> None:
    path = tmp_path / "f.zip"
    path.write_bytes(packed.read_bytes())
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("../evil", b"x")
    with raises(TrapsError, "release.submission._members", str(path), ", ".join(sorted([ABOUT, *TABLES]))):
        read_submission(path)
    assert not (tmp_path.parent / "evil").exists()


def test_compressed_members_other_columns_and_other_files_are_refused(packed: Path, tmp_path: Path) -> None:
    path = tmp_path / "f.zip"
    with zipfile.ZipFile(packed) as source:
        content = {name: source.read(name) for name in source.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    with raises(TrapsError, "release.submission._members", ABOUT, "`traps publish submit`"):
        read_submission(path)
    table = pq.read_table(io.BytesIO(content["votes.parquet"])).drop_columns(["rationale"])
    made = io.BytesIO()
    pq.write_table(table, made)
    path.write_bytes(zipped(content | {"votes.parquet": made.getvalue()}))
    with raises(TrapsError, "release.submission._frame", "votes.parquet") as refused:
        read_submission(path)
    assert refused.value.__cause__ is None  # it could be read
    path.write_bytes(zipped(content | {"votes.parquet": b"\x80\x04K\x01."}))  # a pickle is no table
    with raises(TrapsError, "release.submission._frame", "votes.parquet") as refused:
        read_submission(path)
    assert refused.value.__cause__ is not None
    path.write_bytes(b"no zip")
    with raises(TrapsError, "release.submission.read_submission", str(path)):
        read_submission(path)


@pytest.mark.parametrize(("size", "rows"), [(MAX_TEXT_BYTES + 1, 1), (2**20, MAX_TABLE_BYTES // 2**20 + 1)])
def test_a_small_file_of_long_texts_or_of_one_text_in_many_rows_is_refused_before_they_are_unpacked(
    packed: Path, tmp_path: Path, size: int, rows: int
) -> None:
    with zipfile.ZipFile(packed) as source:
        content = {name: source.read(name) for name in source.namelist()}
    table = pq.read_table(io.BytesIO(content["responses.parquet"])).take([0] * rows)
    text = pa.DictionaryArray.from_arrays(pa.array([0] * rows, pa.int32()), pa.array(["x" * size]))
    table = table.set_column(table.schema.get_field_index("text"), "text", text)
    bomb = io.BytesIO()
    pq.write_table(table, bomb, compression="zstd", store_schema=False)
    path = tmp_path / "bomb.zip"
    path.write_bytes(zipped(content | {"responses.parquet": bomb.getvalue()}))
    assert path.stat().st_size < 1e6
    started = time.process_time()
    with raises(TrapsError, "release.submission._with_bounded_texts", str(path), "responses.parquet", str(size)):
        read_submission(path)
    assert time.process_time() - started < 2


def test_submissions_of_the_same_items_and_panel_are_ranked_together(
    packed: Path, one_regime: Checkout, tmp_path: Path
) -> None:
    other = tmp_path / "other.zip"
    pack_submission(Workspace.open(one_regime.workspace), other, "other")
    board = gather([packed, other])
    (group,) = board.groups
    standard = group.board.loc[(group.board["regime"] == "standard") & (group.board["dataset"] == "overall")]
    ranks = dict(zip(standard["model"], standard["rank"], strict=True))
    assert {*ranks} == {
        "oracle@small", "oracle@other", "random-50@small", "random-50@other", "prior@small", "prior@other",
        "confidence-noise",
    }  # fmt: skip
    assert ranks["oracle@small"] == ranks["oracle@other"] == 1 and min(ranks["prior@small"], ranks["prior@other"]) > 2
    write_board(board, tmp_path / "board")
    rows = pq.read_table(tmp_path / "board" / "leaderboard.parquet")
    assert rows.schema.equals(SUBMITTED.arrow_schema())
    assert {*rows["submission"].to_pylist()} == {"small", "other"}
    page = (tmp_path / "board" / "index.html").read_text()
    assert "oracle@other" in page and page.count('class="chapter"') == 1 and BY_RULES[1:] not in page
    again = gather([packed, other, packed])
    assert [entry.name for entry in again.accepted] == ["small", "other"]
    (refused,) = again.refused
    assert str(packed) in refused.problems[0] and "'small'" in refused.problems[0] and "--name" in refused.problems[0]


def test_other_items_or_another_panel_are_never_ranked_together(packed: Path, tmp_path: Path) -> None:
    def fewer(frames: Frames) -> None:
        for name in ("items", "responses", "votes"):
            frame = frames[f"{name}.parquet"]
            frames[f"{name}.parquet"] = frame.loc[~frame["item_id"].str.contains("domino_chain-0001")]

    def renamed(frames: Frames) -> None:
        votes = frames["votes.parquet"]
        votes["panel"] = votes["panel"].str.replace("rules@", "others@")

    paths = [
        packed,
        forged(packed, tmp_path / "fewer.zip", fewer, rescore=True, name="fewer"),
        forged(packed, tmp_path / "panel.zip", renamed, rescore=True, name="panel", panel="others"),
    ]
    board = gather(paths)
    assert board.refused == []
    assert sorted((group.n_items, group.panel.partition("@")[0]) for group in board.groups) == [
        (44, "rules"), (48, "others"), (48, "rules"),
    ]  # fmt: skip
    assert all(group.board["rank"].max() <= 3 for group in board.groups)
    write_board(board, tmp_path / "board")
    page = (tmp_path / "board" / "index.html").read_text()
    assert page.count('class="chapter"') == 3


def test_a_forged_submission_is_not_ranked_and_its_reason_is_on_the_page(
    packed: Path, tmp_path: Path, small: Checkout
) -> None:
    def edit(frames: Frames) -> None:
        put(frames, LEADERBOARD.name, "pecs", 1.0, model="prior", regime="json", dataset="overall")

    path = forged(packed, tmp_path / "forged.zip", edit, name="forged")
    finished = small.traps("publish", "leaderboard", packed, path, "--out", tmp_path / "board")
    (refused,) = (line for line in finished.out.splitlines() if "forged.zip" in line)
    assert finished.code == 1
    page = (tmp_path / "board" / "index.html").read_text()
    for text in (refused, page):
        told = text.partition("leaderboard prior json overall")[2][:100]
        assert [name for name in ("pecs", "1.0", "0.0") if name not in told] == [], text
    with raises(TrapsError, "release.submissions.gather", "forged.zip", "pecs"):
        gather([path])


# --- a stranger's tables ----------------------------------------------------------------------------------------------


def odd_value(value: object) -> object:
    """A value of the same kind that a column does not hold."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        return "elsewhere"
    return value + 7 if isinstance(value, int | float) else pd.Timestamp("2001-01-01", tz="UTC")


@pytest.mark.parametrize("name", ["items", "responses", "votes", "metrics", "leaderboard"])
def test_every_column_of_a_table_is_recomputed_or_named_as_not_recomputed(packed: Path, name: str) -> None:
    submission, table = read_submission(packed), TABLES[f"{name}.parquet"]
    rows, unseen = records(submission.read_table(table)), list[str]()
    for column in set(table.names) - {"labels", "created_at"}:
        at = next((k for k, row in enumerate(rows) if row[column] is not None), None)
        if at is None:
            value: object = True if column == "rejects_premise" else "elsewhere" if column == "error" else 7
            at = 0
        else:
            value = odd_value(rows[at][column])
        changed = [row | {column: value} if k == at else row for k, row in enumerate(rows)]
        frame = pd.DataFrame(changed, columns=pd.Index(table.names))
        tables = {**submission.tables, f"{name}.parquet": frame}
        problems = verify(replace(submission, tables=tables)).problems
        assert not [problem for problem in problems if "np." in problem]
        if not problems:
            unseen.append(column)
    assert {*unseen} == {*NOT_RECOMPUTED.get(name, ())} - {"created_at"}


def test_rejections_that_the_rules_do_not_see_are_named_though_all_numbers_were_made_anew(
    packed: Path, tmp_path: Path
) -> None:
    def edit(frames: Frames) -> None:
        votes = frames["votes.parquet"]
        is_void = votes["item_id"].str.endswith(":void") & votes["task"].eq("abstention")
        votes.loc[is_void & votes["model"].eq("oracle"), "rejects_premise"] = True

    found = problems(forged(packed, tmp_path / "f.zip", edit, rescore=True))
    assert found and all("rejects_premise is True" in one for one in found[:-1])


def hostile_metadata(packed: Path, target: Path, name: str) -> Path:
    """A submission whose tables tell pandas to take an attribute of theirs for the index."""
    submission, content = read_submission(packed), dict[str, bytes]()
    for file in TABLES:
        table = pq.read_table(io.BytesIO(unzip_bytes(packed.read_bytes())[file]))
        told = {"index_columns": ["__class__"], "columns": [{"name": "item_id", "metadata": {"x": 1}}]}
        stream = io.BytesIO()
        pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(told)}), stream)
        content[file] = stream.getvalue()
    digests = {file: hashlib.sha256(data).hexdigest() for file, data in content.items()}
    said = json.loads(submission.about.model_dump_json()) | {"files": digests, "name": name}
    target.write_bytes(zipped({ABOUT: json.dumps(said).encode(), **content}))
    return target


def test_an_odd_submission_is_left_out_with_a_sentence_and_all_others_are_ranked(packed: Path, tmp_path: Path) -> None:
    def foreign(frames: Frames) -> None:
        put(frames, "responses", "dataset", "elsewhere", model="prior")

    def no_number(frames: Frames) -> None:
        frames["items.parquet"]["labels"] = [[] for _ in range(len(frames["items.parquet"]))]

    odd = [
        forged(packed, tmp_path / f"{k}.zip", change, name=f"odd-{k}") for k, change in enumerate((foreign, no_number))
    ]
    odd.append(tmp_path / "cut.zip")
    odd[-1].write_bytes(packed.read_bytes()[:-400])
    odd.append(tmp_path / "gone.zip")
    told = hostile_metadata(packed, tmp_path / "metadata.zip", "told")
    board = gather([*odd, packed, told])
    assert [entry.name for entry in board.accepted] == ["small", "told"]
    assert [entry.name for entry in board.refused] == [path.name for path in odd]
    assert all(entry.problems and "Traceback" not in entry.problems[0] for entry in board.refused)
    assert all(str(path) in entry.problems[0] for path, entry in zip(odd[2:], board.refused[2:], strict=True))
    write_board(board, tmp_path / "board")
    page = (tmp_path / "board" / "index.html").read_text()
    assert all(name in page for name in ("0.zip", "1.zip", "cut.zip", "gone.zip", "oracle@small", "oracle@told"))


def test_whatever_a_check_raises_refuses_its_file_in_a_sentence(
    packed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def surprise(*_: object) -> object:
        raise RecursionError("deep")

    monkeypatch.setattr("traps_pipeline.release.verification.verdicts_of", surprise)
    with raises(TrapsError, "release.verification.verify_file", str(packed), "RecursionError"):
        verify_file(packed)


@pytest.mark.parametrize("premise", [False, True])
def test_a_submission_judged_by_language_models_is_ranked_with_and_without_their_view_of_the_premise(
    packed: Path, unasked: Checkout, provider: Provider, tmp_path: Path, premise: bool
) -> None:
    of_judge = f'base_url: "{provider.url}/v1", premise: {str(premise).lower()}'
    judges = "".join(f"  - {{id: judge-{k}, {of_judge}}}\n" for k in "abc")
    path, scenarios = tmp_path / "judged.yaml", SMALL.read_text()
    path.write_text(
        f"name: judged\nmodels: [oracle, prior]\nregimes: [standard]\njudges:\n{judges}"
        f"panels: {{three: [judge-a, judge-b, judge-c]}}\n{scenarios[scenarios.index('scenarios:') :]}"
    )
    unasked.traps("run", path, "--panel", "three", "--no-preflight", "--until", "leaderboard").ok()
    mine = tmp_path / "mine.zip"
    unasked.traps("publish", "submit", mine, "--name", "mine").ok()
    assert read_submission(mine).tables["leaderboard.parquet"]["n_rejects"].isna().all() != premise
    finished = unasked.traps("publish", "leaderboard", packed, mine, "--out", tmp_path / "board")
    assert finished.code == 0, finished.err
    page = (tmp_path / "board" / "index.html").read_text()
    assert page.count('class="chapter"') == 2 and "panel three@" in page and "panel rules@" in page
