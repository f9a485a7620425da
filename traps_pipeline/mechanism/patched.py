"""The patching stage: matched controls and voids of the well-posed datasets, group by group, layer by layer, with
nulls; as rows of PATCHING."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pandas as pd

from traps_pipeline.base import progress
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.control_rows import PatchingRow
from traps_pipeline.mechanism.directions import seeded_order
from traps_pipeline.mechanism.hidden_states import shown_times
from traps_pipeline.mechanism.margin import abstention_tokens
from traps_pipeline.mechanism.mechanism_rows import PROBE_ITEMS
from traps_pipeline.mechanism.patching_effects import Patch, Recorded, patched_changes, record, require_patchable
from traps_pipeline.models.local.spans import changed_tokens, spans
from traps_pipeline.models.prompts import states_prompt
from traps_pipeline.models.registry import ModelEntry
from traps_pipeline.protocol.cells import Extraction
from traps_pipeline.protocol.datasets import SIDES
from traps_pipeline.scoring.bootstrap import (
    TAXONOMIES,
    draw_scenarios,
    interval,
    shares_of,
    with_unseen,
)
from traps_pipeline.storage.media import sample
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    from traps_pipeline.models.local.adapter import LocalModel, Prompt

WELL_POSED = ("occlusion", "chaotic")  # their sides have the same question, and clips of as many shown frames
OWN, OTHER, SAME, TIMES = SOURCES = ("pair", "other scenario", "same side", "other times")
GROUPS = ("system", "stamps", "changed", "unchanged", "question", "last", "all")
RESAMPLES = 1000


@dataclass(frozen=True, eq=False)
class Side:
    """One side of a pair: its prompt, its recorded pass, and the groups of its positions that do not depend on the
    other side."""

    prompt: Prompt
    recorded: Recorded
    parts: Mapping[str, np.ndarray]


def patching_rows(workspace: Workspace, entry: ModelEntry, extraction: Extraction) -> list[PatchingRow]:
    """Rows of PATCHING of a model under a VQA prompt. Raises TrapsError for a model that cannot be patched."""
    from traps_pipeline.models.local.adapter import load_local_model

    settings = workspace.mechanism.patching
    assert settings is not None, "an experiment without patching has no such stage"
    model = load_local_model(entry, inside=True)
    require_patchable(model)
    tokens = abstention_tokens(model)
    rows: list[PatchingRow] = []
    for dataset in WELL_POSED:
        items = workspace.tables.read(PROBE_ITEMS, {"dataset": dataset}) if _has(workspace, dataset) else None
        if items is None:
            continue
        changes = _changes(workspace, entry, extraction, model, dataset, items, tokens)
        rows += _summed(pd.DataFrame(changes), extraction, dataset, workspace.mechanism.seed)
    if not rows:
        raise TrapsError("patching: no pairs of a well-posed dataset; materialize probe_items first")
    return rows


def _has(workspace: Workspace, dataset: str) -> bool:
    return workspace.tables.state(PROBE_ITEMS, {"dataset": dataset}) is not None


def _changes(
    workspace: Workspace,
    entry: ModelEntry,
    extraction: Extraction,
    model: LocalModel,
    dataset: str,
    items: pd.DataFrame,
    tokens: Sequence[int],
) -> Iterator[dict[str, Any]]:
    """One row per pair, direction, source and patch: the outcome before and after, and the other side's."""
    settings = workspace.mechanism.patching
    assert settings is not None and entry.media is not None
    spec = entry.media
    names = seeded_order(sorted(set(items["scenario_id"])), workspace.mechanism.seed)[: settings.pairs]
    of = {(row["scenario_id"], row["side"]): row for row in items.to_dict("records")}
    system = states_prompt(workspace.mechanism.system, extraction.prompt)
    sides: dict[tuple[str, str], Side] = {}

    def side(name: str, which: str, times_of: str | None = None) -> Side:
        row = {str(k): v for k, v in of[name, which].items()}
        clip = workspace.resolve(row["clip"])
        other = workspace.resolve(of[name, times_of]["clip"]) if times_of else None
        shown = sample(clip, spec)
        times = shown_times(shown, clip, spec, other)
        prompt = model.prompt(system, row["question"], shown.frames, times)
        return Side(prompt, record(model, prompt, tokens), spans(model, prompt, system, row["question"]))

    for number, name in enumerate(names):
        for which in SIDES:
            if (name, which) in of:
                sides[name, which] = side(name, which)
        progress.current().tick("patching", f"prompts of {dataset}", number + 1, len(names))
    for number, (name, into) in enumerate(product(names, SIDES)):
        progress.current().tick("patching", f"pairs of {dataset}", number + 1, 2 * len(names))
        towards = "void" if into == "control" else "control"
        if (name, into) not in sides or (name, towards) not in sides:
            continue
        target, own = sides[name, into], sides[name, towards]
        groups = _groups(target, own)
        if groups is None:
            yield {"scenario": name, "into": into, "source": OWN, "left_out": True}
            continue
        sources: dict[str, Side | None] = {OWN: own, TIMES: side(name, into, towards)}
        rest = [*names[names.index(name) + 1 :], *names[: names.index(name)]]
        for kind, which in ((OTHER, towards), (SAME, into)):
            found = [sides[o, which] for o in rest if (o, which) in sides and _fits(target, sides[o, which])]
            sources[kind] = found[0] if found else None
        for kind, source in sources.items():
            about = {"scenario": name, "into": into, "source": kind}
            if source is None or not _fits(target, source):
                yield about | {"left_out": True}
                continue
            wanted = _patches(model.n_layers, groups, settings.sites if kind == OWN else ("residual",))
            changes = patched_changes(model, target.recorded, source.recorded, [patch for _, patch in wanted], tokens)
            for (group, patch), value in zip(wanted, changes, strict=True):
                before, there = target.recorded.margin, own.recorded.margin
                yield about | {
                    **{"left_out": False, "site": patch.site, "layer": patch.layer, "group": group},
                    **{"before": before, "after": before + value, "there": there, "tokens": int(patch.positions.sum())},
                }


def _fits(target: Side, source: Side) -> bool:
    """Whether the two prompts have the same form, part by part."""
    return target.recorded.length == source.recorded.length and all(
        np.array_equal(target.parts[part], source.parts[part]) for part in ("system", "stamps", "visual")
    )


def _patches(n_layers: int, groups: Mapping[str, np.ndarray], sites: Sequence[str]) -> list[tuple[str, Patch]]:
    wanted: list[tuple[str, Patch]] = []
    for site, layer, (name, positions) in product(sites, range(n_layers + 1), groups.items()):
        if positions.any() and (layer or site == "residual"):
            wanted.append((name, Patch(site, layer, positions)))  # pyright: ignore[reportArgumentType]
    return wanted


def _groups(target: Side, other: Side) -> dict[str, np.ndarray] | None:
    """The groups of positions of a pair; None if the two prompts have another form. A model whose pixels do not lie
    token by token (LLaVA-NeXT-Video, Gemma 4) has no group of unchanged visual tokens: all count as changed."""
    if not _fits(target, other):
        return None
    parts, visual = target.parts, target.parts["visual"]
    changed = changed_tokens(target.prompt, other.prompt, visual)
    changed = visual if changed is None else changed
    found = {"system": parts["system"], "stamps": parts["stamps"], "changed": changed, "unchanged": visual & ~changed}
    found |= {"question": parts["question"], "last": parts["last"], "all": np.ones(len(visual), bool)}
    return {name: found[name] for name in GROUPS}


def _summed(changes: pd.DataFrame, extraction: Extraction, dataset: str, seed: int) -> Iterator[PatchingRow]:
    """The rows of a dataset from its changes: ratios of sums over pairs, with intervals by scenario. Where all pairs
    were left out, a row without an effect says so."""
    if changes.empty:
        return
    keys = ["into", "source", "site", "layer", "group"]
    left = changes.loc[changes["left_out"].astype(bool)].groupby(["into", "source"]).size().to_dict()
    made = changes.loc[~changes["left_out"].astype(bool)]
    for (into, source), count in left.items():
        if not ((made["into"] == into) & (made["source"] == source)).any():
            nothing = dict.fromkeys(("effect", "low", "high", "flips"))
            about: dict[str, Any] = {"into": into, "source": source, "site": "residual", "layer": 0, "group": "all"}
            yield PatchingRow(
                **extraction.partition, dataset=dataset, **about, **nothing, n_flippable=0, n=0, n_left_out=count,
                tokens=0.0,
            )  # fmt: skip
    for key, group in made.groupby(keys, sort=True) if len(made) else ():
        into, source, site, layer, name = cast(tuple[Any, ...], key)
        before, after, there = (group[column].to_numpy(float) for column in ("before", "after", "there"))
        effect, low, high = effect_of(before, after, there, seed)
        differs = np.sign(group["before"]) != np.sign(group["there"])
        flipped = (np.sign(group["after"]) != np.sign(group["before"])) & differs
        yield PatchingRow(
            **extraction.partition,
            dataset=dataset,
            into=into,
            source=source,
            site=site,
            layer=int(layer),
            group=name,
            effect=effect,
            low=low,
            high=high,
            flips=float(flipped.sum() / differs.sum()) if differs.any() else None,
            n_flippable=int(differs.sum()),
            n=len(group),
            n_left_out=int(left.get((into, source), 0)),
            tokens=float(group["tokens"].mean()),
        )


def effect_of(
    before: np.ndarray, after: np.ndarray, there: np.ndarray, seed: int
) -> tuple[float | None, float | None, float | None]:
    """The indirect effect of pairs and its 95 % interval from resampled scenarios (one pair each): sum(after - before)
    over sum(there - before), each (pairs,). A ratio of sums, since the ratio of a pair whose sides hardly differ is
    noise. One pair is unseen, with an effect of 0 or of 1, so that few pairs keep an interval's width. None where the
    sides do not differ at all."""
    moved, apart = after - before, there - before
    if not apart.sum():
        return None, None, None
    effect = float(moved.sum() / apart.sum())
    pairs = pd.DataFrame({"scenario_id": np.arange(len(moved)), "taxonomy": TAXONOMIES[0]})
    drawn = draw_scenarios(pairs, RESAMPLES, seed)
    sums = drawn.scenarios[TAXONOMIES[0]][1] @ np.stack([moved, apart], axis=-1)
    ends = shares_of(with_unseen(sums.T, np.array([len(moved)]), drawn.unseen("effect", decisions=1)))
    low, high = interval(ends[:, 0, 1:], effect, (-np.inf, np.inf))
    return effect, float(low), float(high)
