"""Compute `claims.csv`'s statements on probes and steering from published tables."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from statistics import fmean, median

from traps_pipeline.scoring.published import published_rows

QWEN, GEMMA, LLAVA = "qwen3-vl-8b", "gemma-4-e4b", "llava-next-video-7b"
TYPES = ("Cross-modality", "Cross-domain", "Cross-both")
DOSE_AGAINST_REGIME = (
    "the eight rows of the dose table repeat one alpha 0 cell a target (control 18 on ch and ch_ip, 0 on oc and oc_ip; "
    "void 76, 90, 46, 100); only with another ch target in place of ch to oc_ip would alpha 0 be 11.25 and 66.5"
)


@dataclass(frozen=True)
class Recomputed:
    """A recomputed statement in the published wording, and why it may differ.

    agrees: the verdict on a statement in words; None if the audit compares the numbers and names of both texts.
    """

    words: str
    reason: str = ""
    agrees: bool | None = None


def text_figure(name: str) -> float:
    """Return a figure that only the paper's text states, by its id in `other.csv`."""
    (row,) = published_rows("other", id=name)
    return float(row["value"])


def _best() -> Recomputed:
    best = max(published_rows("probe_transfer", model=QWEN), key=lambda row: row["auroc"])
    return Recomputed(f"{best['auroc']:.3f} ({best['source']} to {best['target']})")


def _mean(model: str, kind: str, column: str) -> float:
    return fmean(row[column] for row in published_rows("probe_transfer", model=model, transfer_type=kind))


def _shifts(model: str) -> list[float]:
    return [_mean(model, kind, "auroc") - _mean(model, kind, "auroc_confabulated") for kind in TYPES]


def _replication() -> Recomputed:
    means = [_mean(model, kind, "auroc") for model in (GEMMA, LLAVA) for kind in TYPES]
    return Recomputed(f"{min(means):.4f} to {max(means):.4f}")


def _replication_shift() -> Recomputed:
    largest_shift = max(_shifts(GEMMA) + _shifts(LLAVA))
    shift_text = ", ".join(f"{value:.3f}" for value in _shifts(GEMMA))
    reason = f"the bound of line 386 is stated of {QWEN}; the three shifts of {GEMMA} are {shift_text}"
    return Recomputed(f"{largest_shift:.3f}", reason, agrees=largest_shift <= 0.035)


def _across_domains() -> Recomputed:
    best = max(row["auroc"] for row in published_rows("probe_transfer", model=QWEN, transfer_type="Cross-domain"))
    return Recomputed(f"{best:.3f}", "0.913 is a Cross-both pair; the other two families reach 0.964 and 0.962")


def _medians() -> Recomputed:
    of = [
        [row["auroc_confabulated"] for row in published_rows("probe_transfer", model=m)] for m in (QWEN, GEMMA, LLAVA)
    ]
    medians = [median(values) for values in of]
    return Recomputed(f"{min(medians):.4f} to {max(medians):.4f}")


def _mean_layer(kind: str) -> Recomputed:
    return Recomputed(f"{_mean(QWEN, kind, 'best_layer'):.2f}")


def _near_chance() -> Recomputed:
    return Recomputed(f"{sum(row['auroc_confabulated'] <= 0.57 for row in published_rows('probe_transfer'))}")


def _dose(side: str) -> Recomputed:
    of = [published_rows("steering_dose_qwen", alpha=alpha) for alpha in (0, 10)]
    first, last = (fmean(row[f"{side}_abstention_pct"] for row in rows) for rows in of)
    return Recomputed(f"{first:g} and {last:g}", DOSE_AGAINST_REGIME)


def _families() -> Recomputed:
    occlusion, chaotic = (
        published_rows("steering_regime", model=QWEN, direction_family=family)[0]["control_alpha10"]
        for family in ("oc", "ch")
    )
    return Recomputed(f"{occlusion} and {chaotic}")


def _family_values(family: str, column: str, **where: object) -> list[float]:
    rows = published_rows("steering_dose_qwen", **where)
    return [row[column] for row in rows if row["source"].removesuffix("_ip") == family]


def _chaotic_control() -> Recomputed:
    largest_share = max(_family_values("ch", "control_abstention_pct"))
    return Recomputed(f"{largest_share:g}", "ch_ip to ch has 36, 60 and 96, and ch_ip to oc has 6 at alpha 5")


def _chaotic_void() -> Recomputed:
    rates = _family_values("ch", "void_abstention_pct")
    return Recomputed(f"{min(rates):g} to {max(rates):g}", "only ch to oc stays there; ch_ip to oc falls from 46 to 28")


def _single_paths() -> Recomputed:
    rates = [row["control_abstention_pct"] for row in published_rows("steering_alpha10_qwen")]
    return Recomputed(f"{min(rates):g} to {max(rates):g}", "54 is the mean over the eight paths")


def _same_paths() -> Recomputed:
    first, second = (
        {(row["source"], row["target"]) for row in published_rows(name)}
        for name in ("steering_alpha10_qwen", "steering_dose_gemma")
    )
    return Recomputed(
        f"{len(first & second)} of {len(first)}", "six of the first eight cross domains, none of the other"
    )


def _alpha0_of_families() -> Recomputed:
    values = [
        fmean(_family_values(family, f"{side}_abstention_pct", alpha=0))
        for family in ("oc", "ch")
        for side in ("control", "void")
    ]
    reason = "no direction is added at alpha 0, so the families differ by their targets; the regime table has one value"
    return Recomputed(" and ".join(f"{value:g}" for value in values), reason)


def _alpha0_of_gemma() -> Recomputed:
    rows = published_rows("steering_dose_gemma", alpha=0, target="oc_ip")
    rates = sorted({row["control_abstention_pct"] for row in rows})
    reason = "greedy answers to the same items without an intervention; occlusion, which has the same controls, has 24"
    return Recomputed(" and ".join(f"{rate:g}" for rate in rates), reason)


def _sweep_alpha0() -> Recomputed:
    rows = [published_rows("other", id=f"depth-gemma-{layer}")[0] for layer in (1, 17, 35)]
    reason = "no layer is touched at alpha 0; the regime table, of the guided regimes, has 25"
    return Recomputed(" and ".join(str(row["value"]).split(" to ")[0] for row in rows), reason)


def _sweep(*splits: str) -> Recomputed:
    values = [text_figure(f"depth-gemma-35-{split}") for split in splits]
    return Recomputed(f"{fmean(values):g}", f"mean of {' and '.join(f'{value:g}' for value in values)}")


MECHANISM: dict[str, Callable[[], Recomputed]] = {
    "probe-best-qwen": _best,
    "probe-cf-shift": lambda: Recomputed(f"{max(_shifts(QWEN)):.4f}"),
    "probe-cf-medians": _medians,
    "probe-replication": _replication,
    "probe-replication-shift": _replication_shift,
    "probe-across-domains": _across_domains,
    "mean-layer-modality": lambda: _mean_layer("Cross-modality"),
    "mean-layer-domain": lambda: _mean_layer("Cross-domain"),
    "probe-near-chance": _near_chance,
    "steer-control": lambda: _dose("control"),
    "steer-void": lambda: _dose("void"),
    "steer-family": _families,
    "steer-chaotic-control": _chaotic_control,
    "steer-chaotic-void": _chaotic_void,
    "steer-single-paths": _single_paths,
    "steer-same-paths": _same_paths,
    "steer-alpha0-families": _alpha0_of_families,
    "steer-alpha0-gemma": _alpha0_of_gemma,
    "sweep-alpha0": _sweep_alpha0,
    "sweep-chaotic": lambda: _sweep("ch", "ch_ip"),
    "sweep-occlusion": lambda: _sweep("oc", "oc_ip"),
}
