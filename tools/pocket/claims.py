"""The claims of the report, measured in two models that were trained alike but for one thing: the gap.

Both see the same scenes in the same order. One abstains on voids under the guided prompts alone, the other under every
prompt, so that a claim about the gap should hold in the first and fail in the second.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from traps_pipeline.report.study_results import StudyResults
from traps_pipeline.report.tables.claims import (
    CLAIMS,
    MODEL,
    NO_GAP,
    SUBJECT_NAMES,
    SUBJECTS,
    claim_frame,
    verdict,
)

if TYPE_CHECKING:
    from tools.pocket.seeds import Figure
    from traps_pipeline.storage.workspace import Workspace


def claimed(workspace: Workspace) -> dict[tuple[str, str], float]:
    """Return the figures of a finished study of one model by claim and subject, without those that it has not."""
    rows = claim_frame(StudyResults(workspace)).to_dict("records")
    figures = {(row["claim"], name): row[f"in_{name}"] for row in rows for name in SUBJECTS if name != NO_GAP}
    return {key: float(value) for key, value in figures.items() if value is not None and value == value}


def markdown(gap: Sequence[Figure], no_gap: Sequence[Figure]) -> str:
    """Return the table of the card: each claim in the model, its controls and the other model, by training seed."""
    subjects = [name for name in SUBJECTS if name == NO_GAP or any(figure.subject == name for figure in gap)]
    heads = ["claim", "holds if", *(SUBJECT_NAMES[name] for name in subjects), "verdict"]
    lines = [f"| {' | '.join(heads)} |", "|" + " --- |" * len(heads)]
    for claim in CLAIMS:
        values = {
            name: [f.value for f in figures if f.claim == claim.name and f.subject == subject]
            for name, figures, subject in (*((s, gap, s) for s in SUBJECTS[:-1]), (NO_GAP, no_gap, MODEL))
        }
        if not values[MODEL]:
            continue
        worst = {name: min(of) if name == MODEL else max(of) for name, of in values.items() if of}
        cells = [", ".join(f"{value:.2f}" for value in values[name]) or "–" for name in subjects]
        columns = [claim.says, claim.holds_if, *cells, verdict(claim, worst)]
        lines.append(f"| {' | '.join(columns)} |")
    return "\n".join(lines)
