"""Every kind of file that is read from elsewhere, or could have been damaged: a whole one, and what reads it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.build.ledger import local, paid, write
from tests.conftest import ROOT
from tools.pocket.recipe import load_recipe
from traps_pipeline.benchmark.composition import load_composition
from traps_pipeline.benchmark.corrections import apply_corrections, read_corrections
from traps_pipeline.benchmark.records import load_release, load_released, released_lines
from traps_pipeline.exchange.answer_exchange import checked_answers
from traps_pipeline.judging.confabulation_protocol import load_protocol
from traps_pipeline.judging.robustness import load_attacks
from traps_pipeline.models.money.account_budget import AccountBudget
from traps_pipeline.models.registry.entries import load_accounts, load_models
from traps_pipeline.models.registry.judges import load_judges, load_panel
from traps_pipeline.models.request import Request
from traps_pipeline.people.judge_validation import LABEL_COLUMNS, read_labels
from traps_pipeline.pipeline.experiment import load_experiment
from traps_pipeline.scenes.worlds.spec import load_trajectory
from traps_pipeline.storage.workspace import Workspace

ASSETS, SPECS = ROOT / "assets", ROOT / "scene_specs"


@dataclass(frozen=True)
class Reader:
    """One kind of file. file: its place in a folder; whole: content that is read without complaint; read: reads the
    folder; may_raise: what else than TrapsError it raises for damage, which its callers turn into one."""

    file: str
    whole: bytes
    read: Callable[[Path], Any]
    may_raise: tuple[type[Exception], ...] = ()


def _uncached(reader: Any, file: str) -> Callable[[Path], Any]:
    """A reader that remembers what it read reads anew."""
    return lambda folder: getattr(reader, "__wrapped__", reader)(folder / file)


def _few(path: Path, lines: int = 2) -> bytes:
    return b"".join(path.read_bytes().splitlines(keepends=True)[:lines])


def _ledger(folder: Path) -> Any:
    ledger = local(folder)
    return ledger.read("m").rows, ledger.totals(), ledger.reasoning("m")


def _accounts(folder: Path) -> Any:
    return AccountBudget("openai", folder, "s").spent_usd


def _corrected(folder: Path) -> Any:
    return apply_corrections(load_released(), read_corrections(folder))


def _line(**fields: Any) -> bytes:
    return json.dumps(fields).encode() + b"\n"


CORRECTIONS = _line(
    scenario_id="bounce-0001", action="correct", question="Is it?", who="a", when="2026-11-21", why="b"
) + _line(scenario_id="bounce-0002", action="discard", who="a", when="2026-11-21", why="b")
ANSWERS = b"".join(_line(key=key * 64, outcome="answer", text="left", prompt_tokens=10) for key in "ab")
WANTED = {key * 64: Request("m", "api", {}, "s", "u", {}) for key in "ab"}
STUDY = b"name: study\nformat: 1\nbenchmark: released\nper_family: 2\nbudget_usd: 12.5\nmodel_budgets_usd: {m: 1}\n"
ROWS = b"".join(
    _line(key=f"{n}", outcome="answer", text="left", cost_usd=0.25, components={"participant": "m"}) for n in range(3)
)
LABELS = ",".join(LABEL_COLUMNS).encode() + b"".join(
    b"\r\n" + b",".join(value.get(name, b"yes") for name in LABEL_COLUMNS)
    for value in ({"annotator": who, "sample_id": b"a"} for who in (b"one", b"two"))
)


def _written(folder: Path) -> bytes:
    """The file of a ledger, as this version writes it."""
    rows = [paid(f"{n}", 0.25) | {"latency_s": 1.0} for n in range(3)]
    write(local(folder), *rows)
    content = (folder / "ledger.sqlite").read_bytes()
    shutil.rmtree(folder)
    return content


def readers(scratch: Path) -> dict[str, Reader]:
    """All of them, by name."""
    trajectory = SPECS / "released" / "trajectories" / "bounce-0001.npz"
    sha256 = load_released()["bounce-0001"].trajectory_sha256
    models, judges = (ASSETS / "models.yaml").read_bytes(), (ASSETS / "judges.yaml").read_bytes()
    return {
        "experiment": Reader(
            "demo.yaml",
            (ASSETS / "experiments" / "demo.yaml").read_bytes(),
            lambda folder: load_experiment(str(folder / "demo.yaml")),
        ),
        "mechanism": Reader(
            "mechanism.yaml",
            (ASSETS / "experiments" / "mechanism.yaml").read_bytes(),
            lambda folder: load_experiment(str(folder / "mechanism.yaml")),
        ),
        "study": Reader("study.yaml", STUDY, Workspace.open),
        "models": Reader("models.yaml", models, _uncached(load_models, "models.yaml")),
        "accounts": Reader("models.yaml", models, _uncached(load_accounts, "models.yaml")),
        "judges": Reader("judges.yaml", judges, _uncached(load_judges, "judges.yaml")),
        "panel": Reader("judges.yaml", judges, lambda folder: load_panel.__wrapped__("rules", folder / "judges.yaml")),
        "release": Reader(
            "benchmark.yaml", (SPECS / "benchmark.yaml").read_bytes(), _uncached(load_release, "benchmark.yaml")
        ),
        "composition": Reader(
            "composition.yaml",
            (SPECS / "composition.yaml").read_bytes(),
            _uncached(load_composition, "composition.yaml"),
        ),
        "confabulation": Reader(
            "confabulation.yaml",
            (ASSETS / "confabulation.yaml").read_bytes(),
            _uncached(load_protocol, "confabulation.yaml"),
        ),
        "attacks": Reader(
            "attacks.yaml", (ASSETS / "injected_answers.yaml").read_bytes(), _uncached(load_attacks, "attacks.yaml")
        ),
        "recipe": Reader(
            "recipe.yaml",
            (ASSETS / "pocket" / "recipe.yaml").read_bytes(),
            lambda folder: load_recipe(folder / "recipe.yaml"),
        ),
        "records": Reader(
            "bounce.jsonl",
            _few(SPECS / "released" / "bounce.jsonl"),
            lambda folder: [line.spec for line in released_lines.__wrapped__(folder).values()],
        ),
        "corrections": Reader("review.jsonl", CORRECTIONS, _corrected),
        "answers": Reader("answers.jsonl", ANSWERS, lambda folder: checked_answers(folder / "answers.jsonl", WANTED)),
        "labels": Reader("labels.csv", LABELS, lambda folder: read_labels(folder / "labels.csv", ["a"])),
        "ledger": Reader("ledger.sqlite", _written(scratch / "ledger"), _ledger),
        "account": Reader("budget.yaml", b"usd: 500\n", _accounts),
        "trajectory": Reader(
            "bounce-0001.npz",
            trajectory.read_bytes(),
            lambda folder: load_trajectory(folder / "bounce-0001.npz", sha256),
            (ValueError,),
        ),
    }
