"""Tabulate whether states, rivals and answers follow the asked one of two events."""

from __future__ import annotations

from traps_pipeline.mechanism.control_rows import STATES
from traps_pipeline.protocol.regimes import RANDOM_WEIGHTS
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.inside_columns import why_not
from traps_pipeline.report.tables.table_columns import MODEL
from traps_pipeline.report.writing import Column, PrintedTable

_COLUMNS = (
    MODEL, Column("prompt", "Prompt"), Column("features", "Read from"), Column("layer", "Layer", "count"),
    Column("held_out", "Held out"), Column("auroc", "AUROC", "fraction", 2), Column("auroc_low", "from", "fraction", 2),
    Column("auroc_high", "to", "fraction", 2), Column("within", "Within a clip", "fraction", 2),
    Column("within_low", "from", "fraction", 2), Column("within_high", "to", "fraction", 2),
    Column("confound", "Confound", "fraction", 2), Column("own_effect", "Own effect", "fraction", 2),
    Column("other_effect", "Other effect", "fraction", 2), Column("answers_own", "Answers: own", "fraction", 2),
    Column("answers_other", "other", "fraction", 2), Column("n_clips", "Clips", "count"),
)  # fmt: skip
_NOTES = (
    "of clips that hide one of two events, under both questions: AUROC of a probe for “the asked event is hidden”; "
    "within a clip: share whose hidden event’s question is scored above the other one; at the chosen layer",
    "confound: the same probe over all eight items, where the number of boards tells; it claims nothing; raw inputs "
    "are at .5 by design, margin and logits are the output",
    "own and other effect of hiding: in scores, in their standard deviations; in answers, shares that abstain",
)


def interaction_table(results: Results) -> PrintedTable:
    """Return INTERACTION at the chosen layers, states with the answers of the same model beside them."""
    rows = results.interaction
    rows = rows.loc[rows["chosen"].eq(True)].astype({"model": object, "prompt": object})
    rows = rows.loc[rows["features"].eq(STATES) | ~rows["prompt"].isin(RANDOM_WEIGHTS)]  # rivals are the same there
    rows = rows.assign(layer=rows["layer"].where(rows["layer"] >= 0))
    effects = {"regime": "prompt", "own_effect": "answers_own", "other_effect": "answers_other"}
    answers = results.two_way.rename(columns=effects)[["model", *effects.values()]].astype({"model": object})
    rows = rows.merge(answers, on=["model", "prompt"], how="left")
    is_one = rows["joins"].isna() & (rows["features"] == STATES)
    rows[["answers_own", "answers_other"]] = rows[["answers_own", "answers_other"]].where(is_one)
    reason = why_not(results, "the paper has no two events")
    notes = _NOTES if len(rows) else ()
    return PrintedTable("interaction", "Is the asked event the hidden one?", rows, _COLUMNS, notes, reason)
