"""Recompute published values from other published values, for `assets/published/audit.csv`.

Every statement gets a verdict: `agrees` (equal at the printed digits), `within rounding` (the printed result is
possible if each printed input may be rounded in its last digit), `declared` (different, and the paper says why) or
`differs`, with the arithmetic. No rule or threshold was chosen to make statements agree. Every defect is counted once.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import fmean
from typing import Any, Literal

import numpy as np
import pandas as pd

from tools.paper_audit.claims import CLAIMS
from traps_pipeline.protocol.datasets import LONG, transfer_type
from traps_pipeline.scoring.analyses import SHARES, models_of, overall
from traps_pipeline.scoring.audit import AGREES, DECLARED, DIFFERS, ROUNDING
from traps_pipeline.scoring.published import published, published_cells, published_overall, published_rows

Verdict = Literal["agrees", "within rounding", "declared", "differs"]
_NUMBER = re.compile(r"(?<![\w.-])\d+(?:\.\d+)?(?![\w-]*[a-z])")  # own text: the paper's statements
_SLACK = 1e-9


@dataclass(frozen=True)
class AuditFinding:
    """A published statement, its recomputed value, and its line in the paper's source."""

    group: str
    statement: str
    published: str
    recomputed: str
    verdict: Verdict
    reason: str = ""
    line: str = ""


def recomputed() -> pd.DataFrame:
    """Return one row per finding, with the fields of AuditFinding as columns."""
    groups: Sequence[Callable[[], Iterator[AuditFinding]]] = (
        claims,
        overall_means,
        pecs_factors,
        gaps,
        probe_means,
        transfer_types,
        steering_means,
        steering_families,
        validation_scores,
        composition_sums,
        contradictions,
    )
    return pd.DataFrame([asdict(finding) for check in groups for finding in check()])


# --- claims.csv -------------------------------------------------------------------------------------------------------


def claims() -> Iterator[AuditFinding]:
    """Yield all statements of `claims.csv`. Raises KeyError without their arithmetic."""
    for claim in published("claims").to_dict("records"):
        published_text, recomputed = str(claim["published"]), CLAIMS[str(claim["id"])]()
        is_same = _is_same_wording(published_text, recomputed.words) if recomputed.agrees is None else recomputed.agrees
        verdict: Verdict = AGREES if is_same else DIFFERS
        reason = recomputed.reason if verdict == DIFFERS else ""
        if verdict == DIFFERS and recomputed.agrees is None:
            reason = f"{_differences(published_text, recomputed.words)}{'; ' + reason if reason else ''}"
        statement, line = f"{claim['id']}: {claim['statement']}", str(claim["line"])
        yield AuditFinding("claims", statement, published_text, _trim_zeros(recomputed.words), verdict, reason, line)


def _is_same_wording(printed: str, recomputed: str) -> bool:
    """Return whether two texts agree at the printed digits and name the same things."""
    own_numbers, printed_numbers = _numbers(recomputed), _numbers(printed)
    if len(own_numbers) != len(printed_numbers):
        return False
    close = all(
        abs(float(a) - float(b)) <= _half_unit(b) + _SLACK for a, b in zip(own_numbers, printed_numbers, strict=True)
    )
    return close and _names(printed) == _names(recomputed)


def _names(words: str) -> set[str]:
    """Return whole names in a text, so that no id matches the start of a longer one."""
    return set(re.findall(r"[a-z][\w.-]*\w", _NUMBER.sub(" ", words))) - {"to", "and", "of"}


def _numbers(words: str) -> list[str]:
    return _NUMBER.findall(words)


def _half_unit(number: str) -> float:
    """Return half of the last printed digit of a number."""
    return 0.5 * 10.0 ** -len(number.partition(".")[2])


def _differences(printed: str, recomputed: str) -> str:
    own_numbers, printed_numbers = _numbers(recomputed), _numbers(printed)
    if len(own_numbers) != len(printed_numbers) or not own_numbers:
        return "not what the tables give"
    return "differs by " + " and ".join(
        f"{float(a) - float(b):+.3g}" for a, b in zip(own_numbers, printed_numbers, strict=True)
    )


def _trim_zeros(words: str) -> str:
    """Return the words with trailing zeros of four-decimal numbers removed."""
    # own text: the paper's statements
    return re.sub(r"(\d\.\d*?[1-9])0+(?!\d)|(\d+)\.0+(?!\d)", r"\1\2", words) if re.search(r"\.\d{4}", words) else words


def _line(table: str) -> str:
    """Return the line of a table in the paper's source."""
    (place,) = published_rows("tables", name=table)
    return str(place["line"])


# --- tables against each other ----------------------------------------------------------------------------------------


def overall_means() -> Iterator[AuditFinding]:
    """Yield the overall leaderboard against means of the per-dataset table, by cell."""
    cells = published_cells()
    own_means = overall(cells).set_index(["model", "regime"]).to_dict("index")
    entry_cells = dict(iter(cells.groupby(["model", "regime"])))
    for row in published_overall().to_dict("records"):
        model, regime = row["model"], row["regime"]
        for share in SHARES:
            scale, digits, unit = (1, 3, 0.001) if share == "pecs" else (100, int(share == "false_abs"), 0.1)
            value, printed_value = float(own_means[model, regime][share]) * scale, float(row[share]) * scale
            deviation, half_unit = abs(value - printed_value), 0.5 * 10.0**-digits
            verdict: Verdict = (
                AGREES
                if deviation <= half_unit + _SLACK
                else ROUNDING
                if deviation <= half_unit + unit / 2 + _SLACK
                else DIFFERS
            )
            parts = entry_cells[model, regime][share] * scale
            sums = " + ".join(f"{part:.{3 if share == 'pecs' else 1}f}" for part in parts)
            reason = "" if verdict == AGREES else f"({sums}) / 4 = {value:.5g}, off by {value - printed_value:+.2g}"
            name = f"overall {share} of {model}, {regime}"
            figures = f"{printed_value:.{digits}f}", f"{value:.{digits + 2}f}"
            yield AuditFinding("overall", name, *figures, verdict, reason, _line("overall"))


_REPLICATION = models_of(group="replication")


def pecs_factors() -> Iterator[AuditFinding]:
    """Yield each cell's PECS against its factors, within averaging and rounding.

    PECS is computed per run and then averaged, so it differs from Acc x max(0, J) of the averages. With the printed
    deviations the mean of max(0, J) lies between max(0, J) and (J + sqrt(J^2 + s_J^2)) / 2, s_J is at most the sum of
    the deviations of AbsRec and FalseAbs, and Acc adds a covariance of at most s_Acc s_J.
    """
    for cell in published_cells().fillna(0.0).to_dict("records"):
        shares = {name: float(cell[name]) for name in ("acc", "abs_rec", "false_abs", "pecs")}
        low, high = _pecs_range(cell, shares)
        naive = shares["acc"] * max(0.0, shares["abs_rec"] - shares["false_abs"])
        is_in_range = low - 0.0005 - _SLACK <= shares["pecs"] <= high + 0.0005 + _SLACK
        verdict: Verdict = AGREES if abs(naive - shares["pecs"]) <= 0.0005 else ROUNDING if is_in_range else DIFFERS
        reason = (
            f"{shares['acc']:.3f} x ({shares['abs_rec']:.3f} - {shares['false_abs']:.3f}) = {naive:.4f}; runs and "
            f"rounding allow {low:.4f} to {high:.4f}"
        )
        name = f"PECS of {cell['model']}, {cell['dataset']}, {cell['regime']}"
        figures = f"{shares['pecs']:.3f}", f"{naive:.4f}"
        group = "replication_per_dataset" if cell["model"] in _REPLICATION else "per_dataset"
        yield AuditFinding("pecs factors", name, *figures, verdict, "" if verdict == AGREES else reason, _line(group))


def _pecs_range(cell: Mapping[Hashable, Any], shares: Mapping[str, float]) -> tuple[float, float]:
    half_unit = 0.0005  # half the last digit of a printed 0.1 %
    deviation = {name: float(cell[f"{name}_std"]) + half_unit for name in ("acc", "abs_rec", "false_abs")}
    if not (cell["acc_std"] or cell["abs_rec_std"] or cell["false_abs_std"]):  # a single run has no deviation
        deviation = dict.fromkeys(deviation, 0.0)
    s_j = deviation["abs_rec"] + deviation["false_abs"]
    j_low, j_high = (shares["abs_rec"] - shares["false_abs"] + sign * 2 * half_unit for sign in (-1, 1))
    upper_bound = (j_high + float(np.hypot(j_high, s_j))) / 2
    covariance = deviation["acc"] * s_j
    low = max(0.0, (shares["acc"] - half_unit) * max(0.0, j_low) - covariance)
    return low, (shares["acc"] + half_unit) * upper_bound + covariance


def gaps() -> Iterator[AuditFinding]:
    """Yield printed gaps against printed rates, each rate within its rounding."""
    for row in published("visual_vs_textual").to_dict("records"):
        for taxonomy in ("occlusion", "chaotic"):
            visual, textual = float(row[f"{taxonomy}_visual_pct"]), float(row[f"{taxonomy}_textual_pct"])
            printed_gap = float(row[f"{taxonomy}_gap"])
            own_value = textual / visual if visual else np.inf
            half_unit = 0.05 if printed_gap < 10 and printed_gap != round(printed_gap) else 0.5
            lowest, highest = (
                (textual - 0.05) / (visual + 0.05),
                (textual + 0.05) / (visual - 0.05) if visual > 0.05 else np.inf,
            )
            agrees = own_value == printed_gap or abs(own_value - printed_gap) <= half_unit + _SLACK
            is_reachable = lowest - half_unit <= printed_gap <= highest + half_unit
            verdict: Verdict = AGREES if agrees else ROUNDING if is_reachable else DIFFERS
            reason = (
                ""
                if agrees
                else f"{textual:g} / {visual:g} = {own_value:.2f}; rounding allows {lowest:.2f}-{highest:.2f}"
            )
            name = f"textual over visual, {taxonomy}, {row['model']}"
            yield AuditFinding(
                "gaps", name, f"{printed_gap:g}", f"{own_value:.2f}", verdict, reason, _line("visual_textual")
            )


def probe_means() -> Iterator[AuditFinding]:
    """Yield printed four-path means against means of the pairs, within rounding."""
    columns = {"auroc": "all items", "auroc_confabulated": "confabulated items"}
    for row in published_rows("probe_means"):
        pairs = published_rows("probe_transfer", model=row["model"], transfer_type=row["transfer_type"])
        for column, items in columns.items():
            mean = fmean(pair[column] for pair in pairs)
            deviation = abs(mean - row[column])
            verdict: Verdict = (
                AGREES if deviation <= 0.0005 + _SLACK else ROUNDING if deviation <= 0.001 + _SLACK else DIFFERS
            )
            name = f"four-path mean AUROC, {items}, {row['model']}, {row['transfer_type']}"
            figures = f"{row[column]:.3f}", f"{mean:.5g}"
            yield AuditFinding("probe means", name, *figures, verdict, line=_line("probe_means"))


def transfer_types() -> Iterator[AuditFinding]:
    """Yield printed transfer types against their definitions."""
    for name, table in (("probe_transfer", "probe_transfer"), ("steering_alpha10_qwen", "steering_top")):
        for row in published(name).to_dict("records"):
            own_type, printed_type = transfer_type(LONG[row["source"]], LONG[row["target"]]), str(row["transfer_type"])
            location = f"{name}: type of {row['source']} to {row['target']}" + (
                f", {row['model']}" if "model" in row else ""
            )
            reason = "" if own_type == printed_type else f"{row['source']} and {row['target']} share the taxonomy"
            verdict: Verdict = AGREES if own_type == printed_type else DIFFERS
            yield AuditFinding("transfer types", location, printed_type, own_type, verdict, reason, _line(table))


def steering_means() -> Iterator[AuditFinding]:
    """Yield the regime table of gemma-4-e4b against the means of its dose table.

    The paper calls the latter a verification run with a smaller budget and lower rates. (For qwen3-vl-8b the claims
    make the same comparison.)
    """
    prompts = {"direction_family": "all", "direction_regime": "standard", "inference_regime": "guided"}
    (printed_row,) = published_rows("steering_regime", model="gemma-4-e4b", **prompts)
    for side in ("control", "void"):
        for alpha in (0, 10):
            printed_value = printed_row[f"{side}_alpha{alpha}"]
            own_mean = fmean(
                row[f"{side}_abstention_pct"] for row in published_rows("steering_dose_gemma", alpha=alpha)
            )
            is_same, is_below = abs(own_mean - printed_value) <= 0.5 + _SLACK, own_mean < printed_value
            verdict: Verdict = AGREES if is_same else DECLARED if is_below else DIFFERS
            location = (
                "as the paper declares of the verification run"
                if is_below
                else "though the paper says that it lies below"
            )
            reason = (
                ""
                if is_same
                else f"lies {abs(own_mean - printed_value):.3g} points {'below' if is_below else 'above'}, {location}"
            )
            statement = f"gemma-4-e4b: mean {side} abstention at alpha {alpha} over the eight paths"
            yield AuditFinding("steering", statement, f"{printed_value:g}", f"{own_mean:g}", verdict, reason, "1418")


def steering_families() -> Iterator[AuditFinding]:
    """Yield the regime table's means over all paths against its families' means.

    The table does not name the prompt of the families' directions; the guided ones are assumed.
    """
    rows = published("steering_regime").query("inference_regime == 'guided' and direction_regime != 'standard'")
    for model, group in rows.groupby("model", sort=False):
        family_rows = group.set_index("direction_family")
        for side in ("control", "void"):
            column = f"{side}_alpha10"
            printed_value = float(family_rows.loc["all", column])
            families = [float(family_rows.loc[family, column]) for family in ("oc", "ch")]
            own_mean = sum(families) / 2
            # Three roundings to a whole.
            verdict: Verdict = AGREES if abs(own_mean - printed_value) <= 1 + _SLACK else DIFFERS
            sums = f"({families[0]:g} + {families[1]:g}) / 2 = {own_mean:g}"
            reason = "" if verdict == AGREES else f"{sums}: the families are not halves of the paths averaged in `all`"
            statement = f"{model}: {side} abstention at alpha 10, all paths, guided directions and inference"
            yield AuditFinding(
                "steering", statement, f"{printed_value:g}", f"{own_mean:g}", verdict, reason, _line("steering_regimes")
            )


def validation_scores() -> Iterator[AuditFinding]:
    """Yield the judge's F1 against printed precision and recall, within rounding."""
    for row in published("judge_validation").to_dict("records"):
        precision, recall, printed_f1 = float(row["precision"]), float(row["recall"]), float(row["f1"])
        own_f1 = _f1(precision, recall)
        lowest, highest = _f1(precision - 0.005, recall - 0.005), _f1(min(1.0, precision + 0.005), recall + 0.005)
        agrees = abs(own_f1 - printed_f1) <= 0.005 + _SLACK
        is_reachable = lowest - 0.005 <= printed_f1 <= highest + 0.005
        verdict: Verdict = AGREES if agrees else ROUNDING if is_reachable else DIFFERS
        reason = "" if agrees else f"rounding of precision and recall allows {lowest:.3f} to {highest:.3f}"
        figures = f"{printed_f1:.2f}", f"{own_f1:.3f}"
        yield AuditFinding("validation", f"F1, {row['category']}", *figures, verdict, reason, _line("judge_validation"))


def _f1(precision: float, recall: float) -> float:
    return 2 * precision * recall / (precision + recall)


def composition_sums() -> Iterator[AuditFinding]:
    """Yield category counts against the paper's 202 occlusion and 500 chaotic pairs."""
    counts: dict[str, int] = {}
    for row in published_rows("composition"):
        counts[row["dataset"]] = counts.get(row["dataset"], 0) + row["n"]
    for taxonomy in ("occlusion", "chaotic"):
        printed_count, own_count = counts[f"{taxonomy}_ill_posed"], counts[taxonomy]
        verdict: Verdict = AGREES if own_count == printed_count else DIFFERS
        words = str(printed_count), str(own_count)
        yield AuditFinding("composition", f"pairs of {taxonomy}", *words, verdict, line=_line("composition"))


# --- the text against itself ------------------------------------------------------------------------------------------


def contradictions() -> Iterator[AuditFinding]:
    """Yield statements that contradict another place; no arithmetic decides between."""
    for row in published_rows("contradictions"):
        lines = f"{row['line']} and {row['other_line']}"
        yield AuditFinding("contradictions", row["id"], row["statement"], row["against"], DIFFERS, line=lines)
