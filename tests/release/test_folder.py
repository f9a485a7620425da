"""A released folder holds what it says, is the same whenever it is made, and names what was altered in it."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import Checkout
from tests.release.environments import run_in
from traps_pipeline.base.digests import file_digest
from traps_pipeline.benchmark.records import load_release
from traps_pipeline.release.checksums import altered_files
from traps_pipeline.release.content import content_of
from traps_pipeline.release.folder import Options, identity_texts, write_release
from traps_pipeline.release.released_rows import OPEN
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.video.encode import decode

pytestmark = pytest.mark.slow


def rows(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def workspace(demo: Checkout) -> Workspace:
    return Workspace.open(demo.workspace)


@pytest.fixture
def copy(released: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(released, tmp_path / "copy"))


def test_a_pair_is_one_row_with_both_clips_and_questions(released: Path) -> None:
    pairs = rows(released / "metadata.jsonl")
    assert len(pairs) == 64  # 32 scenarios in two datasets each
    for pair in pairs:
        control, void = (released / pair[f"{side}_file_name"] for side in ("control", "void"))
        ill_posed = pair["dataset"].endswith("_ill_posed")
        assert (control == void) == ill_posed
        assert (pair["control_question"] == pair["void_question"]) != ill_posed
        assert pair["ground_truth"] in pair["labels"]
    frames, _ = decode(released / pairs[0]["control_file_name"])
    assert len(frames) == 50


def test_its_items_are_those_of_the_study_and_their_clips_are_below_their_table(
    released: Path, workspace: Workspace
) -> None:
    items = rows(released / "clips" / "metadata.jsonl")
    asked = {row["item_id"]: row for row in workspace.tables.read_all(ITEMS).to_dict("records")}
    assert {row["item_id"] for row in items} == set(asked) and len(items) == 136
    for row in items:
        assert file_digest(released / "clips" / row["file_name"]) == row["media_digest"]
        assert row["item_hash"] == asked[row["item_id"]]["item_hash"]


def test_every_certificate_of_every_scenario_holds(released: Path) -> None:
    found = rows(released / "certificates.jsonl")
    assert {row["scenario_id"] for row in found} == {row["scenario_id"] for row in rows(released / "scenarios.jsonl")}
    assert [row for row in found if not row["holds"] or row["failure"]] == []
    assert all(json.loads(row["evidence"]) for row in found if row["certificate"] == "outcome")


def test_every_column_of_every_table_is_in_the_dictionary_and_in_the_description(released: Path) -> None:
    dictionary = (released / "DICTIONARY.md").read_text()
    described = json.loads((released / "croissant.json").read_text())
    fields = {field["@id"]: field["description"] for one in described["recordSet"] for field in one["field"]}
    columns = {f"{table.name}/{column.name}": column.doc for table in OPEN for column in table.columns}
    assert fields == columns
    assert [doc for doc in columns.values() if doc not in dictionary] == []


def test_every_text_table_and_page_holds_the_canary(released: Path) -> None:
    canary = load_release().canary
    texts = {name: content.decode() for name, content in files(released).items() if not name.endswith(".mp4")}
    assert len(texts) == 15
    assert [name for name, text in texts.items() if canary not in text] == []
    assert all(canary in line for name, text in texts.items() if name.endswith(".jsonl") for line in text.splitlines())


def test_made_twice_it_has_the_same_bytes(released: Path, workspace: Workspace, tmp_path: Path) -> None:
    write_release(content_of(workspace), tmp_path / "again", Options(date="2026-11-22"))
    assert files(tmp_path / "again") == files(released)


def test_standard_tools_check_its_sums(released: Path) -> None:
    subprocess.run(["sha256sum", "--check", "--strict", "--quiet", "SHA256SUMS"], cwd=released, check=True)


def test_a_changed_a_swapped_a_removed_and_an_added_file_are_each_named(copy: Path, demo: Checkout) -> None:
    control, void, *_ = sorted((copy / "clips" / "plinko-0001").iterdir())
    shutil.copy(void, control)
    with (copy / "scenarios.jsonl").open("a") as stream:
        stream.write("\n")
    (copy / "prompts.jsonl").unlink()
    (copy / "more.txt").write_text("more")
    problems = altered_files(copy)
    altered = [f"clips/plinko-0001/{control.name}", "more.txt", "prompts.jsonl", "scenarios.jsonl"]
    assert [problem.partition(": ")[0] for problem in problems] == altered
    assert f"clips/plinko-0001/{void.name}" in problems[0]
    finished = demo.traps("publish", "verify", copy)
    assert (finished.code, finished.raised) == (1, "cli.publish_commands.verify")
    assert finished.out.splitlines() == problems


def test_for_double_blind_review_nothing_names_its_authors(workspace: Workspace, tmp_path: Path) -> None:
    write_release(content_of(workspace), tmp_path / "blind", Options(anonymous=True))
    words = [name for one in identity_texts() for name in one.split(", ")]
    assert len(words) > 6
    texts = [" ".join(c.decode().split()) for name, c in files(tmp_path / "blind").items() if not name.endswith("mp4")]
    assert [word for word in words for text in texts if word in text] == []


def test_a_clip_that_is_not_its_items_is_named_and_nothing_is_written(demo_study: Checkout, tmp_path: Path) -> None:
    clip = next((demo_study.workspace / "clips" / "plinko-0001").glob("void*.mp4"))
    clip.write_bytes(b"other")
    finished = demo_study.traps("publish", "release", tmp_path / "out")
    assert finished.code == 1 and str(clip) in finished.err
    assert not (tmp_path / "out").exists()


# --- in environments of their own -------------------------------------------------------------------------------------

LOAD = """
import json, sys
from datasets import Video, load_dataset
import av
folder, cache = sys.argv[1:]
found = {}
for name, columns in (("pairs", ["control", "void"]), ("items", ["video"])):
    rows = load_dataset(folder, name, split="test", cache_dir=cache)
    for column in columns:
        assert isinstance(rows.features[column], Video), rows.features
        rows = rows.cast_column(column, Video(decode=False))
    frames = {c: sum(1 for _ in av.open(rows[0][c]["path"]).decode(video=0)) for c in columns}
    found[name] = {"rows": len(rows), "frames": frames}
for name in ("scenarios", "two_events", "certificates", "splits", "prompts"):
    rows = load_dataset("json", data_files=f"{folder}/{name}.jsonl", split="train", cache_dir=cache)
    found[name] = {"rows": len(rows)}
print(json.dumps(found))
"""


def test_the_hubs_loader_reads_pairs_with_two_videos_and_items_with_one(released: Path, tmp_path: Path) -> None:
    found = json.loads(run_in("hub", "-c", LOAD, released, tmp_path))
    assert (found["pairs"]["rows"], found["items"]["rows"], found["scenarios"]["rows"]) == (64, 136, 32)
    assert found["pairs"]["frames"]["control"] == found["items"]["frames"]["video"] == 50
    assert 10 <= found["pairs"]["frames"]["void"] < 50  # a chaotic void ends before the outcome


VALIDATE = """
import json, sys, warnings
import mlcroissant as mlc
dataset = mlc.Dataset(jsonld=sys.argv[1])
print(json.dumps({
    "errors": sorted(dataset.metadata.ctx.issues.errors), "warnings": sorted(dataset.metadata.ctx.issues.warnings),
    "version": str(dataset.metadata.ctx.conforms_to.value), "biases": len(dataset.metadata.data_biases),
    "rows": {one.name: sum(1 for _ in dataset.records(one.name)) for one in dataset.metadata.record_sets},
}))
"""


def test_mlcroissant_validates_its_description_and_reads_every_record(released: Path) -> None:
    found = json.loads(run_in("hub", "-c", VALIDATE, released / "croissant.json").splitlines()[-1])
    assert (found["errors"], found["warnings"]) == ([], [])
    assert found["version"].endswith("/1.1") and found["biases"] == 2
    assert found["rows"] == json.loads((released / "release.json").read_text())["rows"]


SIGN = """
import sys
from pathlib import Path
from traps_pipeline.release.signing import sign, signature_problem
folder, private, public, other = map(Path, sys.argv[1:])
for refused in (lambda: sign(folder, public), lambda: signature_problem(folder, public)):
    try:
        refused()
    except TrapsError as error:
        print(error)
sign(folder, private)
print(repr(signature_problem(folder, public)))
print(signature_problem(folder, other))
(folder / "prompts.jsonl").write_text("other")
print(signature_problem(folder, public))
"""


def test_a_signature_is_of_its_key_over_these_files_alone(copy: Path, tmp_path: Path, demo: Checkout) -> None:
    keys = []
    for name in ("one", "two"):
        private, public = tmp_path / f"{name}.pem", tmp_path / f"{name}.pub"
        make = ["openssl", "ecparam", "-name", "prime256v1", "-genkey", "-noout", "-out", private]
        subprocess.run(make, check=True)
        subprocess.run(["openssl", "ec", "-in", private, "-pubout", "-out", public], check=True, capture_output=True)
        keys += [private, public]
    printed = run_in("sign", "-c", SIGN, copy, keys[0], keys[1], keys[3], PYTHONPATH=str(demo.root))
    no_key, unsigned, right, *refused = printed.splitlines()
    assert "one.pub" in no_key and "openssl ecparam" in no_key
    assert "signature.sig.json" in unsigned and "--key" in unsigned
    assert right == "''" and ["signature.sig.json" in one for one in refused] == [True, True]
