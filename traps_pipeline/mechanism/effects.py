"""Compute steering tables: abstention by path, strength, side (docs/spec.md 8.4).

Effects are rows of the `steering_effects` table, or the paper's in the same columns: model, directions, regime, source,
target, kind, layer, alpha, side, abstention (a fraction).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, cast

from traps_pipeline.mechanism.directions import KINDS
from traps_pipeline.mechanism.transfer_paths import PATH_SETS
from traps_pipeline.protocol.datasets import DATASETS, is_ill_posed, taxonomy_of, transfer_type
from traps_pipeline.protocol.regimes import GUIDED

if TYPE_CHECKING:
    import pandas as pd

CELL = ["model", "directions", "regime"]
EXTRA_COLUMNS = ("n", "gaps", "broken")  # answers, dose in class gaps, share of degenerate answers
REGIME_COLUMNS = (
    *("model", "path_set", "family", "directions", "regime", "kind", "n_paths", "alpha"),
    *("control_0", "control_top", "void_0", "void_top"),
)


def two_sided_effects(effects: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of effects at the steered layer; a sweep's other layers have only controls."""
    layers = effects.loc[effects["side"] == "void", [*CELL, "layer"]].drop_duplicates()
    return effects.merge(layers, on=[*CELL, "layer"])


def paths(effects: pd.DataFrame) -> pd.DataFrame:
    """Return a frame of abstention on controls and voids, by steering path (source to target) and strength.

    The column transfer_type is added. If the effects have intervals, counts, doses in class gaps or shares of
    degenerate answers, there are also columns `control_low` and so on.
    """
    import pandas as pd

    keys = [*CELL, "source", "target", "kind", "layer", "alpha"]
    rows, columns = two_sided_effects(effects), keys.copy()
    parts: list[pd.DataFrame] = []
    for value, suffix in [("abstention", ""), *((name, f"_{name}") for name in ("low", "high", *EXTRA_COLUMNS))]:
        if value in rows:
            means = rows.groupby([*keys, "side"], observed=True, dropna=False)[value].mean()
            sides = cast("pd.Series", means).unstack("side")
            parts.append(sides.dropna(how="all").reindex(columns=pd.Index(["control", "void"])).add_suffix(suffix))
            columns += [f"control{suffix}", f"void{suffix}"]
    sides = parts[0].join(parts[1:]).reset_index().reindex(columns=pd.Index(columns))
    types = [transfer_type(s, t) for s, t in zip(sides["source"], sides["target"], strict=True)]
    return _in_order(sides.assign(transfer_type=types))


def regime_matrix(effects: pd.DataFrame) -> pd.DataFrame:
    """Return a frame of mean abstention over sets of steering paths, unsteered and at the largest alpha, by regimes."""
    return _regime_rows(effects, lambda source: "all")


def family_asymmetry(effects: pd.DataFrame) -> pd.DataFrame:
    """Return a frame of the effects of guided directions by the taxonomy of the data they were computed from."""
    guided = effects.loc[(effects["directions"] == GUIDED) & (effects["regime"] == GUIDED)]
    return _regime_rows(guided, taxonomy_of)


def _regime_rows(effects: pd.DataFrame, family: Callable[[str], str]) -> pd.DataFrame:
    import pandas as pd

    rows, keys = paths(effects), [*CELL, "kind", "family"]
    rows = rows.assign(family=[family(source) for source in rows["source"]])
    result: list[Mapping[str, Any]] = []
    for path_set, members in PATH_SETS.items():
        is_member = [pair in members for pair in zip(rows["source"], rows["target"], strict=True)]
        for key, part in rows.loc[is_member].groupby(keys, sort=False):
            row_keys = dict(zip(keys, cast("tuple[str, ...]", key), strict=True))
            top = part["alpha"].max()
            ends = {"0": part.loc[part["alpha"] == 0], "top": part.loc[part["alpha"] == top]}
            metrics = {
                f"{side}_{end}": means[side].mean() for side in ("control", "void") for end, means in ends.items()
            }
            result.append({**row_keys, "path_set": path_set, "n_paths": len(ends["top"]), "alpha": top, **metrics})
    return pd.DataFrame(result, columns=pd.Index(REGIME_COLUMNS))


def domains(effects: pd.DataFrame) -> pd.DataFrame:
    """Return a frame of control abstention at the largest alpha, within and across taxonomies.

    It is a mean for each direction. same: on the well-posed dataset of the source's own taxonomy; cross: on that of the
    other. Columns CELL, source, alpha, same, cross.
    """
    import pandas as pd

    rows = paths(effects)
    well_posed = [name for name in DATASETS if not is_ill_posed(name)]
    rows = rows.loc[(rows["kind"] == "void") & rows["target"].isin(well_posed)]
    rows = rows.loc[rows["alpha"] == rows.groupby(CELL)["alpha"].transform("max")]
    is_within = rows["source"].map(taxonomy_of) == rows["target"].map(taxonomy_of)
    by_domain = rows.assign(domain=is_within.map({True: "same", False: "cross"})).pivot_table(
        index=[*CELL, "source", "alpha"], columns="domain", values="control"
    )
    columns = pd.Index([*CELL, "source", "alpha", "same", "cross"])
    return _in_order(by_domain.reset_index().reindex(columns=columns))


def sweep(effects: pd.DataFrame) -> pd.DataFrame:
    """Return a frame of control abstention by layer and alpha, along own directions; empty for one steered layer."""
    rows = effects.loc[(effects["kind"] == "void") & (effects["side"] == "control")]
    rows = rows.loc[rows["source"] == rows["target"]]
    groups = rows.groupby([*CELL, "layer", "alpha"])["abstention"]
    table = groups.agg(control="mean", n_splits="count").reset_index()
    has_several_layers = table.groupby("model")["layer"].transform("nunique") > 1
    return table.loc[has_several_layers].reset_index(drop=True)


def in_gaps(effects: pd.DataFrame, every: pd.DataFrame) -> pd.DataFrame:
    """Return the effects with `gaps`, their strength in distances of the class means; NaN without such doses."""
    keys = ["model", "directions", "source", "layer"]
    length = every.loc[(every["unit"] == "gap") & (every["dose"] > 0) & (every["kind"] == "void")]
    length = length.assign(length=length["alpha"] / length["dose"])[[*keys, "length"]].drop_duplicates(keys)
    effects_with_gap = effects.merge(length, on=keys, how="left")
    return effects_with_gap.assign(gaps=effects_with_gap["alpha"] / effects_with_gap["length"]).drop(columns="length")


def _in_order(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with sources and targets in the benchmark's order."""
    order = {name: place for place, name in enumerate(DATASETS)}
    columns = [name for name in (*CELL, "kind", "source", "target", "alpha") if name in rows]
    kinds = {kind: place for place, kind in enumerate(KINDS)}

    def place(values: Any) -> Any:
        if values.name in ("source", "target"):
            return values.map(order)
        return values.map(kinds) if values.name == "kind" else values

    return rows.sort_values(columns, key=place, ignore_index=True, kind="stable")
