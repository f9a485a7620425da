"""Detect a changed model behind a name by twenty fixed items in each epoch.

An epoch that is named in `study.yaml` is asked once. Rules read the answers, whichever panel judges the study: the same
reader on both sides isolates changes of the model. Answers are sampled, so some changes are chance; the number of
changes between two quiet epochs measures that.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated, Any

import pandas as pd

from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.terminal import text_table
from traps_pipeline.judging.rules import read_statement
from traps_pipeline.models.asking.answers import answer_request
from traps_pipeline.models.asking.ask import Call, SettledCell, collect_outcomes
from traps_pipeline.models.asking.participants import Row, call_time_columns
from traps_pipeline.models.reading.interpret import read_answer
from traps_pipeline.models.reading.judged_answers import UNREAD
from traps_pipeline.models.registry.entries import NETWORK, ModelEntry, get_model
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.storage import columns as shared
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.tables import Table
from traps_pipeline.storage.workspace import Workspace

N_ITEMS = 20
CELL = Cell("occlusion", Evaluation("canary", "standard", 1))  # a name in the ledger, not a model
REGIME = "json"  # rules can read its final answers most often
COMPARED_COLUMNS = ("outcome", "abstained", "value")


@dataclass(frozen=True, kw_only=True)
class CanaryRow:
    """One answer to one of the canary's items in one epoch."""

    model: shared.Model
    item_id: shared.ItemId
    epoch: shared.Epoch
    served_model: Annotated[str | None, "what the provider says answered"]
    outcome: Annotated[str, "as in responses, or unread: the rules know no form of the text"]
    text: Annotated[str | None, "the answer; null unless outcome is answer or unread"]
    abstained: Annotated[bool | None, "as rules read it; null without an answer that they read"]
    value: Annotated[str | None, "what it commits to, as rules read it; null where it abstains or is no answer"]
    prompt_tokens: shared.Tokens
    created_at: shared.AskedAt


# A command makes this table, so it is no stage; `traps run` writes it where an experiment says `canary: true`.
CANARY = Table("canary", CanaryRow, partition_by=(), key=("model", "item_id", "epoch"))


def canary_items(workspace: Workspace) -> list[dict[str, Any]]:
    """Return each dataset's items of smallest digest. Raises TrapsError if none exist."""
    items = workspace.tables.read_all(ITEMS, dataset=DATASETS).to_dict("records")
    if not items:
        raise TrapsError("canary: no items yet; materialize items first")
    datasets = [name for name in DATASETS if any(item["dataset"] == name for item in items)]
    selection = list[dict[str, Any]]()
    for dataset in datasets:
        dataset_items = sorted((i for i in items if i["dataset"] == dataset), key=lambda item: digest(item["item_id"]))
        selection += dataset_items[: N_ITEMS // len(datasets)]
    return selection


@dataclass(frozen=True)
class _Asked(Call):
    entry: ModelEntry
    item: Mapping[str, Any]


def ask_canary(workspace: Workspace, models: Sequence[str]) -> pd.DataFrame:
    """Ask this epoch's missing items, write CANARY, and return rows of all epochs."""
    epoch, items = workspace.study.epoch, canary_items(workspace)
    entries = [entry for entry in map(get_model, models) if entry.backend == NETWORK]
    calls = [_Asked(_request(workspace, entry, item, epoch), entry, item) for entry in entries for item in items]

    def finish(settled: SettledCell[Cell, _Asked]) -> list[CanaryRow]:
        return [_row(call, row, epoch) for call, row in settled.answered()]

    new = list[CanaryRow]()
    if calls:
        (new,) = collect_outcomes(workspace, "canary", workspace.answers, entries, [CELL], lambda _: calls, finish)
    rows = pd.DataFrame([vars(row) for row in new], columns=pd.Index(CANARY.names))
    if workspace.tables.state(CANARY, {}) is not None:
        old = workspace.tables.read(CANARY, {})
        rows = pd.concat([old.loc[~old["epoch"].eq(epoch) | ~old["model"].isin(models)], rows], ignore_index=True)
    workspace.tables.write(CANARY, {}, rows, {})
    return rows


def _request(workspace: Workspace, entry: ModelEntry, item: Mapping[str, Any], epoch: str) -> Any:
    request = answer_request(workspace, entry, item, Evaluation(entry.id, REGIME, 1))
    return replace(request, about={**request.about, "canary": epoch})


def _row(call: _Asked, row: Row, epoch: str) -> CanaryRow:
    reading = read_answer(row, None, REGIME, thinking=call.entry.thinking)
    statement = None if reading.text is None else read_statement(reading.text, call.item["question"])
    return CanaryRow(
        model=call.entry.id,
        item_id=call.item["item_id"],
        served_model=row["served_model"],
        outcome=UNREAD if reading.text is not None and statement is None else reading.outcome,
        text=reading.text,
        abstained=statement and statement.value is None,
        value=statement and statement.value,
        prompt_tokens=row["prompt_tokens"],
        epoch=epoch,
        created_at=call_time_columns(row)["created_at"],
    )


def changes(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the changes from each epoch of a model to its next one, from CANARY rows.

    Columns model, from, to, served (names then and now), n (items asked in both), outcome, abstained and value (numbers
    of changed items), tokens (mean change of prompt tokens).
    """
    answers_by_model: dict[str, dict[str, dict[str, Mapping[str, Any]]]] = {}  # by model, epochs in order
    for row in rows.sort_values(["model", "created_at"], kind="stable").to_dict("records"):
        answers_by_model.setdefault(row["model"], {}).setdefault(row["epoch"], {})[row["item_id"]] = row
    change_rows = list[dict[str, Any]]()
    for model, epochs in answers_by_model.items():
        for previous_epoch, epoch in pairwise(epochs):
            answer_pairs = [
                (epochs[previous_epoch][item], row)
                for item, row in epochs[epoch].items()
                if item in epochs[previous_epoch]
            ]
            served_models = dict.fromkeys(
                str(side["served_model"]) for k in (0, 1) for side in (pair[k] for pair in answer_pairs)
            )
            tokens = [new["prompt_tokens"] - old["prompt_tokens"] for old, new in answer_pairs if _has_tokens(old, new)]
            change_rows.append(
                {
                    "model": model,
                    "from": previous_epoch,
                    "to": epoch,
                    "served": " -> ".join(served_models),
                    "n": len(answer_pairs),
                }
                | {
                    name: sum(_words(old[name]) != _words(new[name]) for old, new in answer_pairs)
                    for name in COMPARED_COLUMNS
                }
                | {"tokens": sum(tokens) / len(tokens) if tokens else float("nan")}
            )
    return pd.DataFrame(
        change_rows, columns=pd.Index(["model", "from", "to", "served", "n", *COMPARED_COLUMNS, "tokens"])
    )


def _has_tokens(*rows: Mapping[str, Any]) -> bool:
    return all(not pd.isna(row["prompt_tokens"]) for row in rows)


def _words(value: Any) -> str:
    """Return a table's value in comparable form. Null equals null in any representation."""
    return "" if pd.isna(value) else str(value)


def changes_text(rows: pd.DataFrame) -> str:
    """Return the changes as a table, or a sentence if no model has two epochs."""
    table = changes(rows)
    if table.empty:
        return "canary: asked in this epoch; name another epoch in study.yaml to ask again, and what changed is shown"
    cells = [[*row[:-1], "-" if row[-1] != row[-1] else f"{row[-1]:+.1f}"] for row in table.itertuples(index=False)]
    return "canary: items that changed\n" + text_table(list(table), cells)
