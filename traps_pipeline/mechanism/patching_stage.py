"""Patch matched controls and voids of well-posed datasets (PATCHING rows).

One backward pass per pair estimates the effect of every site, layer and group of positions; the cells with the largest
estimates are then patched, beside nulls. Each pair's result is written before the next one begins, so that an
interrupted run resumes there. States of at most two passes are in memory at once.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from heapq import nlargest
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from traps_pipeline.base import progress
from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.control_rows import PatchingRow
from traps_pipeline.mechanism.directions import seeded_order
from traps_pipeline.mechanism.hook import Site
from traps_pipeline.mechanism.margin import abstention_tokens
from traps_pipeline.mechanism.mechanism_rows import PROBE_ITEMS
from traps_pipeline.mechanism.patching_effects import (
    Patch,
    RecordedPass,
    attributed_changes,
    patched_changes,
    require_patchable,
    trace_pass,
)
from traps_pipeline.mechanism.probing_versions import extraction_version
from traps_pipeline.models.local.spans import changed_tokens, token_spans
from traps_pipeline.models.registry.entries import ModelEntry
from traps_pipeline.models.registry.prompts import states_prompt
from traps_pipeline.protocol.cells import Extraction
from traps_pipeline.protocol.datasets import SIDES
from traps_pipeline.scoring.bootstrap import TAXONOMIES, draw_scenarios, interval, shares_of, with_unseen
from traps_pipeline.storage.media import Frames, MediaSpec, pick_frames
from traps_pipeline.storage.study import PatchingSettings
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    from traps_pipeline.models.local.adapter import LocalModel, Prompt

WELL_POSED = ("occlusion", "chaotic")  # datasets whose sides have the same question and equally many shown frames
OWN, OTHER, SAME, TIMES = SOURCES = ("pair", "other scenario", "same side", "other times")
GROUPS = ("system", "stamps", "changed", "unchanged", "question", "last", "all")
RESAMPLES = 1000
PROMPTS_KEPT = 8  # prompts with their pixels in memory; the parts of all prompts are kept
Row = dict[str, Any]
Cell = tuple[str, Site, int, str]  # patched side, site, layer, group


@dataclass(frozen=True, eq=False)
class Side:
    """The control or the void of a pair: its prompt, and groups of the positions of its tokens."""

    prompt: Prompt
    parts: Mapping[str, np.ndarray]


def patching_rows(workspace: Workspace, entry: ModelEntry, extraction: Extraction) -> list[PatchingRow]:
    """Return PATCHING rows of a model. Raises TrapsError if it cannot be patched."""
    from traps_pipeline.models.local.adapter import load_local_model

    settings = workspace.mechanism.patching
    assert settings is not None, "an experiment without patching has no such stage"
    model = load_local_model(entry, inside=True)
    require_patchable(model)
    rows: list[PatchingRow] = []
    for dataset in WELL_POSED:
        if workspace.tables.state(PROBE_ITEMS, {"dataset": dataset}) is not None:
            changes = Pairs(workspace, entry, extraction, dataset, model, settings).changes()
            rows += summarize_effects(*changes, extraction, dataset, workspace.mechanism.seed)
    if not rows:
        raise TrapsError("patching: no pairs of a well-posed dataset; materialize probe_items first")
    return rows


class Pairs:
    """The pairs of a dataset that are patched, with the files of each pair's results."""

    def __init__(
        self,
        workspace: Workspace,
        entry: ModelEntry,
        extraction: Extraction,
        dataset: str,
        model: LocalModel,
        settings: PatchingSettings,
    ) -> None:
        assert entry.media is not None, "local entries have media"
        self._workspace, self._model, self._spec, self._settings = workspace, model, entry.media, settings
        self._system, self._dataset = states_prompt(workspace.mechanism.system, extraction.prompt), dataset
        self._tokens = abstention_tokens(model)
        items, seed = workspace.tables.read(PROBE_ITEMS, {"dataset": dataset}), workspace.mechanism.seed
        self._items = {(str(row["scenario_id"]), str(row["side"])): row for row in items.to_dict("records")}
        self._names = seeded_order(sorted(set(items["scenario_id"])), seed)[: settings.pairs]
        self._parts = dict[tuple[str, str, str], Mapping[str, np.ndarray]]()
        self._side = lru_cache(PROMPTS_KEPT)(self._make_side)
        questions = items[["item_id", "media_digest", "question"]].to_numpy(str).tolist()
        made_of = [extraction_version(workspace, extraction), sorted(questions), self._names, settings.sites]
        self._version = digest(made_of)[:16]
        self._folder = workspace.root / "patching" / extraction.model / extraction.prompt / dataset

    def changes(self) -> tuple[list[Row], list[Row]]:
        """Return estimated effects of all patches, and measured ones of `best_cells` and nulls, a row for each pair."""
        paths = set[Path]()
        estimates = self._pair_rows("estimates", self._estimates, paths)
        best = best_cells(estimates, self._settings, self._model.n_layers)
        patches = self._pair_rows(f"patches-{digest(best)[:8]}", lambda name: self._patches(name, best), paths)
        store = self._workspace.store
        store.remove({*store.below(self._folder)} - paths)  # files of other settings or items
        return estimates, patches

    def _pair_rows(self, kind: str, make: Callable[[str], Iterable[Row]], paths: set[Path]) -> list[Row]:
        """Return the rows of all pairs, from their files or computed and written."""
        rows, store = list[Row](), self._workspace.store
        for number, name in enumerate(self._names, start=1):
            path = self._folder / f"{name}-{self._version}-{kind}.json"
            try:
                pair_result = json.loads(store.here(path).read_text(encoding="utf-8"))
            except (FileNotFoundError, ValueError):
                pair_result = [*make(name)]
                store.write({path: json.dumps(pair_result).encode()})
            rows += pair_result
            paths.add(path)
            progress.current().tick("patching", f"pairs of {self._dataset}, {kind}", number, len(self._names))
        return rows

    def _estimates(self, name: str) -> Iterator[Row]:
        for side, target, source, groups in self._directions(name):
            if groups is None:
                yield {"scenario": name, "into": side, "source": OWN, "left_out": True}
                continue
            ends, changes = self._attribute(target, source)
            for (site, layer), token_changes in changes.items():
                for group, positions in groups.items():
                    if positions.any() and site in self._settings.sites:
                        change = float(token_changes[positions].sum())
                        yield _row(name, side, OWN, (site, layer, group), positions, ends, change)

    def _patches(self, name: str, best: Sequence[Cell]) -> Iterator[Row]:
        for patched_side, target, _, groups in self._directions(name):
            if groups is None:
                continue
            cells: list[tuple[Site, int, str]] = [
                (site, layer, group)
                for side, site, layer, group in best
                if side == patched_side and groups[group].any()
            ]
            patches = [Patch(site, layer, groups[group]) for site, layer, group in cells]
            target_pass, source_margin = trace_pass(self._model, target.prompt, self._tokens, ()), 0.0
            for kind in SOURCES:
                side = self._source(name, patched_side, kind)
                if side is None:
                    yield {"scenario": name, "into": patched_side, "source": kind, "left_out": True}
                    continue
                margin, changes = self._patch(target_pass, side, patches)
                source_margin = margin if kind == OWN else source_margin
                for cell, patch, change in zip(cells, patches, changes, strict=True):
                    ends = target_pass.margin, source_margin
                    yield _row(name, patched_side, kind, cell, patch.positions, ends, float(change))
            del target_pass  # before the other side's pass is recorded

    def _attribute(self, target: Side, source: Side) -> tuple[tuple[float, float], dict[tuple[Site, int], np.ndarray]]:
        """Return both sides' margins and each token's estimate; free the states."""
        target_pass = trace_pass(self._model, target.prompt, self._tokens, ())
        source_pass = trace_pass(self._model, source.prompt, self._tokens, self._settings.sites)
        return (target_pass.margin, source_pass.margin), attributed_changes(
            self._model, target_pass, source_pass, self._tokens
        )

    def _patch(self, target: RecordedPass, side: Side, patches: Sequence[Patch]) -> tuple[float, np.ndarray]:
        """Return a source's margin, and the changes by its patches; free its states."""
        source = trace_pass(self._model, side.prompt, self._tokens, self._settings.sites)
        return source.margin, patched_changes(self._model, target, source, patches, self._tokens)

    def _directions(self, name: str) -> Iterator[tuple[str, Side, Side, dict[str, np.ndarray] | None]]:
        """Yield each side of a complete pair, with the other as source, and groups."""
        if all((name, side) in self._items for side in SIDES):
            for patched_side, other_side in (SIDES, SIDES[::-1]):
                target, source = self._side(name, patched_side), self._side(name, other_side)
                yield patched_side, target, source, groups_of(target, source)

    def _source(self, name: str, into: str, kind: str) -> Side | None:
        """Return the side whose states patch a pair's side; None without one of its form."""
        other_side = SIDES[1 - SIDES.index(into)]
        source_keys = {OWN: (name, other_side, ""), TIMES: (name, into, other_side)}
        if kind in source_keys:
            candidates = [source_keys[kind]]
        else:
            first = self._names.index(name)
            other_names = [*self._names[first + 1 :], *self._names[:first]]
            candidates = [(other_name, other_side if kind == OTHER else into, "") for other_name in other_names]
        form = self._form(name, into)
        for candidate in candidates:
            if candidate[:2] in self._items and _has_same_form(form, self._form(*candidate)):
                return self._side(*candidate)
        return None

    def _form(self, name: str, which: str, times_of: str = "") -> Mapping[str, np.ndarray]:
        if (name, which, times_of) not in self._parts:
            self._side(name, which, times_of)
        return self._parts[name, which, times_of]

    def _make_side(self, name: str, which: str, times_of: str = "") -> Side:
        row = self._items[name, which]
        clip, question = self._workspace.resolve(row["clip"]), str(row["question"])
        other_clip = self._workspace.resolve(self._items[name, times_of]["clip"]) if times_of else None
        frames = pick_frames(clip, self._spec)
        times = shown_times(frames, clip, self._spec, other_clip)
        prompt = self._model.prompt(self._system, question, frames.frames, times)
        side = Side(prompt, token_spans(self._model, prompt, self._system, question))
        self._parts[name, which, times_of] = side.parts
        return side


def _row(
    scenario: str,
    into: str,
    source: str,
    cell: tuple[Site, int, str],
    positions: np.ndarray,
    ends: tuple[float, float],
    change: float,
) -> Row:
    """Return a patch's effect on a pair; ends: outcomes of patched and other side."""
    site, layer, group = cell
    row_keys = {"scenario": scenario, "into": into, "source": source, "site": site, "layer": layer, "group": group}
    return row_keys | {"before": ends[0], "there": ends[1], "change": change, "tokens": int(positions.sum())}


def _has_same_form(target: Mapping[str, np.ndarray], source: Mapping[str, np.ndarray]) -> bool:
    """Return whether two prompts have the same form, part by part."""
    return all(np.array_equal(target[part], source[part]) for part in ("system", "stamps", "visual"))


def groups_of(target: Side, source: Side) -> dict[str, np.ndarray] | None:
    """Return by name a pair's groups of token positions, (T,) bool; None if prompts differ in form.

    A model whose pixels do not lie token by token (LLaVA-NeXT-Video, Gemma 4) has no group of unchanged visual tokens:
    all count as changed.
    """
    if not _has_same_form(target.parts, source.parts):
        return None
    parts, visual = target.parts, target.parts["visual"]
    is_changed = changed_tokens(target.prompt, source.prompt, visual)
    is_changed = visual if is_changed is None else is_changed
    groups = {"changed": is_changed, "unchanged": visual & ~is_changed, "all": np.ones(len(visual), bool)}
    groups |= {name: parts[name] for name in ("system", "stamps", "question", "last")}
    return {name: groups[name] for name in GROUPS}


def best_cells(estimates: Sequence[Row], settings: PatchingSettings, n_layers: int) -> list[Cell]:
    """Return the sites, layers and groups of each direction with the largest estimates over all pairs.

    Only some layers count, at equal steps. All positions of the residual stream together are left out; their effect is
    1 by construction.
    """
    layers = {*range(0, n_layers + 1, settings.stride), n_layers}
    sums = defaultdict[Cell, float](float)
    for row in estimates:
        if "left_out" not in row and row["layer"] in layers and (row["site"], row["group"]) != ("residual", "all"):
            sums[row["into"], row["site"], row["layer"], row["group"]] += row["change"]
    largest_cells = [
        nlargest(settings.exact, (c for c in sums if c[0] == side), key=lambda c: abs(sums[c])) for side in SIDES
    ]
    return sorted(cell for cells in largest_cells for cell in cells)


def summarize_effects(
    estimates: Sequence[Row], patches: Sequence[Row], extraction: Extraction, dataset: str, seed: int
) -> Iterator[PatchingRow]:
    """Yield a dataset's rows: ratios of sums over pairs, with intervals if measured; no effect without a pair."""
    n_left_out = Counter((row["into"], row["source"]) for row in (*estimates, *patches) if "left_out" in row)
    cells = [defaultdict[tuple[Any, ...], list[Row]](list), defaultdict[tuple[Any, ...], list[Row]](list)]
    for rows_by_cell, rows in zip(cells, (estimates, patches), strict=True):
        for row in rows:
            if "left_out" not in row:
                rows_by_cell[row["into"], row["source"], row["site"], row["layer"], row["group"]].append(row)
    estimated, measured_rows = cells
    known_keys = {key[:2] for key in (*estimated, *measured_rows)}
    empty_cells = [(*key, "residual", 0, "all") for key in n_left_out if key not in known_keys]
    for key in sorted({*estimated, *measured_rows, *empty_cells}):
        side, source, site, layer, group = key
        rows = measured_rows.get(key) or estimated.get(key) or []
        source_outcome, target, change = (
            np.array([row[name] for row in rows]) for name in ("before", "there", "change")
        )
        gap = float((target - source_outcome).sum()) if len(rows) else 0.0
        estimated_change = sum(row["change"] for row in estimated.get(key, ()))
        effect: tuple[float | None, ...] = (None, None, None)
        if key in measured_rows:
            effect = effect_of(source_outcome, source_outcome + change, target, seed)
        is_different = np.sign(source_outcome) != np.sign(target)
        is_flipped = (np.sign(source_outcome + change) != np.sign(source_outcome)) & is_different
        yield PatchingRow(
            **extraction.partition,
            dataset=dataset,
            into=side,
            source=source,
            site=site,
            layer=layer,
            group=group,
            attributed=estimated_change / gap if key in estimated and gap else None,
            effect=effect[0],
            low=effect[1],
            high=effect[2],
            flips=float(is_flipped.sum() / is_different.sum()) if key in measured_rows and is_different.any() else None,
            n_flippable=int(is_different.sum()),
            n=len(rows),
            n_left_out=n_left_out[side, source],
            tokens=float(np.mean([row["tokens"] for row in rows])) if rows else 0.0,
        )


def effect_of(
    before: np.ndarray, after: np.ndarray, target: np.ndarray, seed: int
) -> tuple[float | None, float | None, float | None]:
    """Return the indirect effect of pairs and its 95 % interval over scenarios.

    It is sum(after - before) over sum(target - before), each (pairs,): a ratio of sums, since the ratio of a pair whose
    sides hardly differ is noise. One pair is unseen, with an effect of 0 or of 1, so that few pairs keep an interval's
    width. None if the sides do not differ at all.
    """
    change, gap = after - before, target - before
    if not gap.sum():
        return None, None, None
    effect = float(change.sum() / gap.sum())
    pairs = pd.DataFrame({"scenario_id": np.arange(len(change)), "taxonomy": TAXONOMIES[0]})
    resampling = draw_scenarios(pairs, RESAMPLES, seed)
    sums = resampling.scenarios[TAXONOMIES[0]][1] @ np.stack([change, gap], axis=-1)
    ends = shares_of(with_unseen(sums.T, np.array([len(change)]), resampling.unseen("effect", decisions=1)))
    low, high = interval(ends[:, 0, 1:], effect, (-np.inf, np.inf))
    return effect, float(low), float(high)


def shown_times(shown: Frames, clip: Path, spec: MediaSpec, times: Path | None) -> np.ndarray:
    """Return the times (N,) s of a clip's shown frames: its own, or another clip's, spread evenly."""
    if times is None or times == clip:
        return shown.times_s
    sampled_s = pick_frames(times, spec).times_s
    if len(sampled_s) == len(shown.times_s):
        return sampled_s
    return np.interp(np.linspace(0, 1, len(shown.times_s)), np.linspace(0, 1, len(sampled_s)), sampled_s)
