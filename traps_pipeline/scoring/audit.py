"""Read the audit of the paper's tables, which recomputes each statement from other published values.

`python -m tools.paper_audit` recomputes `assets/published/audit.csv`: a row a statement, with the published and the
recomputed value, a verdict (`agrees`, `within rounding`, `declared`, `differs`), the arithmetic and the line in the
paper's source.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from traps_pipeline.scoring.published import as_printed

if TYPE_CHECKING:
    import pandas as pd

AGREES, ROUNDING, DECLARED, DIFFERS = "agrees", "within rounding", "declared", "differs"
_AGREEING = (AGREES, ROUNDING)


def audit() -> pd.DataFrame:
    """Return a frame with a row per statement of the paper: group, published, recomputed and other texts."""
    return as_printed("audit")


def counts_text(findings: pd.DataFrame) -> str:
    """Return a sentence with the counts of statements by verdict."""
    count = {verdict: sum(findings["verdict"] == verdict) for verdict in (*_AGREEING, DECLARED, DIFFERS)}
    n_agreeing = sum(count[verdict] for verdict in _AGREEING)
    return (
        f"{len(findings)} statements: {n_agreeing} agree ({count[ROUNDING]} of them within rounding), "
        f"{count[DECLARED]} differ as the paper declares, {count[DIFFERS]} disagree"
    )
