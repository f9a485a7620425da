"""The folder of the benchmark holds every pair with its clips, questions, prompts and licences."""

from __future__ import annotations

import pandas as pd
import pytest

from traps_pipeline.benchmark.dataset import write_dataset
from traps_pipeline.digests import file_digest
from traps_pipeline.errors import TrapsError


def items(root):
    """Both sides of one pair; their clips lie under root."""
    (root / "clips").mkdir()
    rows = []
    for side in ("control", "void"):
        clip = root / "clips" / f"{side}.mp4"
        clip.write_bytes(side.encode())
        scene = {"dataset": "chaotic", "category": "plinko", "sub_scenario": "plinko", "scenario_id": "plinko-0001"}
        rows.append(
            scene
            | {"pair_id": "chaotic:plinko-0001", "side": side, "question": f"Where, {side}?", "labels": ["1", "2"]}
            | {
                "ground_truth": "2" if side == "control" else None,
                "benchmark_version": "1",
                "clip": f"clips/{side}.mp4",
            }
            | {"media_digest": file_digest(clip)}
        )
    return pd.DataFrame(rows)


def test_a_pair_is_one_row_with_both_clips_and_questions(tmp_path):
    target = tmp_path / "out"
    assert write_dataset(items(tmp_path), tmp_path, target) == 1
    (row,) = pd.read_csv(target / "pairs.csv", dtype=str).to_dict("records")
    assert (row["pair_id"], row["choices"], row["ground_truth"]) == ("chaotic:plinko-0001", "1; 2", "2")
    for side in ("control", "void"):
        assert row[f"{side}_question"] == f"Where, {side}?"
        assert (target / row[f"{side}_clip"]).read_bytes() == side.encode()
    assert "CC BY-NC 4.0" in (target / "LICENSE-DATA").read_text()
    assert (target / "prompts" / "standard.txt").is_file() and (target / "prompts" / "README.md").is_file()


def test_a_clip_that_is_not_its_items_is_named_and_no_table_is_written(tmp_path):
    table = items(tmp_path)
    (tmp_path / "clips" / "void.mp4").write_bytes(b"other")
    with pytest.raises(TrapsError, match=r"clips/void\.mp4: is missing or not the clip of its item"):
        write_dataset(table, tmp_path, tmp_path / "out")
    assert not (tmp_path / "out" / "pairs.csv").exists()
    with pytest.raises(TrapsError, match="materialize items first"):
        write_dataset(table.iloc[:0], tmp_path, tmp_path / "out")
