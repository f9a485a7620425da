"""Cases that the paper describes in words: pairs of a study's own answers that show them, side by side.

Inverted calibration, voids that guided prompting flips, visual against textual voids of one scene, and thinking against
not thinking. Cases are found in the verdicts alone; texts are read for those that are shown.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.base.sheets import csv_bytes
from traps_pipeline.judging.judging_rows import VERDICTS
from traps_pipeline.models.tables import RESPONSES
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.protocol.datasets import DATASETS, is_ill_posed, taxonomy_of
from traps_pipeline.protocol.regimes import GUIDED, STANDARD
from traps_pipeline.report.writing import environment
from traps_pipeline.scoring.analyses import REASONING_PAIRS
from traps_pipeline.storage.benchmark_tables import ITEMS

if TYPE_CHECKING:
    import pandas as pd

    from traps_pipeline.storage.workspace import Workspace

KINDS = {
    "inverted": "Abstains on the control and answers the void",
    "flipped": "Answers a void under standard and abstains on it under guided",
    "textual": "Answers the visual void and abstains on the question without an answer about the same scene",
    "thinking": "Of two members of a reasoning pair, one abstains on the void and the other answers it",
}
SHOWN = 10  # cases of a kind and model on the page; the table has all
_ITEM = ["item_id", "dataset", "side", "model", "regime", "abstained"]
COLUMNS = ["kind", "scenario_id", "sub_scenario", "run", *(f"{s}_{name}" for s in ("left", "right") for name in _ITEM)]
READ = ["item_id", "scenario_id", "sub_scenario", "side", "dataset", "model", "regime", "run", "abstained"]


def cases(verdicts: pd.DataFrame) -> pd.DataFrame:
    """COLUMNS of every case, from VERDICTS rows (READ) of the pairs: `left` and `right` are the two answers.

    Only decided answers are compared, and always of one run.
    """
    import pandas as pd

    decided = verdicts.dropna(subset=["abstained"]).assign(
        taxonomy=lambda rows: [taxonomy_of(str(name)) for name in rows["dataset"]],
        ill_posed=lambda rows: [is_ill_posed(str(name)) for name in rows["dataset"]],
        abstained=lambda rows: rows["abstained"].astype(bool),
    )
    controls, voids = (decided.loc[decided["side"] == side] for side in ("control", "void"))
    abstains, answers = voids.loc[voids["abstained"]], voids.loc[~voids["abstained"]]
    item, pair = ["item_id", "run"], ["dataset", "scenario_id", "run"]
    scene = ["taxonomy", "scenario_id", "run"]
    standard, guided = answers.loc[answers["regime"] == STANDARD], abstains.loc[abstains["regime"] == GUIDED]
    visual, textual = answers.loc[~answers["ill_posed"]], abstains.loc[abstains["ill_posed"]]
    found = [
        _matched("inverted", controls.loc[controls["abstained"]], answers, [*pair, "model", "regime"]),
        _matched("flipped", standard, guided, [*item, "model"]),
        _matched("textual", visual, textual, [*scene, "model", "regime"]),
    ]
    for thinking, other in REASONING_PAIRS:
        first, second = (voids.loc[voids["model"] == model] for model in (thinking, other))
        matched = _matched("thinking", first, second, [*item, "regime"])
        found.append(matched.loc[matched["left_abstained"] != matched["right_abstained"]])
    return pd.concat(found, ignore_index=True)


def _matched(kind: str, left: pd.DataFrame, right: pd.DataFrame, on: list[str]) -> pd.DataFrame:
    """The cases in which a row of the one and a row of the other agree in these columns."""
    import pandas as pd

    scene = [*dict.fromkeys([*on, "scenario_id", "sub_scenario", "run"])]
    first = left.assign(**{f"left_{name}": left[name] for name in _ITEM})
    second = right.assign(**{f"right_{name}": right[name] for name in _ITEM})
    merged = first[[*scene, *(f"left_{name}" for name in _ITEM)]].merge(
        second[[*on, *(f"right_{name}" for name in _ITEM)]], on=on
    )
    return merged.assign(kind=kind).reindex(columns=pd.Index(COLUMNS))


def cases_files(workspace: Workspace, clips: str | None) -> dict[str, bytes]:
    """`cases.html` with the first cases of each kind and model and their texts, `cases.csv` with all, by path.

    clips is the relative path from the page to the workspace, for links to clips; None if there are no clips.
    """
    found = cases(workspace.tables.read_all(VERDICTS, READ, dataset=DATASETS))
    found = found.sort_values(["kind", "left_model", "scenario_id", "run", "left_item_id"], kind="stable")
    shown = found.groupby(["kind", "left_model"], sort=False).head(SHOWN)
    texts = _texts(workspace, shown)
    items = {row["item_id"]: row for row in _items(workspace, shown)}
    kinds = [
        {
            "title": title,
            "total": int(np.count_nonzero(found["kind"] == kind)),
            "cases": [_case(row, items, texts) for row in shown.loc[shown["kind"] == kind].to_dict("records")],
        }
        for kind, title in KINDS.items()
    ]
    page = environment().get_template("cases.html.j2").render(kinds=kinds, most=SHOWN, clips=clips)
    return {"cases.html": page.encode(), "cases.csv": csv_bytes(found)}


def _case(row: dict[Any, Any], items: dict[str, Any], texts: dict[tuple[Any, ...], Any]) -> dict[str, Any]:
    answers = []
    for side in ("left", "right"):
        key = tuple(row[f"{side}_{name}"] for name in ("item_id", "model", "regime"))
        answers.append(
            {name: row[f"{side}_{name}"] for name in _ITEM}
            | {"text": texts.get((*key, row["run"]), ""), "item": items[row[f"{side}_item_id"]]}
        )
    return {"scenario": row["scenario_id"], "sub_scenario": row["sub_scenario"], "run": row["run"], "answers": answers}


def _texts(workspace: Workspace, shown: pd.DataFrame) -> dict[tuple[Any, ...], str]:
    """The texts of the shown answers, by item, model, regime and run; of each cell only what is shown is kept."""
    wanted = {
        (row[f"{side}_item_id"], row[f"{side}_model"], row[f"{side}_regime"], row["run"]): row[f"{side}_dataset"]
        for row in shown.to_dict("records")
        for side in ("left", "right")
    }
    cells = {Cell(dataset, Evaluation(key[1], key[2], int(key[3]))) for key, dataset in wanted.items()}
    found: dict[tuple[Any, ...], str] = {}
    for cell in sorted(cells, key=lambda cell: cell.key):
        for row in workspace.tables.read(RESPONSES, cell.partition).to_dict("records"):
            key = (row["item_id"], row["model"], row["regime"], row["run"])
            if key in wanted:
                found[key] = str(row["text"] or "")
    return found


def _items(workspace: Workspace, shown: pd.DataFrame) -> Iterator[dict[Any, Any]]:
    ids = sorted({*shown["left_item_id"], *shown["right_item_id"]})
    rows = workspace.tables.read_all(ITEMS, ["item_id", "question", "ground_truth", "clip"], dataset=DATASETS)
    yield from rows.loc[rows["item_id"].isin(ids)].to_dict("records")
