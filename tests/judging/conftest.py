"""VOTES rows made by hand, and studies with answers that no model was asked for."""

from __future__ import annotations

import datetime
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from tests.conftest import KEY
from tests.providers.server import Provider
from traps_pipeline.judging.judging_rows import VOTES
from traps_pipeline.models.asking import participants
from traps_pipeline.models.asking.answer_rows import RESPONSES, ResponseRow
from traps_pipeline.models.asking.answers import answer_request, response_row
from traps_pipeline.models.asking.participants import ledger_row
from traps_pipeline.models.registry.entries import Account, Limits, Prices, get_model
from traps_pipeline.models.registry.judges import JudgeEntry
from traps_pipeline.models.request import Outcome
from traps_pipeline.models.wire import api
from traps_pipeline.protocol.cells import Cell
from traps_pipeline.protocol.datasets import is_ill_posed, taxonomy_of
from traps_pipeline.storage.benchmark_tables import ITEMS, ItemRow
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

DECISIONS = {"y": True, "n": False, "-": None}


def vote_rows(
    answers: Sequence[str],
    task: str = "void_abstention",
    dataset: str = "occlusion",
    judges: Sequence[str] = ("a", "b", "c"),
    **cell: Any,
) -> pd.DataFrame:
    """VOTES rows of answers, each a string with one of y (yes), n (no) and - (invalid) for each judge."""
    side = "void" if task == "void_abstention" else "control"
    kind = "correctness" if task == "correctness" else "abstention"
    about: dict[str, Any] = {"model": "m", "regime": "standard", "run": 1, "epoch": "e1"}
    about |= {"panel": "three@1", "benchmark_version": "v1"} | cell
    rows = []
    for k, answer in enumerate(answers):
        for judge, word in zip(judges, answer, strict=True):
            decision = DECISIONS[word]
            row = dict.fromkeys(VOTES.names) | about
            row |= {"item_id": f"{dataset}:s-{k:04d}:{side}", "side": side, "dataset": dataset, "task": kind}
            row |= {"judge": judge, "valid": decision is not None}
            row |= {"abstained": decision} if kind == "abstention" else {"correct": decision}
            rows.append(row)
    return pd.DataFrame(rows)


def item_row(dataset: str, number: int, side: str) -> dict[str, Any]:
    """An ITEMS row of a two-sided question; its clip need not be there, since reference models watch none."""
    pair = f"{dataset}:s-{number:04d}"
    question = "What does the ball weigh?" if side == "void" and is_ill_posed(dataset) else "Left or right?"
    return {
        "item_id": f"{pair}:{side}",
        "pair_id": pair,
        "dataset": dataset,
        "scenario_id": f"s-{number:04d}",
        "side": side,
        "taxonomy": taxonomy_of(dataset),
        "category": "hidden",
        "sub_scenario": "hidden_race",
        "question": question,
        "labels": ["left", "right"],
        "aliases": json.dumps({"left bin": "left"}),
        "answer_type": "direction",
        "ground_truth": "left" if side == "control" else None,
        "control_answer": "left",
        "commonest_answer": "left",
        "clip": f"clips/{number}.mp4",
        "media_digest": f"{number:064d}",
        "item_hash": f"{number}",
        "benchmark_version": "v1",
    }


def answered_study(
    root: Path, answers: Mapping[Cell, Mapping[tuple[int, str], str]], panel: str = "rules", **study: Any
) -> Workspace:
    """A workspace whose items and responses are these: by cell, number and side to the text of the answer.

    A text that holds `<think>` is a trace and an answer, parted by it.
    """
    workspace = Workspace.create(root, Study(panel=panel, epoch="e1", **study))
    for dataset in {cell.dataset for cell in answers}:
        numbers = {place for cell, texts in answers.items() if cell.dataset == dataset for place in texts}
        items = [ItemRow(**item_row(dataset, number, side)) for number, side in sorted(numbers)]
        workspace.tables.write(ITEMS, {"dataset": dataset}, items, {})
    for cell, texts in answers.items():
        rows = [_response(workspace, cell, *place, text) for place, text in texts.items()]
        workspace.tables.write(RESPONSES, cell.partition, rows, {})
    return workspace


def _response(workspace: Workspace, cell: Cell, number: int, side: str, text: str) -> ResponseRow:
    item = item_row(cell.dataset, number, side)
    trace, _, answer = text.rpartition("<think>")
    request = answer_request(workspace, get_model("oracle"), item, cell.evaluation)
    row, beside = ledger_row(request, Outcome("answer", answer, reasoning=trace or None), 1, 0.1, "e1")
    return response_row(cell, item, row, beside.get("reasoning"))


@pytest.fixture
def judge_at(provider: Provider, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], JudgeEntry]:
    """Makes judges that are asked at the test provider, over HTTP."""
    account = Account(key=KEY, base_url=f"{provider.url}/v1")
    for module in (api, participants):
        monkeypatch.setattr(module, "load_accounts", lambda: {"here": account})

    def judge(name: str) -> JudgeEntry:
        fields = {
            "id": name,
            "backend": "api",
            "account": "here",
            "provider_id": f"openai/{name}",
            "params": {"temperature": 0.8, "max_tokens": 512},
            "limits": Limits(concurrency=12, backoff_s=0.01),
            "prices": Prices(input=0.5, output=3.0, as_of=datetime.date(2026, 11, 1)),
        }
        return JudgeEntry.model_validate(fields, context={"accounts": {"here": account}})

    return judge
