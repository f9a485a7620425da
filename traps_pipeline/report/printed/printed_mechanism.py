"""The paper's tables of probes, directions and steering."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from traps_pipeline.report.printed.printed_columns import figures, in_text, of_paper
from traps_pipeline.report.writing import Column, PrintedTable
from traps_pipeline.scoring.published import as_printed

if TYPE_CHECKING:
    import pandas as pd

FAMILIES = ("qwen3-vl-8b", "gemma-4-e4b", "llava-next-video-7b")
PATH, TYPE = Column("path", "Source → target"), Column("transfer_type", "Transfer type")
ALPHAS = ("0", "2", "5", "10")


def probes() -> list[PrintedTable]:
    """Return probe transfer of the three families: by ordered pair, and means by transfer type."""
    pairs = _paths(as_printed("probe_transfer"))
    pairs["best_layer"] = "L" + pairs["best_layer"]
    wide: pd.DataFrame = pairs.loc[:, ["transfer_type", "path"]].drop_duplicates()
    columns = [TYPE, PATH]
    for model in FAMILIES:
        names = {
            f"{model}_{field}": f"{model}, {word}"
            for field, word in (("best_layer", "layer"), ("auroc", "AUC"), ("auroc_confabulated", "Cf"))
        }
        part = pairs.query("model == @model").add_prefix(f"{model}_").rename(columns={f"{model}_path": "path"})
        wide = wide.merge(part[["path", *names]], on="path")
        columns += figures(names)
    means = as_printed("probe_means")
    means["both"] = means["auroc"] + " / " + means["auroc_confabulated"]
    by_type = means.pivot(index="transfer_type", columns="model", values="both")
    by_type = by_type.loc[[*dict.fromkeys(means["transfer_type"])]].reset_index()
    return [
        of_paper("probe_transfer", wide, columns),
        of_paper("probe_means", by_type, [TYPE, *figures({model: model for model in FAMILIES})]),
        *in_text("probes"),
    ]


def cosines() -> list[PrintedTable]:
    """Return cosines of the directions of the first family, and what the text says of the others."""
    rows = as_printed("cosine_qwen")
    order = [*dict.fromkeys(rows["source"])]
    rows["cosine"] = rows["cosine"].str.replace("-", "−")
    wide = rows.pivot(index="source", columns="other", values="cosine").loc[order].reset_index()
    columns = [Column("source", "Direction"), *figures({name: name for name in order})]
    return [of_paper("cosines", wide, columns), *in_text("cosines")]


def steering() -> list[PrintedTable]:
    """Return steering by regimes and families, at alpha 10, by alpha, and within or across domains."""
    return [_regimes(), _top(), _domains(), _dose("qwen"), _dose("gemma"), *in_text("steering")]


def _regimes() -> PrintedTable:
    import pandas as pd

    short = {"standard": "Std", "guided": "Gui"}
    families = {"oc": "Oc-family", "ch": "Ch-family"}
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for row in as_printed("steering_regime").to_dict("records"):
        family = str(row["direction_family"])
        first = short[row["direction_regime"]] if family == "all" else families[family]
        second = short[row["inference_regime"]] if family == "all" else "guided inf."
        rows.setdefault((first, second), {})[str(row["model"])] = _cell(row)
    table = pd.DataFrame([{"directions": d, "inference": i, **cells} for (d, i), cells in rows.items()])
    names = {"qwen3-vl-8b": "qwen3-vl-8b (L20)", "gemma-4-e4b": "gemma-4-e4b (L35)"}
    names["llava-next-video-7b"] = "llava-next-video-7b (L28)"
    columns = [Column("directions", "Dir."), Column("inference", "Inf."), *figures(names)]
    return of_paper("steering_regimes", table, columns)


def _cell(row: Mapping[Any, Any]) -> str:
    sides = [f"{row[f'{side}_alpha0']}→{row[f'{side}_alpha10']}" for side in ("control", "void")]
    return " / ".join(sides)


def _top() -> PrintedTable:
    columns = [PATH, TYPE, *figures({"control_abstention_pct": "Ctrl ↑", "void_abstention_pct": "Void ↓"})]
    return of_paper("steering_top", _paths(as_printed("steering_alpha10_qwen")), columns)


def _domains() -> PrintedTable:
    rows = as_printed("same_domain_qwen")
    rows["target"] = "→ " + rows["same_target"] + " / → " + rows["cross_target"]
    for field in ("same_domain_pct", "cross_domain_pct"):
        rows[field] = rows[field] + "%"
    columns = [Column("direction", "Direction"), Column("target", "Target")]
    columns += figures({"same_domain_pct": "Same-dom.", "cross_domain_pct": "Cross-dom."})
    return of_paper("steering_domains", rows, columns)


def _dose(family: str) -> PrintedTable:
    rows = _paths(as_printed(f"steering_dose_{family}"))
    wide: pd.DataFrame = rows.loc[:, ["path"]].drop_duplicates()
    sides, names = {"control_abstention_pct": "C", "void_abstention_pct": "V"}, dict[str, str]()
    for alpha in ALPHAS:
        for side, letter in sides.items():
            part = rows.loc[rows["alpha"] == alpha, ["path", side]]
            wide = wide.merge(part.rename(columns={side: f"{letter}{alpha}"}), on="path")
    # The first family's table alternates the sides at each alpha; the other has all controls first.
    order = [(letter, alpha) for alpha in ALPHAS for letter in sides.values()]
    for letter, alpha in order if family == "qwen" else sorted(order, key=lambda pair: pair[0]):
        names[f"{letter}{alpha}"] = f"{letter}, α {alpha}"
    return of_paper(f"steering_dose_{family}", wide, [PATH, *figures(names)])


def _paths(rows: pd.DataFrame) -> pd.DataFrame:
    return rows.assign(path=rows["source"] + " → " + rows["target"])
