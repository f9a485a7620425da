"""The folder of the explorer: its data files hold the study's tables in order, and nothing else is touched."""

from __future__ import annotations

import base64
import io
import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.build.cells import CELL, HOSTILE, row, write_cell
from tests.build.errors import raises
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.judging.judging_rows import VERDICTS, VOTES
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.report.explorer import answer_shards
from traps_pipeline.report.explorer.answer_shards import NO, NONE, StudyAnswers, study_answers
from traps_pipeline.report.explorer.site import INDEX, SCRIPT, data_script, script, write_site
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace


def read_data(path: Path) -> dict:
    """The content of a data script; Parquet files as their columns."""
    found = re.fullmatch(r'TRAPS_DATA\("([^"]+)","([0-9a-f]{16})",(.*)\);\n', path.read_text("ascii"), re.DOTALL)
    assert found and found[1] == path.stem
    return {name: columns(value) if isinstance(value, str) else value for name, value in json.loads(found[3]).items()}


def columns(text: str) -> dict[str, list] | str:
    """The columns of a Parquet file in base64; any other text as it is."""
    data = base64.b64decode(text) if text.startswith("UEFSM") else b""  # PAR1
    return pq.read_table(io.BytesIO(data)).to_pydict() if data else text


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return Workspace.create(tmp_path / "study", Study(name="hand-made", scenarios=["plinko-0001"]))


def test_data_files_hold_each_answer_with_its_decisions_and_votes(workspace: Workspace, tmp_path: Path) -> None:
    write_cell(workspace)
    other = Cell(CELL.dataset, Evaluation("always-abstain", "guided", 2))
    write_cell(workspace, other, "I don't know.")
    written = write_site(workspace, tmp_path / "site")
    assert (written.answers, written.votes) == (4, 4)
    data = tmp_path / "site" / "data"
    study = read_data(data / "study.js")
    assert study["evaluations"] == [["always-abstain", "guided", 2], ["oracle", "standard", 1]]
    items = read_data(data / "items.js")["items"]
    assert items["side"] == ["control", "void"]
    decisions = read_data(data / "decisions.js")["decisions"]
    pairs = [*zip(decisions["item"], decisions["evaluation"], strict=True)]
    assert pairs == [(0, 0), (0, 1), (1, 0), (1, 1)]
    assert [study["outcomes"][k] for k in decisions["outcome"]] == ["answer", "answer", "refused", "refused"]
    assert decisions["abstained"] == [NO, NO, NONE, NONE]
    assert decisions["correct"] == [NONE] * 4
    [[name, first, rows]] = study["shards"]
    shard = read_data(data / f"{name}.js")
    assert (first, rows) == (0, 4)
    assert shard["texts"]["text"] == ["I don't know.", HOSTILE, None, None]
    assert shard["votes"]["answer"] == [0, 0, 1, 1]
    assert shard["votes"]["task"] == ["abstention", "correctness"] * 2
    assert shard["votes"]["valid"] == [True, False] * 2


def test_what_is_no_longer_in_the_benchmark_or_not_judged_yet_is_told_apart(workspace: Workspace) -> None:
    write_cell(workspace)
    part = CELL.partition
    stray = row(RESPONSES, item_id="chaotic:plinko-0009:void", side="void", outcome="answer", text="left", **part)
    kept = row(RESPONSES, item_id="chaotic:plinko-0001:void", side="void", outcome="answer", text="right", **part)
    workspace.tables.write(RESPONSES, part, [stray, kept], {})
    workspace.tables.write(VOTES, part, [], {})
    workspace.tables.write(VERDICTS, part, [], {})
    found = study_answers(workspace)
    assert found.texts["text"].to_pylist() == ["right"]
    assert found.decisions["abstained"].to_pylist() == [NONE]
    assert len(found.votes) == 0


def test_an_answer_that_no_judge_could_read_is_unread_and_its_text_stays(workspace: Workspace) -> None:
    write_cell(workspace)
    verdicts = workspace.tables.read(VERDICTS, CELL.partition)
    verdicts.loc[verdicts["side"].eq("control"), ["outcome", "abstained"]] = ["unread", None]
    workspace.tables.write(VERDICTS, CELL.partition, verdicts, {})
    found = study_answers(workspace)
    assert [found.outcomes[k] for k in found.decisions["outcome"].to_pylist()] == ["unread", "refused"]
    assert found.texts["text"].to_pylist() == [HOSTILE, None]
    assert found.decisions["abstained"].to_pylist() == [NONE, NONE]


def test_shards_follow_each_other_and_divide_no_pair(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(answer_shards, "SHARD_ROWS", 7)
    items = pd.DataFrame({"pair_id": [f"p{k // 2}" for k in range(12)]})  # 6 pairs, 3 answers an item: 6 rows a pair
    item = np.repeat(np.arange(12), 3).astype(np.int32)
    item = item[item != 5]  # an item that was not asked
    votes = np.repeat(np.arange(len(item)), 2).astype(np.int32)
    study = StudyAnswers(
        items, [], [], [], pa.table({"item": item}), pa.table({"text": [f"{k}" for k in range(len(item))]}),
        pa.table({"answer": votes, "of": votes}),
    )  # fmt: skip
    shards = list(study.shards())
    assert [s.first for s in shards] == [0, 6, 12, 15, 21, 27]
    assert pa.concat_tables([s.texts for s in shards])["text"].to_pylist() == study.texts["text"].to_pylist()
    for shard in shards:
        whole = {item[shard.first] // 2, item[shard.first + len(shard.texts) - 1] // 2}
        assert len(whole) == 1  # two pairs would be 9 or 12 rows
        assert np.array_equal(shard.votes["answer"].to_numpy() + shard.first, shard.votes["of"].to_numpy())
    monkeypatch.setattr(answer_shards, "SHARD_ROWS", 100)
    assert [len(s.texts) for s in study.shards()] == [33]


def test_a_site_takes_the_place_of_an_earlier_one_and_of_nothing_else(workspace: Workspace, tmp_path: Path) -> None:
    write_cell(workspace)
    folder = tmp_path / "site"
    write_site(workspace, folder)
    before = {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    workspace.tables.path(RESPONSES, CELL.partition).unlink()
    write_site(workspace, folder)  # fewer answers: the shard is gone
    assert not (folder / "data" / "answers-0000.js").exists()
    write_cell(workspace)
    write_site(workspace, folder)
    assert {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    foreign = tmp_path / "home"
    foreign.mkdir()
    (foreign / "thesis.tex").write_text("mine")
    with raises(TrapsError, "report.explorer.site._former_files"):
        write_site(workspace, foreign)
    assert [path.name for path in foreign.iterdir()] == ["thesis.tex"]


def test_only_clips_of_the_study_are_put_into_the_folder(workspace: Workspace, tmp_path: Path) -> None:
    secret = tmp_path / "secret.mp4"
    secret.write_bytes(b"secret")
    own = workspace.root / "clips" / "plinko-0001" / "control.mp4"
    own.parent.mkdir(parents=True)
    own.write_bytes(b"clip")
    named = {"control": "clips/plinko-0001/control.mp4", "void": "clips/../../secret.mp4"}
    rows = [
        row(ITEMS, item_id=f"chaotic:plinko-0001:{side}", side=side, dataset="chaotic", clip=clip)
        for side, clip in named.items()
    ]
    workspace.tables.write(ITEMS, {"dataset": "chaotic"}, rows, {})
    written = write_site(workspace, tmp_path / "site")
    assert (written.clips, written.clip_bytes) == (1, 4)
    assert [path.name for path in (tmp_path / "site").rglob("*.mp4")] == ["control.mp4"]
    assert read_data(tmp_path / "site" / "data" / "items.js")["items"]["clip"] == [named["control"], None]
    bare = write_site(workspace, tmp_path / "bare", clips=False)
    assert (bare.clips, list((tmp_path / "bare").rglob("*.mp4"))) == (0, [])


def test_a_study_without_items_says_what_to_do(workspace: Workspace, tmp_path: Path) -> None:
    with raises(TrapsError, "report.explorer.answer_shards.study_items"):
        write_site(workspace, tmp_path / "site")
    assert not (tmp_path / "site").exists()


def test_the_page_may_load_nothing_but_its_own_script_data_and_clips(workspace: Workspace, tmp_path: Path) -> None:
    write_cell(workspace)
    write_site(workspace, tmp_path / "site")
    page = (tmp_path / "site" / INDEX).read_text()
    (policy,) = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]+)"', page)
    assert policy.startswith("default-src 'none'; script-src 'self';")
    allowed = {source for part in policy.split("; ") for source in part.split()[1:]}
    assert {each for each in allowed if not each.startswith("'sha256-")} == {"'none'", "'self'", "blob:", "data:"}
    assert "unsafe" not in policy and "http" not in policy.replace("http-equiv", "")
    assert re.findall(r'<script [^>]*src="([^"?]+)', page) == [SCRIPT, "data/study.js"]
    code = (tmp_path / "site" / SCRIPT).read_text()
    assert code == script()
    assert code.count("The MIT License (MIT)") + code.count("MIT License\n") >= 2  # of both bundled libraries
    own = code.partition('"use strict"')[2]
    for door in ("innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval(", "import("):
        assert door not in own, door


def test_no_text_can_end_the_script_that_holds_it() -> None:
    text = data_script("study", "0" * 16, {"a": "</script><script>alert(1)</script>", "b": "\u2028\u202e"}).decode(
        "ascii"
    )
    assert "<" not in text
    assert json.loads(text[text.index("{") : text.rindex("}") + 1])["a"].startswith("</script>")
