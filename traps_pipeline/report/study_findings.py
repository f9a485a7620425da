"""State a study's main findings in sentences whose numbers are in its tables."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.wording import count_noun
from traps_pipeline.models.registry.entries import is_reference, reference_rows
from traps_pipeline.protocol.regimes import GUIDED, PROMPTING, REGIMES, STANDARD
from traps_pipeline.report.catalogue import FIGURE_REPORTS, FigureReport
from traps_pipeline.report.leaderboard_page import shortfall
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.table_columns import interval, ranks
from traps_pipeline.report.writing import fraction, percent

if TYPE_CHECKING:
    import pandas as pd

REGIME_WORDS = {STANDARD: "Asked plainly (standard)", GUIDED: "Told not to guess (guided)"}


@dataclass(frozen=True)
class StudyFinding:
    """A sentence about a study, and the name of the report card with its numbers."""

    text: str
    card: str


def study_findings(results: Results) -> list[StudyFinding]:
    """Return a study's findings, the most important first. Of reference strategies only if no other model was asked."""
    overall, lacking = results.overall, shortfall(results.board) if len(results.board) else ""
    missing = [StudyFinding(lacking, "leaderboard")] if lacking else []
    model_rows = _models_first(overall).dropna(subset=["pecs"]) if len(overall) else overall
    if not len(model_rows):
        return [*missing, *_two_events(results)]
    reports = FIGURE_REPORTS if results.mechanism else ()
    figure_findings = [(report.name, _finding(report, results)) for report in reports]
    return [
        *missing, *_best(model_rows), *_abstention(model_rows), *_accuracy(model_rows), *_gaps(results, model_rows),
        *_two_events(results), *_separable(results, model_rows),
        *(() if missing else _missing_answers(model_rows)),
        *(StudyFinding(text, f"figure-{name}") for name, text in figure_findings if text),
    ]  # fmt: skip


def _finding(report: FigureReport, results: Results) -> str:
    """Return a figure's finding; empty if it cannot be made, which its card says."""
    try:
        return report.finding(results)
    except TrapsError:
        raise
    except Exception:  # noqa: BLE001 - one figure must not cost the others
        return ""


def _models_first(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of models; those of reference strategies if there are no others."""
    model_rows = rows.loc[~rows["model"].isin(reference_rows())]
    return model_rows if len(model_rows) else rows


def _best(rows: pd.DataFrame) -> Iterator[StudyFinding]:
    """Yield each regime's best model, and how many are not separable from it."""
    for regime in [name for name in REGIMES if name in {*rows["regime"]}]:
        part = rows.loc[rows["regime"] == regime].sort_values(["pecs", "model"], ascending=[False, True])
        first = part.to_dict("records")[0]
        highest = fraction(first["pecs"])
        equal, worse_rows = (
            [*part.loc[part["pecs"].map(fraction).eq(highest) == is_equal, "model"]] for is_equal in (True, False)
        )
        best = (
            "have the highest PECS," if len(equal) > 1 else "has the highest PECS," if worse_rows else "has a PECS of"
        )
        group = "" if _noun(part) == "models" else f" among {_noun(part)}"
        text = f"Under {regime},{group} {_names(equal)} {best} {highest} {interval(first)}".strip()
        if worse_rows:
            text += (
                f", before {worse_rows[0]} with {fraction(part.loc[part['model'] == worse_rows[0], 'pecs'].iloc[0])}"
            )
        rank_range = ranks(first)
        if len(equal) == 1 and "–" in rank_range:
            text += f"; its rank may be {rank_range}, since contrasts do not separate it from others"
        yield StudyFinding(f"{text}.", "leaderboard")


def _noun(rows: pd.DataFrame) -> str:
    """Return what the rows are of: models, or reference strategies alone."""
    return "reference strategies" if any(map(is_reference, rows["model"])) else "models"


def _names(models: list[str]) -> str:
    """Return up to three names, and the number of others."""
    first, n_more = models[:3], len(models) - 3
    parts = [*first, f"{n_more} more"] if n_more > 0 else first
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"


def _abstention(rows: pd.DataFrame) -> Iterator[StudyFinding]:
    for regime, words in REGIME_WORDS.items():
        part = rows.loc[rows["regime"] == regime]
        if len(part):
            subject = f"the {len(part)} {_noun(part)} abstain" if len(part) > 1 else f"{part['model'].iloc[0]} abstains"
            voids, controls = (_span(part[name]) for name in ("abs_rec", "false_abs"))
            yield StudyFinding(
                f"{words}, {subject} on {voids} of the voids, which cannot be answered, and on {controls} of the "
                "controls, which can.",
                "figure-abs_rec",
            )


def _accuracy(rows: pd.DataFrame) -> Iterator[StudyFinding]:
    """Yield how guided prompting changes Acc and AbsRec of models with both regimes."""
    by_regime = rows.loc[rows["regime"].isin(PROMPTING)].pivot(
        index="model", columns="regime", values=["acc", "abs_rec"]
    )
    if {*PROMPTING} <= {*by_regime.columns.get_level_values(1)} and len(by_regime := by_regime.dropna()):
        changes = {name: by_regime[name][GUIDED] - by_regime[name][STANDARD] for name in ("acc", "abs_rec")}
        acc, voids = (_points(changes[name]) for name in ("acc", "abs_rec"))
        yield StudyFinding(
            f"Guided prompting changes abstention on voids by {voids} points, and accuracy on controls by {acc}.",
            "table-guided_uplift",
        )


def _gaps(results: Results, rows: pd.DataFrame) -> Iterator[StudyFinding]:
    """Yield visual against textual voids."""
    rates = results.rates
    pooled_rates = (
        rates.loc[rates["taxonomy"].eq("pooled") & rates["model"].isin(rows["model"])] if len(rates) else rates
    )
    pooled_rates = pooled_rates.dropna(subset=["visual", "textual"])
    if len(pooled_rates):
        textual, visual = (percent(pooled_rates[name].to_numpy(float).mean()) for name in ("textual", "visual"))
        subject = (
            f"the {len(pooled_rates)} {_noun(pooled_rates)}"
            if len(pooled_rates) > 1
            else str(pooled_rates["model"].iloc[0])
        )
        yield StudyFinding(
            f"Asked plainly, {subject} abstain{'' if len(pooled_rates) > 1 else 's'} on {textual} % of the questions "
            f"about something that no clip shows, and on {visual} % of the clips whose outcome is hidden or cut off"
            f"{' (means)' if len(pooled_rates) > 1 else ''}.",
            "figure-visual_textual",
        )


def _two_events(results: Results) -> Iterator[StudyFinding]:
    """Yield the most specific entry's metrics of two events."""
    rows = results.two_way
    rows = _models_first(rows.dropna(subset=["specificity"])) if len(rows) else rows
    if len(rows):
        row = rows.sort_values(["specificity", "model"], ascending=[False, True]).to_dict("records")[0]
        own, other = (_signed(row[name]) for name in ("own_effect", "other_effect"))
        yield StudyFinding(
            f"Of two events in one scene, hiding the one that is asked about changes abstention by {own} points, and "
            f"hiding the other one by {other} ({row['model']} under {row['regime']}, the most specific); all eight "
            f"items are right in {percent(row['conjunction'])} % of the scenes.",
            "figure-two_way",
        )


def _separable(results: Results, rows: pd.DataFrame) -> Iterator[StudyFinding]:
    contrasts = results.contrasts
    if len(contrasts):
        models = contrasts["left_model"].isin(rows["model"]) & contrasts["right_model"].isin(rows["model"])
        is_comparison = (
            contrasts["kind"].eq("models") & contrasts["dataset"].eq("overall") & contrasts["metric"].eq("pecs")
        )
        tested = contrasts.loc[models & is_comparison & contrasts["difference"].notna()]
        if len(tested):
            count = int(tested["separable"].eq(True).sum())
            yield StudyFinding(
                f"Of {count_noun(len(tested), 'difference')} of PECS between {_noun(rows)} under one regime, {count} "
                f"{'is' if count == 1 else 'are'} significant after Holm’s correction.",
                "table-contrasts",
            )


def _missing_answers(rows: pd.DataFrame) -> Iterator[StudyFinding]:
    missing = int(np.nansum(rows["n_missing"].to_numpy(float)))
    if missing:
        worst_row = rows.sort_values(["n_missing", "model"], ascending=[False, True]).to_dict("records")[0]
        yield StudyFinding(
            f"Without text or majority: {count_noun(missing, 'answer')}; {worst_row['model']} under "
            f"{worst_row['regime']} lacks most, {int(worst_row['n_missing'])}.",
            "leaderboard",
        )


def _span(shares: pd.Series) -> str:
    """Return the smallest and largest share in percent, once if they print the same."""
    low, high = (percent(value, 0) for value in (shares.min(), shares.max()))
    return f"{low} %" if low == high else f"{low} to {high} %"


def _points(changes: pd.Series) -> str:
    """Return the smallest and the largest signed change in percentage points."""
    low, high = map(_signed, (changes.min(), changes.max()))
    return low if low == high else f"{low} to {high}"


def _signed(change: float) -> str:
    """Return a change in percentage points, with its sign."""
    return ("+" if change > 0 else "") + percent(change)
