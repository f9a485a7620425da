"""The explorer at the paper's volume: how long `traps site` takes, how large its folder is, how fast its pages are.

Makes a study of the released scenarios with made-up answers: 16 models, of which one has a single run, three regimes,
three runs, 387,504 answers and 1.7 million votes with rationales. Then it writes the site and drives headless Chromium
on it over `file:`. Prints each figure with its target (for 2 cores), and exits with 1 where one is missed.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from bench.quick import parse
from traps_pipeline.benchmark.items import build_items
from traps_pipeline.benchmark.specs import build_specs
from traps_pipeline.judging.judging_rows import VERDICTS, VOTES
from traps_pipeline.judging.verdicts import ITEM_COLUMNS, RESPONSE_COLUMNS, verdicts_of
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.protocol.datasets import CATEGORIES, DATASETS
from traps_pipeline.protocol.regimes import REGIMES
from traps_pipeline.report.explorer.site import write_site
from traps_pipeline.scoring.bootstrap import intervals, resample
from traps_pipeline.scoring.contrasts import contrasts, regime_tests
from traps_pipeline.scoring.metrics import cell_metrics
from traps_pipeline.scoring.score_rows import CONTRASTS, LEADERBOARD, REGIME_TESTS
from traps_pipeline.scoring.standings import leaderboard
from traps_pipeline.storage.benchmark_tables import ITEMS, SCENE_SPECS, VIDEOS, VideoRow
from traps_pipeline.storage.parquet import write_sealed
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.tables import Table
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.video.encode import encode, frames_digest

JUDGES = ("judge-a", "judge-b", "judge-c")
RESAMPLES = 200  # of the leaderboard's intervals: how exact they are changes nothing here
CHROMIUM = shutil.which("chromium") or "/usr/bin/chromium"
QUIET = ["--no-sandbox", "--disable-gpu", "--enable-precise-memory-info"]

# --- a made-up study --------------------------------------------------------------------------------------------------

WORDS = {  # of the templates below, by their slot
    "o": "ball|block|domino|occluder|ramp|marble|lever|cube|plank|wall|gate|peg|bin|die|cylinder|wedge",
    "c": "red|cyan|yellow|green|blue|orange|purple|grey|white|black",
    "m": "rolls|slides|falls|bounces|tips|swings|stops|turns|rises|drops|leans|spins",
    "p": "left|right|the far end|the near edge|the middle|behind the occluder|the top of the ramp|its lowest point",
}
SLOTS = {slot: words.split("|") for slot, words in WORDS.items()}
SAID = (
    "At about {t} s the {c} {o} {m} towards {p}.",
    "The {c} {o} is hidden from {t} s on, so its path can only be inferred.",
    "I see the {c} {o} reach {p} before the {d} {q} {m}.",
    "Between {t} s and {u} s nothing else touches the {c} {o}.",
    "Given its speed of roughly {t} m/s, the {o} should arrive at {p}.",
    "The {d} {q} {m} first, and the {c} {o} follows at {t} s.",
    "From the frames it is clear that the {c} {o} {m} at {p}.",
    "The contact at {t} s changes the direction of the {c} {o}.",
    "No frame after {t} s shows the {d} {q} itself.",
    "Its momentum carries the {c} {o} past the {d} {q} to {p}.",
)
GUESSED = ("Answer: {a}.", "So the answer is {a}.", "Therefore it is {a}.", "**{a}**", "My final answer: {a}")
ABSTAINED = (
    "I don't know.", "This cannot be determined from the clip.", "There is not enough evidence: I don't know.",
    "The outcome is not shown, so I cannot say.",
)  # fmt: skip
WHY_ABSTAINED = (
    "The response says that the outcome cannot be determined after {t} s.",
    "It declines to commit to {a} and states that the evidence is missing.",
    "The model refuses to answer because the {c} {o} is hidden.",
)
WHY_ANSWERED = (
    "The response commits to {a} after describing the {c} {o}.",
    "It names {a} as the final answer.",
    "A definitive answer ({a}) is given although it mentions doubt about the {o}.",
)
WHY_VALUE = ("The response names {a} as its answer.", "The final answer is stated as {a}.", "It concludes with {a}.")


def slots(draw: random.Random, answer: str) -> dict[str, str]:
    """Return words for the templates."""
    drawn = {slot: draw.choice(words) for slot, words in SLOTS.items()}
    others = {"d": draw.choice(SLOTS["c"]), "q": draw.choice(SLOTS["o"])}
    return {"t": f"{draw.random() * 5:.1f}", "u": f"{draw.random() * 5:.2f}", "a": answer, **drawn, **others}


def made_study(folder: Path, models: int) -> Workspace:
    """Return a study of all released scenarios with made-up answers and votes, scored by the project's own code."""
    workspace = Workspace.create(folder, Study(name="explorer-bench", epoch="bench"))
    clip = folder / "clip.mp4"
    frames = [np.full((360, 480, 3), 3 * k, np.uint8) for k in range(75)]
    encode(frames, clip, fps=25)
    for category in CATEGORIES:
        specs, _ = build_specs(workspace, category)
        workspace.tables.write(SCENE_SPECS, {"category": category}, specs, {})
        videos = [_video(workspace, clip, frames, spec, side) for spec in specs for side in ("control", "void", "twin")]
        workspace.tables.write(VIDEOS, {"category": category}, videos, {})
    for dataset in DATASETS:
        workspace.tables.write(ITEMS, {"dataset": dataset}, build_items(workspace, dataset), {})
    items = workspace.tables.read_all(ITEMS)
    verdicts = []
    for number, evaluation in enumerate(_evaluations(models)):
        for dataset in DATASETS:
            cell = Cell(dataset, evaluation)
            responses, votes = _cell(items.loc[items["dataset"] == dataset], cell, seed=number)
            own = verdicts_of(items.loc[:, ITEM_COLUMNS], responses.loc[:, RESPONSE_COLUMNS], votes)
            for table, rows in ((RESPONSES, responses), (VOTES, votes), (VERDICTS, own)):
                _write(workspace, table, cell.partition, rows)
            verdicts.append(own)
    _score(workspace, pd.concat(verdicts, ignore_index=True))
    return workspace


def _evaluations(models: int) -> Iterator[Evaluation]:
    for model in range(models):
        for regime in REGIMES:
            for run in (1,) if model == 15 else (1, 2, 3):
                yield Evaluation(f"model-{model:02d}", regime, run)


def _video(workspace: Workspace, clip: Path, frames: list[np.ndarray], spec: Any, side: str) -> VideoRow:
    """Return a row of VIDEOS; its file is the one made-up clip under another name."""
    import hashlib

    path, content = workspace.clip(spec.scenario_id, side, spec.scene_hash), clip.read_bytes()
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        os.link(clip, path)
    height, width = frames[0].shape[:2]
    return VideoRow(
        scenario_id=spec.scenario_id, category=spec.category, side=side, path=workspace.relative(path),
        file_sha256=hashlib.sha256(content).hexdigest(), frames_sha256=frames_digest(frames[:1]),
        n_frames=len(frames), fps=25, width=width, height=height, duration_s=len(frames) / 25,
        size_bytes=len(content), scene_hash=spec.scene_hash, benchmark_version=spec.benchmark_version,
    )  # fmt: skip


def _cell(items: pd.DataFrame, cell: Cell, seed: int) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return RESPONSES and VOTES rows of a cell. A model is the likelier to abstain the higher its number."""
    draw = random.Random(f"{seed} {cell.dataset}")
    skill = (int(cell.evaluation.model[-2:]) + 1) / 17
    now, answers, votes = pd.Timestamp("2026-01-01", tz="UTC"), [], []
    for item in items.to_dict("records"):
        void = item["side"] == "void"
        abstains = draw.random() < (skill if void else 0.08)
        right = item["control_answer"] if draw.random() < 0.75 else draw.choice(item["labels"])
        words = slots(draw, right)
        said = [draw.choice(SAID).format(**slots(draw, right)) for _ in range(draw.randint(1, 3))]
        text = " ".join([*said, draw.choice(ABSTAINED) if abstains else draw.choice(GUESSED).format(**words)])
        about = {
            "item_id": item["item_id"],
            "side": item["side"],
            "epoch": "bench",
            "created_at": now,
            **cell.partition,
        }
        answers.append(
            {
                **about, "pair_id": item["pair_id"], "outcome": "answer", "text": text, "finish_reason": "stop",
                "served_model": cell.evaluation.model, "cost_usd": len(text) / 1e5, "latency_s": 1.0, "attempts": 1,
                "request_key": f"{draw.getrandbits(64):016x}",
            }
        )  # fmt: skip
        for judge in JUDGES:
            dissents = draw.random() < 0.04
            abstained = abstains ^ dissents
            why = draw.choice(WHY_ABSTAINED if abstained else WHY_ANSWERED).format(**words)
            vote = {
                **about,
                "judge": judge,
                "panel": "bench@1",
                "valid": True,
                "vote_key": f"{draw.getrandbits(64):016x}",
            }
            votes.append({**vote, "task": "abstention", "abstained": abstained, "rationale": why, "confidence": "high"})
            if not void:
                correct = not abstains and right == item["control_answer"]
                why = draw.choice(WHY_VALUE).format(**words)
                more = {"correct": correct, "judge_correct": correct, "extracted_value": right, "rationale": why}
                votes.append({**vote, "task": "correctness", **more})
    version = items["benchmark_version"].iloc[0]
    frames = pd.DataFrame(answers), pd.DataFrame(votes)
    shaped = [f.assign(benchmark_version=version) for f in frames]
    return shaped[0].reindex(columns=pd.Index(RESPONSES.names)), shaped[1].reindex(columns=pd.Index(VOTES.names))


def _write(workspace: Workspace, table: Table, partition: dict[str, Any], rows: pd.DataFrame) -> None:
    """A partition without the digest of its rows, which takes longer than everything else here and is not looked at."""
    path = workspace.tables.path(table, partition)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_sealed(path, pa.Table.from_pandas(rows, schema=table.arrow_schema(), preserve_index=False), {})


def _score(workspace: Workspace, verdicts: pd.DataFrame) -> None:
    metrics = pd.concat([cell_metrics(rows) for _, rows in verdicts.groupby("dataset")], ignore_index=True)
    resampled = resample(verdicts, RESAMPLES)
    compared = contrasts(resampled, metrics, verdicts)
    board = leaderboard(metrics, intervals(resampled), compared)
    for table, rows in ((CONTRASTS, compared), (REGIME_TESTS, regime_tests(verdicts)), (LEADERBOARD, board)):
        _write(workspace, table, {}, rows)


# --- measuring --------------------------------------------------------------------------------------------------------

# Milliseconds from the start of the navigation until what a selector names was painted.
PAINTED = """selector => new Promise(done => {
  const look = () => document.querySelector(selector)
    ? requestAnimationFrame(() => setTimeout(() => done(performance.now()))) : requestAnimationFrame(look);
  look();
})"""
# Milliseconds from a change of a control until the list below shows it.
FILTERED = """([id, value]) => new Promise(done => {
  const began = performance.now(), select = document.getElementById(id), old = document.querySelector(".status");
  select.value = value;
  select.dispatchEvent(new Event("change"));
  const look = () => document.querySelector(".status") && document.querySelector(".status") !== old
    ? requestAnimationFrame(() => setTimeout(() => done(performance.now() - began))) : requestAnimationFrame(look);
  look();
})"""
# Milliseconds from choosing an address until the answers of a pair are painted.
PAIR = """hash => new Promise(done => {
  const began = performance.now(), old = document.querySelector("h1");
  location.hash = hash;
  const look = () => document.querySelector("h1") !== old && document.querySelector(".panel .text, .panel .notice")
    ? requestAnimationFrame(() => setTimeout(() => done(performance.now() - began))) : requestAnimationFrame(look);
  look();
})"""


def memory_mb() -> float:
    """Return the largest renderer among this process's descendants: proportional set size, in MB."""
    sizes = [0.0]
    for status in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            command = status.read_bytes()
            if b"--type=renderer" in command and CHROMIUM.encode()[-8:] in command:
                lines = (status.parent / "smaps_rollup").read_text().splitlines()
                sizes += [int(line.split()[1]) / 1024 for line in lines if line.startswith("Pss:")]
        except OSError:
            continue  # it ended meanwhile, or is somebody else's
    return max(sizes)


def measure(site: Path, pairs: list[tuple[str, str]], say: Callable[[str, float, float, str], None]) -> list[str]:
    """Drive the site in Chromium; returns console messages and requests that leave the folder."""
    from playwright.sync_api import sync_playwright

    problems: list[str] = []
    index = (site / "index.html").as_uri()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=QUIET)

        def opened(hash_: str) -> Any:
            page = browser.new_page(viewport={"width": 1280, "height": 900})
            page.on("console", lambda message: problems.append(message.text))
            page.on("pageerror", lambda error: problems.append(str(error)))
            inside = site.as_uri(), "data:,"
            page.on("request", lambda r: None if r.url.startswith(inside) else problems.append(r.url))
            page.goto(index + hash_, wait_until="commit")
            return page

        for selector, hash_, target, what in (
            ("[data-name=leaderboard] .metric", "#/", 1000, "leaderboard painted"),
            (".answers .answer", "#/answers", 1500, "filter over all answers usable"),
        ):
            times = []
            for _ in range(5):
                page = opened(hash_)
                times.append(page.evaluate(PAINTED, selector))
                page.close()
            say(what, statistics.median(times), target, "ms")
        page = opened("#/answers")
        page.evaluate(PAINTED, ".answers .answer")
        changes = [
            ("choice-outcome", "confabulated"), ("choice-side", "void"), ("choice-regime", "guided"),
            ("choice-model", "model-01"), ("choice-dataset", "chaotic"), ("choice-outcome", ""), ("choice-model", ""),
            ("choice-dataset", ""), ("choice-side", ""), ("choice-regime", ""),
        ]  # fmt: skip
        say("a further filter, slowest", max(page.evaluate(FILTERED, list(each)) for each in changes), 100, "ms")
        chosen = random.Random(1).sample(pairs, 30)
        address = "#/pair/{}/{}?model=model-00&regime=standard&run=1&model2=model-01&regime2=guided&run2=2"
        times = [page.evaluate(PAIR, address.format(*pair)) for pair in chosen]
        say("a pair page, median", statistics.median(times), 300, "ms")
        say("a pair page, slowest of 30", max(times), 300, "ms")
        say("memory after 30 pairs", memory_mb(), 600, "MB")
        began = time.perf_counter()
        page.goto(index + "#/answers?q=momentum")
        page.get_by_role("status").filter(has_text=re.compile("^“momentum”: ")).wait_for(timeout=600_000)
        say("search in all texts", 1000 * (time.perf_counter() - began), float("inf"), "ms")
        say("memory after the search", memory_mb(), 600, "MB")
        for hash_, what in (
            ("#/matrix", "families x models"),
            ("#/model/model-01", "a model's page"),
            ("#/compare", "compare"),
        ):
            page.goto("about:blank")
            page.goto(index + hash_, wait_until="commit")
            say(what + ", opened", page.evaluate(PAINTED, "section tbody tr"), float("inf"), "ms")
        browser.close()
    return problems


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--models", type=int, default=16)
    parser.add_argument("--keep", type=Path, help="folder for the study, made once and used again")
    arguments = parse(parser, models=2)
    missed: list[str] = []

    def say(what: str, value: float, target: float, unit: str) -> None:
        bound = "" if target == float("inf") else f"(target {target:g} {unit})"
        print(f"{what:<34} {value:10.1f} {unit:<3} {bound}", flush=True)
        if value > target:
            missed.append(what)

    with tempfile.TemporaryDirectory() as temporary:
        folder = (arguments.keep or Path(temporary) / "study").absolute()
        if (folder / "made").is_file():
            workspace = Workspace.open(folder)
        else:
            workspace = made_study(folder, arguments.models)
            (folder / "made").touch()
        site, bare = Path(temporary) / "site", Path(temporary) / "bare"
        began = time.perf_counter()
        written = write_site(workspace, site)
        say("traps site", time.perf_counter() - began, 60, "s")
        print(f"{written.answers:,} answers, {written.votes:,} votes, {written.clips:,} clips")
        say("folder without clips", write_site(workspace, bare, clips=False).bytes / 1e6, 40, "MB")
        texts = (
            workspace.tables.read_arrow(RESPONSES, ["text"]).nbytes
            + workspace.tables.read_arrow(VOTES, ["rationale"]).nbytes
        )
        say("texts of answers and rationales", texts / 1e6, float("inf"), "MB")
        items = workspace.tables.read_all(ITEMS, ["dataset", "scenario_id"]).drop_duplicates()
        problems = measure(site, list(items.itertuples(index=False, name=None)), say)
    for problem in problems[:10]:
        print(f"console or request: {problem}")
    sys.exit(bool(problems or (missed and not arguments.quick)))


if __name__ == "__main__":
    main()
