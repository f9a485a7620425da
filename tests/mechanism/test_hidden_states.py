"""Pooled states equal the library's own, and an extraction that was stopped continues where it stopped."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open

from tests.build.errors import raises
from tests.local_models import SIX_FRAMES, SYSTEM, clip, model, three_prompts
from traps_pipeline.base.digests import file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.hidden_states import Item, clip_item, damage, extract, read_layer, read_record
from traps_pipeline.models.local.adapter import LocalModel, Prompt
from traps_pipeline.models.local.capture import pool
from traps_pipeline.storage.store import LEASES

pytestmark = pytest.mark.slow


def own_states(of: LocalModel, prompt: Prompt) -> list[np.ndarray]:
    """The library's hidden_states: (T, d) a layer."""
    with torch.inference_mode():
        out = of.network.base_model(**prompt.inputs, use_cache=False, output_hidden_states=True)
    return [states[0].numpy() for states in out.hidden_states]


def test_mean_pooling_is_the_mean_over_all_tokens() -> None:
    of, prompt = model("gemma-4"), three_prompts("gemma-4")[0]
    own, hooked = own_states(of, prompt), of.forward_states(prompt, "mean")
    for layer in range(of.n_layers):
        np.testing.assert_allclose(hooked.raw[layer], own[layer].mean(axis=0), rtol=0, atol=1e-4)
    np.testing.assert_allclose(hooked.normed, own[-1].mean(axis=0), rtol=0, atol=1e-4)


def test_a_kept_state_keeps_no_other_alive() -> None:
    states = torch.zeros(1, 1000, 8)
    assert pool(states, "last").untyped_storage().nbytes() == 8 * 4
    with raises(ValueError, "models.local.capture.pool", "2"):
        pool(torch.zeros(2, 10, 8), "last")


# --- extraction -------------------------------------------------------------------------------------------------------


def work(of: LocalModel, n: int = 5, opened: Callable[[int], None] = lambda i: None, **changed: str) -> list[Item]:
    """Items with different questions; `opened` is called whenever a prompt is made. changed: questions by item id."""

    def item(i: int) -> Item:
        question = changed.get(f"item{i}", f"Does it stop after {i} s?")
        row = {"item_id": f"item{i}", "side": ("control", "void")[i % 2], "question": question}
        made = clip_item(of, SIX_FRAMES, row | {"media_digest": file_digest(clip())}, clip(), SYSTEM)

        def prompt() -> Prompt:
            opened(i)
            return made.prompt()

        return replace(made, prompt=prompt)

    return [item(i) for i in range(n)]


def test_what_is_read_back_is_what_the_model_gave(tmp_path: Path) -> None:
    of = model("gemma-4")
    assert extract(of, work(of), tmp_path, shard_size=2) == 5
    expected = [of.forward_states(item.prompt()) for item in work(of)]
    for layer in range(of.n_layers + 1):
        ids, states = read_layer(tmp_path, layer)
        assert list(ids["item_id"]) == [f"item{i}" for i in range(5)]
        assert list(ids["side"]) == ["control", "void", "control", "void", "control"]
        assert (states == np.stack([one.raw[layer] for one in expected])).all()
    assert (read_layer(tmp_path, "normed")[1] == np.stack([one.normed for one in expected])).all()
    with safe_open(tmp_path / "shard-00000.safetensors", framework="np") as shard:
        assert sorted(shard.keys()) == [*(f"layer_{layer:03d}" for layer in range(of.n_layers + 1)), "normed"]
    assert [path.name for path in tmp_path.glob(".*")] == []


def test_a_second_extraction_makes_no_pass_and_a_corrected_item_one(tmp_path: Path) -> None:
    of, opened = model("qwen3-vl"), []
    extract(of, work(of), tmp_path, shard_size=2)
    assert (extract(of, work(of, opened=opened.append), tmp_path, shard_size=2), opened) == (0, [])
    before = read_layer(tmp_path, 2)[1]
    corrected = extract(of, work(of, opened=opened.append, item3="Is it red?"), tmp_path, shard_size=2)
    assert (corrected, opened) == (1, [3])
    changed = (read_layer(tmp_path, 2)[1] != before).any(axis=1)
    assert list(changed) == [False, False, False, True, False]
    assert extract(of, work(of)[:2], tmp_path, shard_size=2) == 0
    assert len(read_layer(tmp_path, 2)[0]) == 2
    assert [path.name for path in sorted(tmp_path.glob("*.safetensors"))] == ["shard-00000.safetensors"]


def test_another_precision_or_pooling_is_another_extraction(tmp_path: Path) -> None:
    of = model("llava-next-video")
    extract(of, work(of, 2), tmp_path)
    assert extract(of, work(of, 2), tmp_path, pooling="mean") == 2
    assert read_record(tmp_path)["pooling"] == "mean"
    half = model("llava-next-video", dtype="bfloat16")
    assert extract(half, work(half, 2), tmp_path) == 2
    record = read_record(tmp_path)
    assert (record["dtype"], record["pooling"], record["n_layers"], record["d_model"]) == ("bfloat16", "last", 4, 64)
    assert record["checkpoint_digest"] == of.checkpoint.digest
    with safe_open(tmp_path / "shard-00002.safetensors", framework="pt") as shard:
        assert shard.get_tensor("layer_001").dtype == torch.bfloat16
    expected = half.forward_states(work(half, 1)[0].prompt()).raw[1]
    assert (read_layer(tmp_path, 1)[1][0] == expected).all()  # 16 bits hold what a model in 16 bits gives


def test_states_made_on_another_device_say_so_item_by_item(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    of = model("llava-next-video")
    extract(of, work(of, 2), tmp_path)
    assert str(tmp_path) not in capsys.readouterr().err
    monkeypatch.setattr(LocalModel, "device_name", "cuda:0 (some GPU)")
    extract(of, work(of, 4), tmp_path)
    assert list(read_layer(tmp_path, 1)[0]["device"]) == ["cpu"] * 2 + ["cuda:0 (some GPU)"] * 2
    said = capsys.readouterr().err
    assert all(name in said for name in (str(tmp_path), "cpu", "cuda:0 (some GPU)", "`device`"))


SLOW = """
import os, sys, time
from pathlib import Path
from tests.local_models import model
from tests.mechanism.test_hidden_states import work
from traps_pipeline.mechanism.hidden_states import extract
of, folder, deadline = model("qwen3-vl"), Path(sys.argv[1]), time.monotonic() + 900
folder.with_name(f"ready-{os.getpid()}").touch()
while len([*folder.parent.glob("ready-*")]) < int(sys.argv[2]) and time.monotonic() < deadline:
    time.sleep(0.01)
print(extract(of, work(of, 40, opened=lambda i: time.sleep(0.05)), folder, shard_size=2))
"""


def slowly(folder: Path, processes: int = 1) -> subprocess.Popen[str]:
    """A process that extracts forty items, in two seconds or more, once so many processes are ready."""
    command = [sys.executable, "-c", SLOW, folder, str(processes)]
    return subprocess.Popen(command, cwd=Path(__file__).resolve().parents[2], stdout=subprocess.PIPE, text=True)


def test_processes_at_one_folder_share_the_items_and_each_is_made_once(tmp_path: Path) -> None:
    both = [slowly(tmp_path, 2) for _ in range(2)]
    made = [int(process.communicate()[0]) for process in both]
    assert sum(made) == 40 and min(made) > 0
    of, (ids, states) = model("qwen3-vl"), read_layer(tmp_path, 2)
    assert list(ids["item_id"]) == [item.item_id for item in work(of, 40)]
    for i in (0, 1, 20, 39):
        assert (states[i] == of.forward_states(work(of, 40)[i].prompt()).raw[2]).all()
    assert not (tmp_path / LEASES).exists()


def test_an_extraction_killed_half_way_goes_on_where_it_stopped(tmp_path: Path) -> None:
    process = slowly(tmp_path)
    deadline = time.monotonic() + 900
    while not (tmp_path / "shard-00001.parquet").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    kept = 2 * len(list(tmp_path.glob("shard-*.parquet")))
    assert 4 <= kept < 40
    (tmp_path / f"shard-{kept // 2:05d}.safetensors").write_bytes(b"torn")  # as if it had been writing one
    of, opened = model("qwen3-vl"), []
    done = extract(of, work(of, 40, opened=opened.append), tmp_path, shard_size=2)
    assert (done, opened) == (40 - kept, list(range(kept, 40)))
    states = read_layer(tmp_path, 3)[1]
    for i in (0, kept - 1, kept, 39):
        assert (states[i] == of.forward_states(work(of, 40)[i].prompt()).raw[3]).all()


def test_a_flipped_bit_in_any_file_of_an_extraction_changes_no_state_unseen(tmp_path: Path) -> None:
    of, places = model("qwen3-vl"), random.Random(1)
    extract(of, work(of), tmp_path, shard_size=2)

    def read() -> list[tuple[list[list[str]], bytes]]:
        layers = [read_layer(tmp_path, layer) for layer in (*range(of.n_layers + 1), "normed")]
        return [(ids.to_numpy().tolist(), states.tobytes()) for ids, states in layers]

    sound, silent, named = read(), list[str](), 0
    files = [tmp_path / "ids.parquet", *sorted(tmp_path.glob("shard-*.safetensors"))]
    for file in files:
        written = file.read_bytes()
        for place in places.sample(range(8 * len(written)), 60):
            flipped = bytearray(written)
            flipped[place // 8] ^= 1 << place % 8
            file.write_bytes(flipped)
            try:
                if read() != sound:
                    silent.append(f"{file.name} bit {place}")
            except TrapsError as error:
                named += str(file) in str(error)
        file.write_bytes(written)
    assert not silent and named > 200
    table = tmp_path / "shard-00001.parquet"  # read only when an extraction goes on
    flipped = bytearray(table.read_bytes())
    flipped[len(flipped) // 3] ^= 1
    table.write_bytes(flipped)
    assert damage(table).startswith(str(table)) and not damage(tmp_path / "shard-00000.parquet")
    assert extract(of, work(of), tmp_path, shard_size=2) == 2
    assert read() == sound


def test_a_layer_that_is_not_there_is_refused(tmp_path: Path) -> None:
    of = model("qwen3-vl")
    extract(of, work(of, 1), tmp_path)
    for layer in (5, -1):
        with raises(TrapsError, "mechanism.hidden_states.read_layer", str(tmp_path), str(layer), of.checkpoint.name):
            read_layer(tmp_path, layer)
