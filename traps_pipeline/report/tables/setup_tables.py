"""Tabulate a study's models, parameters and benchmark (docs/spec.md 2 and 3)."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

from traps_pipeline.base.paths import SCENE_SPECS
from traps_pipeline.base.wording import count_noun
from traps_pipeline.benchmark.leaks import FILE
from traps_pipeline.models.registry.entries import Entry, ModelEntry, load_models
from traps_pipeline.models.registry.judges import load_judges
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.table_columns import MODEL, frame
from traps_pipeline.report.writing import Column, PrintedTable
from traps_pipeline.storage.media import MediaSpec


def models(results: Results) -> list[PrintedTable]:
    """Return evaluated models: provider, how a clip is shown, and number of runs."""
    rows = []
    for entry in _entries(results):
        rows.append(
            {
                "model": entry.id, "provider_id": entry.endpoint, "family": entry.groups.family,
                "access": entry.groups.access, "group": entry.groups.group, "shown": _media_words(entry.media),
                "runs": entry.runs,
            }
        )  # fmt: skip
    columns = [
        MODEL, Column("provider_id", "Asked as"), Column("family", "Family"), Column("access", "Access"),
        Column("group", "Group"), Column("shown", "Shown"), Column("runs", "Runs at most", "count"),
    ]  # fmt: skip
    return [PrintedTable("models", "Models", frame(rows, ["model"]), columns, why=results.why("cells"))]


def _media_words(media: MediaSpec | None) -> str:
    if media is None:
        return ""
    frames = (
        count_noun(media.uniform or 0, "evenly spaced frame")
        if media.fps is None
        else f"{media.fps:g} fps, at most {media.most}"
    )
    return f"{media.profile}, {frames}" + (f", {media.size[0]} x {media.size[1]}" if media.size else "")


def leaks(results: Results) -> list[PrintedTable]:
    """Return how well one cue alone tells recorded voids from controls, as their import measured it."""
    path = SCENE_SPECS / FILE
    rows = json.loads(path.read_text(encoding="utf-8")) if results.is_study and path.is_file() else []
    columns = [
        Column("dataset", "Dataset"), Column("cue", "Cue alone"), Column("j", "J", "fraction"),
        Column("half_width", "±", "fraction"), Column("n_pairs", "n", "count"),
    ]  # fmt: skip
    notes = ["J of a classifier of the cue alone, on scenarios that it was not fitted on; 0: it tells nothing"]
    why = "the benchmark has no recorded pairs"
    shown = frame(rows, ["dataset", "cue", "j", "half_width", "n_pairs"])
    return [PrintedTable("leaks", "What gives recorded voids away", shown, columns, notes if rows else [], why)]


def hyperparameters(results: Results) -> list[PrintedTable]:
    """Return parameters sent to models and judges; protocol departures are marked."""
    judges = [*load_judges().values()]
    if results.is_study:
        voting_judges = set(results.bias["judge"])
        judges = [judge for judge in judges if judge.id in voting_judges]
    rows = [_sent_params(entry, "model") for entry in _entries(results)] + [
        _sent_params(entry, "judge") for entry in judges
    ]
    columns = [
        Column("id", "Participant"), Column("role", "Role"), Column("temperature", "Temperature", "fraction", 2),
        Column("top_p", "Top-p", "fraction", 2), Column("max_tokens", "Tokens at most", "count"),
        Column("other", "Other parameters"), Column("concurrency", "At once", "count"),
        Column("retries", "Retries", "count"), Column("waived", "Departs"),
    ]  # fmt: skip
    notes = ["departs: what is sent otherwise than the paper has it, and why"]
    return [
        PrintedTable(
            "hyperparameters", "Hyperparameters", frame(rows, ["id"]), columns, notes, results.why("cells"),
            dash="not sent",
        )
    ]  # fmt: skip


def _sent_params(entry: Entry, role: str) -> dict[str, Any]:
    common_names = ("temperature", "top_p", "max_tokens", "max_completion_tokens")
    other_params = {name: value for name, value in entry.params.items() if name not in common_names}
    return {
        "id": entry.id,
        "role": role,
        "temperature": entry.params.get("temperature"),
        "top_p": entry.params.get("top_p"),
        "max_tokens": entry.max_tokens or None,
        "other": ", ".join(f"{name}: {_flatten(value)}" for name, value in sorted(other_params.items())),
        "concurrency": entry.limits.concurrency,
        "retries": entry.limits.retries,
        "waived": "; ".join(f"{name}: {reason}" for name, reason in sorted(entry.waivers.items())),
    }


def _flatten(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{name}: {_flatten(part)}" for name, part in value.items()) + "}"
    return str(value)


def _entries(results: Results) -> Iterable[ModelEntry]:
    """Return registry entries of the models with results, in the registry's order."""
    evaluated = set(results.cells["model"])
    return [entry for entry in load_models().values() if entry.id in evaluated]


def composition(results: Results) -> list[PrintedTable]:
    """Return how many pairs of each category the study has."""
    import pandas as pd

    rows = results.composition
    if len(rows):
        total = {"taxonomy": "all", "category": "", "void": "", **rows[["n", "n_ill_posed"]].sum().to_dict()}
        rows = pd.concat([rows, pd.DataFrame([total])], ignore_index=True)
    columns = [
        Column("taxonomy", "Taxonomy"), Column("category", "Category"), Column("void", "Void"),
        Column("n", "Pairs", "count"), Column("n_ill_posed", "Ill-posed pairs", "count"),
    ]  # fmt: skip
    notes = ["the ill-posed datasets reuse the control clips with a question that they cannot answer"]
    return [PrintedTable("composition", "Composition of the benchmark", rows, columns, notes, "no items yet")]
