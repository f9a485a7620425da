"""Rank steering effects among nulls, and compute PECS by sign policy.

The paper adds a direction on controls and subtracts it on voids, which requires knowing the sides. So PECS is also
given for adding, or subtracting, on both sides.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd

from traps_pipeline.mechanism.control_rows import SteeringNullRow, SteeringPecsRow
from traps_pipeline.mechanism.directions import NULLS, VOID
from traps_pipeline.scoring.metrics import joined_epochs, pecs_of

ALL = "all"
_CELL = ["model", "directions", "regime"]
_CONDITION = [*_CELL, "layer", "unit", "dose", "side"]


def null_rows(effects: pd.DataFrame) -> list[SteeringNullRow]:
    """Return STEERING_NULLS rows: datasets' own directions and their mean, if nulls exist."""
    own_effects = effects.loc[(effects["source"] == effects["target"]) & (effects["signs"] == "label")]
    changes = _with_changes(own_effects)
    nulls = changes.loc[changes["kind"].isin(NULLS)]
    rows: list[SteeringNullRow] = []
    for target in [*sorted(set(nulls["target"])), ALL]:
        part = changes if target == ALL else changes.loc[changes["target"] == target]
        rows += _rank(part, target)
    return rows


def _with_changes(effects: pd.DataFrame) -> pd.DataFrame:
    """Return effects with `moved`: more abstention on controls, less on voids, against unsteered answers."""
    path = [*_CELL, "target", "kind", "draw", "layer", "unit", "side"]
    unsteered_effects = effects.loc[effects["dose"] == 0, [*path, "abstention"]].rename(columns={"abstention": "plain"})
    steered_effects = effects.loc[effects["dose"] != 0].merge(unsteered_effects, on=path)
    change = steered_effects["abstention"].astype(float) - steered_effects["plain"].astype(float)
    return steered_effects.assign(moved=np.where(steered_effects["side"] == "control", change, -change))


def _rank(moved: pd.DataFrame, target: str) -> Iterator[SteeringNullRow]:
    for key, group in moved.groupby(_CONDITION, sort=True):
        row_keys: dict[str, Any] = dict(zip(_CONDITION, key if isinstance(key, tuple) else (key,), strict=True))
        void = group.loc[group["kind"] == VOID]
        for null_kind in NULLS:
            draws = group.loc[group["kind"] == null_kind].groupby("draw")
            same_targets = void.loc[void["target"].isin(set(group.loc[group["kind"] == null_kind, "target"]))]
            values = draws["moved"].mean().to_numpy(float)
            if not len(values) or same_targets["moved"].isna().any() or same_targets.empty:
                continue
            effect = float(same_targets["moved"].mean())
            # Shares of few answers tie often, so ties count against the direction; rounding must not break a tie.
            n_reaching = int(np.count_nonzero(values >= effect - 1e-9))
            yield SteeringNullRow(
                **row_keys,
                target=target,
                null=null_kind,
                effect=effect,
                null_mean=float(values.mean()),
                null_lowest=float(values.min()),
                null_highest=float(values.max()),
                draws=len(values),
                n_at_least=n_reaching,
                p=(1 + n_reaching) / (1 + len(values)),
                n=int(same_targets[["n", "n_missing"]].to_numpy().sum()),
                **_beside(same_targets, ""),
                **_beside(group.loc[group["kind"] == null_kind], "null_"),
                epoch=joined_epochs(same_targets["epoch"]),
            )


def _beside(effects: pd.DataFrame, prefix: str) -> dict[str, Any]:
    """Return the undecided share, and the mean perplexity, of the answers behind effects."""
    columns = {name: effects[name].to_numpy(float) for name in ("undecided", "perplexity")}
    known = {name: values[np.isfinite(values)] for name, values in columns.items()}
    metrics = {name: float(values.mean()) if len(values) else np.nan for name, values in known.items()}
    return {f"{prefix}{name}": value for name, value in nan_to_null(metrics).items()}


def nan_to_null(numbers: Mapping[str, float]) -> dict[str, Any]:
    """Return numbers with null instead of NaN, as in tables."""
    return {name: None if np.isnan(value) else float(value) for name, value in numbers.items()}


def pecs_rows(effects: pd.DataFrame) -> list[SteeringPecsRow]:
    """Return STEERING_PECS rows of void paths with both sides, by dose and signs; null without a decided answer."""
    keys = [*_CELL, "source", "target", "layer", "unit", "dose", "signs"]
    rows: list[SteeringPecsRow] = []
    for key, group in effects.loc[effects["kind"] == VOID].groupby(keys, sort=True):
        sides = {str(row["side"]): row for row in group.to_dict("records")}
        if len(sides) < 2:
            continue  # a layer of the sweep, which has only controls
        control, void = sides["control"], sides["void"]
        acc = control["correct"] / control["n_correct"] if control["n_correct"] else np.nan
        false_abs, abs_rec = (row["abstained"] / row["n"] if row["n"] else np.nan for row in (control, void))
        j = abs_rec - false_abs
        metrics = {"acc": acc, "false_abs": false_abs, "abs_rec": abs_rec, "j": j}
        metrics |= {"pecs": float(pecs_of(np.array(acc), np.array(j)))}
        answers = sum(row["n"] + row["n_missing"] for row in (control, void))
        rows.append(
            SteeringPecsRow(
                **dict(zip(keys, key if isinstance(key, tuple) else (key,), strict=True)),
                **nan_to_null(metrics),
                degenerate=(control["degenerate"] + void["degenerate"]) / answers,
                undecided=(control["n_missing"] + void["n_missing"]) / answers,
                perplexity=_beside(group, "")["perplexity"],
                n_controls=int(control["n"]),
                n_voids=int(void["n"]),
                epoch=joined_epochs([control["epoch"], void["epoch"]]),
            )
        )
    return rows
