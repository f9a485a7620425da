"""Sixteen models at 24 connections each, 8 s latency, 25 real frames a call: the share of the throughput that latency
and concurrency allow, in one process. The whole run counts, from the first call that is made to the last answer that is
in the ledger. As in a study all models go through the same clips in the same order.

python bench/throughput.py [--answers 404]
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
from bench.quick import parse  # noqa: E402

MODELS, CONNECTIONS, LATENCY_S = 16, 24, 8.0
CLIPS = 48
PARAMS = {"temperature": 0.8, "top_p": 0.95, "max_tokens": 8000}


def _clips(folder: Path) -> Iterator[Path]:
    """Yield real clips: the control of a released scenario, each shifted by another number of pixels."""
    from bench.render import _model, _qpos
    from traps_pipeline.benchmark.records import load_released
    from traps_pipeline.scenes.picture.camera import Camera
    from traps_pipeline.scenes.picture.render import Renderer
    from traps_pipeline.video.encode import encode

    spec = load_released()["plinko-0001"]
    with Renderer(_model(spec), Camera.from_record(spec.camera)) as renderer:
        frames = np.stack(list(renderer.frames(_qpos(spec))))
    for n in range(CLIPS):
        clip = folder / f"{n}.mp4"
        encode(list(np.roll(frames, n, axis=2)), clip, 10)
        yield clip


def main() -> None:
    from tests.providers.server import Provider
    from traps_pipeline.base.digests import file_digest
    from traps_pipeline.ledger.ledger import Ledger
    from traps_pipeline.ledger.sqlite import SqliteDatabase
    from traps_pipeline.models.asking.ask import Call, Work, run_work
    from traps_pipeline.models.asking.participants import Participants
    from traps_pipeline.models.money.budget import Budget
    from traps_pipeline.models.registry.entries import Account, ModelEntry
    from traps_pipeline.models.request import Request
    from traps_pipeline.models.wire.api import ApiBackend, load_litellm
    from traps_pipeline.protocol.cells import Cell, Evaluation
    from traps_pipeline.storage.media import MediaSpec, MediaStore
    from traps_pipeline.storage.study import Study

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--answers", type=int, default=404, help="of each model; the smallest cell has 404")
    arguments = parse(parser, answers=8)
    os.environ["BENCH_KEY"] = "k"
    spec = MediaSpec(profile="images", fps=5, most=25)
    with (
        tempfile.TemporaryDirectory() as name,
        Provider.start({"latency_s": LATENCY_S}, keeps_records=False) as provider,
    ):
        folder = Path(name)
        store = MediaStore(folder / "media")
        sent = [store.prepare(clip, file_digest(clip), spec) for clip in _clips(folder)]
        account = Account(key="BENCH_KEY", base_url=f"{provider.url}/v1")
        names = [f"m{n}" for n in range(MODELS)]
        fields: dict[str, Any] = {"backend": "api", "account": "a", "params": PARAMS, "media": spec}
        context = {"accounts": {"a": account}}
        entries = {
            n: ModelEntry.model_validate(fields | {"id": n, "provider_id": f"openai/{n}"}, context=context)
            for n in names
        }

        def calls(cell: Cell) -> list[Call]:
            model = cell.evaluation.model
            about = [{"item_id": str(n), "model": model} for n in range(arguments.answers)]
            question = "In which numbered bucket does the ball come to rest?"
            return [
                Call(Request(model, f"openai/{model}", PARAMS, "You watch a clip.", question, a, sent=sent[n % CLIPS]))
                for n, a in enumerate(about)
            ]

        study = Study(allow_unknown_prices=True)
        participants = Participants(entries, lambda entry: ApiBackend(entry, account), study, {"a": account})
        ledger, budget = Ledger(SqliteDatabase(folder, "bench"), "answers"), Budget(0, {})
        work = Work("responses", ledger, participants, budget, "1", calls, lambda _: None)
        load_litellm()
        began, cpu = time.perf_counter(), sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
        list(run_work(work, [Cell("occlusion", Evaluation(n, "standard", 1)) for n in names]))
        seconds = time.perf_counter() - began
        cpu = sum(resource.getrusage(resource.RUSAGE_SELF)[:2]) - cpu
    answers, allowed = MODELS * arguments.answers, MODELS * CONNECTIONS / LATENCY_S
    size = sum(media.size_bytes for media in sent) / CLIPS
    print(f"{answers} answers of {MODELS} models, {size / 1024:.0f} KB of frames each, in {seconds:.1f} s")
    print(f"{answers / seconds:.1f} a second of the {allowed:.1f} that latency and concurrency allow: ", end="")
    print(f"{answers / seconds / allowed:.2f}; {1000 * cpu / answers:.1f} ms CPU each")


if __name__ == "__main__":
    main()
