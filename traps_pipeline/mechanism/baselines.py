"""Compute baselines for probes: raw inputs, the model's own output, and noise.

Every baseline replaces an item's states by other features and keeps the rest: the same items, folds, solver, intervals
and targets (`probing.ProbeRun`). A probe on states says nothing about understanding if the question's words, the first
frame, the clip's length or the time stamps separate as well; and nothing about a gap between representation and output
if the output margin does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from traps_pipeline.base import progress
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.control_rows import LOGITS, ProbeBaselineRow
from traps_pipeline.mechanism.mechanism_rows import PROBE_ITEMS
from traps_pipeline.mechanism.probes import Fit, fit_probe
from traps_pipeline.mechanism.probing import ProbeRun, Row
from traps_pipeline.mechanism.stages import confabulations
from traps_pipeline.mechanism.stored_states import StoredStates
from traps_pipeline.models.registry.entries import ModelEntry
from traps_pipeline.storage.media import MediaSpec, pick_frames
from traps_pipeline.storage.tables import records
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.video.encode import DamagedClip

if TYPE_CHECKING:
    from traps_pipeline.models.local.adapter import LocalModel

THUMBNAIL = (32, 24)  # pixels of a frame that a baseline sees, width and height
NOISE_DRAWS = 10
RAW = ("question words", "first frame", "all frames", "length", "time stamps")
MARGIN, NOISE = "output margin", "noise"
LIKELIEST = 256  # first tokens, the likeliest over all items, that a probe of the output reads
Features = Mapping[str, np.ndarray]  # dataset -> (n, columns), rows in the order of the dataset's items


def baseline_rows(workspace: Workspace, entry: ModelEntry, states: StoredStates) -> list[ProbeBaselineRow]:
    """Return PROBE_BASELINES of an extraction. Raises TrapsError for a damaged clip."""
    settings = workspace.mechanism
    items = {name: probed_items(workspace, states, name) for name in dict.fromkeys(states.items["dataset"])}
    assert entry.media is not None, "local entries have media"
    result: list[ProbeBaselineRow] = []

    def add(features: str, rows: Sequence[Row]) -> None:
        names = ("analysis", "source", "target", "scope", "value", "low", "high", "spread", "n_voids", "n_controls")
        result.extend(
            ProbeBaselineRow(**states.extraction.partition, features=features, **{name: row[name] for name in names})
            for row in rows
        )

    confabulated = confabulations(workspace, entry.id)
    run = ProbeRun(states.items, lambda dataset, _: np.empty(0), 1, 0, settings.probes, settings.seed, confabulated)
    raw = raw_features(items, entry.media, workspace.resolve)
    for number, (name, features) in enumerate(raw.items()):
        progress.current().tick("probe_baselines", f"of {states.extraction.key}", number + 1, len(raw) + 2)
        add(name, score_features(run, features))
    for name, features in output_or_note("probe_baselines", entry, states, states, [*items]).items():
        fit = fit_probe if name == LOGITS else lambda states, void: IdentityScorer()
        add(name, score_features(run, features, fit))
    add(NOISE, noise_floor(run, settings.seed))
    return result


class IdentityScorer:
    """A score without a fit: the only column of the features, which is larger for voids."""

    def scores(self, states: np.ndarray) -> np.ndarray:
        """Return the only column of the features as scores, (n,)."""
        return states[:, 0]


def score_features(run: ProbeRun, features: Features, fit: Fit = fit_probe) -> list[Row]:
    """Return rows of the probing protocol on features in the place of states. fit: another probe."""
    return replace(run, read=lambda dataset, _: features[dataset], fit=fit).comparable_rows(0)


# --- features ---------------------------------------------------------------------------------------------------------


def probed_items(workspace: Workspace, states: StoredStates, dataset: str) -> pd.DataFrame:
    """Return the PROBE_ITEMS rows of a dataset in the order of its states."""
    rows = workspace.tables.read(PROBE_ITEMS, {"dataset": dataset}).set_index("item_id")
    items = states.dataset(dataset)["item_id"]
    missing = sorted(set(items) - set(rows.index))
    if missing:
        raise TrapsError(
            f"probe_items {dataset}: has no {missing[0]}, which has states; materialize hidden_states again"
        )
    return rows.loc[list(items)].reset_index()


def raw_features(
    items: Mapping[str, pd.DataFrame], spec: MediaSpec, resolve: Callable[[str], Path]
) -> dict[str, Features]:
    """Return RAW features by name, then by dataset, (n, columns).

    question words: presence of single words and word pairs. first frame: its pixels at THUMBNAIL. all frames: those of
    all frames that the model is shown, with the mean for a missing one. length: the clip's last frame time, s. time
    stamps: the number of shown frames, and their first, mean and last times, s.
    """
    from sklearn.feature_extraction.text import CountVectorizer

    questions = [question for rows in items.values() for question in rows["question"]]
    words = CountVectorizer(ngram_range=(1, 2), binary=True, token_pattern=r"(?u)\b\w+\b").fit(questions)
    clips = {clip for rows in items.values() for clip in rows["clip"]}
    clip_frames = {clip: _thumbnails(resolve(clip), spec) for clip in sorted(clips)}
    max_frames = max(len(frames) for frames, _, _ in clip_frames.values())

    def pixels(clip: str) -> np.ndarray:
        frames = clip_frames[clip][0]
        missing = np.repeat(frames.mean(axis=0, keepdims=True), max_frames - len(frames), axis=0)
        return np.concatenate([frames, missing]).ravel()

    def stamps(clip: str) -> list[float]:
        times = clip_frames[clip][1]
        return [len(times), times[0], times.mean(), times[-1]]

    features: dict[str, dict[str, np.ndarray]] = {name: {} for name in RAW}
    for dataset, rows in items.items():
        shown_items = records(rows)
        features["question words"][dataset] = words.transform(rows["question"]).toarray().astype(float)
        features["first frame"][dataset] = np.stack([clip_frames[row["clip"]][0][0].ravel() for row in shown_items])
        features["all frames"][dataset] = np.stack([pixels(row["clip"]) for row in shown_items])
        features["length"][dataset] = np.array([[clip_frames[row["clip"]][2]] for row in shown_items])
        features["time stamps"][dataset] = np.array([stamps(row["clip"]) for row in shown_items])
    return dict(features)


def _thumbnails(clip: Path, spec: MediaSpec) -> tuple[np.ndarray, np.ndarray, float]:
    """Return shown frames' thumbnails (N, h, w, 3) in [0, 1] and times (N,), and the time of the clip's last frame."""
    import cv2

    try:
        frames = pick_frames(clip, spec)
    except DamagedClip as error:
        raise TrapsError(str(error)) from error
    thumbnails = [cv2.resize(frame, THUMBNAIL, interpolation=cv2.INTER_AREA) for frame in frames.frames]
    return np.stack(thumbnails) / 255, frames.times_s, float(frames.times_s[-1])


class NoMargin(TrapsError):
    """Raised where the output margin of these states cannot be computed."""


def margin_tokens(entry: ModelEntry, states: StoredStates) -> tuple[LocalModel, list[int]]:
    """Return the model whose head reads stored states, and its abstention tokens. Raises NoMargin without either."""
    from traps_pipeline.mechanism.margin import abstention_tokens
    from traps_pipeline.models.local.adapter import load_local_model

    if set(states.items["pooling"]) != {"last"}:
        raise NoMargin("states are means over tokens; set `pooling: last` to read the output margin")
    model = load_local_model(entry, inside=True, seed=states.extraction.weights_seed)
    try:
        return model, abstention_tokens(model)
    except TrapsError as error:
        raise NoMargin(str(error)) from error


def output_features(
    entry: ModelEntry, states: StoredStates, order: StoredStates, datasets: Sequence[str]
) -> dict[str, Features]:
    """Return every item's output margin (n, 1), and log-probabilities of the LIKELIEST first tokens (n, k).

    They are of the extraction's prompt, in the order of `order`'s items. No pass is needed: the stored state after the
    final norm goes through the model's head. Raises NoMargin.
    """
    import torch

    from traps_pipeline.mechanism.margin import first_token_margins, head_logits

    model, tokens = margin_tokens(entry, states)
    margins, chances = dict[str, np.ndarray](), dict[str, np.ndarray]()
    with torch.inference_mode():
        for name in datasets:
            normed = torch.from_numpy(states.read_as(order, name, "normed"))
            margins[name] = first_token_margins(model, normed, tokens).double().numpy()[:, None]
            chances[name] = head_logits(model, normed).log_softmax(-1).cpu().numpy()
    means = np.mean([values.mean(axis=0) for values in chances.values()], axis=0)
    likeliest = np.argsort(-means, kind="stable")[:LIKELIEST]
    return {MARGIN: margins, LOGITS: {name: values[:, likeliest].astype(float) for name, values in chances.items()}}


def output_or_note(
    stage: str, entry: ModelEntry, states: StoredStates, order: StoredStates, datasets: Sequence[str]
) -> dict[str, Features]:
    """Return `output_features`; without a margin nothing, and note it in the progress of a stage."""
    try:
        return output_features(entry, states, order, datasets)
    except NoMargin as error:
        progress.current().note(f"{stage}: no output margin ({error})")
        return {}


# --- noise ------------------------------------------------------------------------------------------------------------


def noise_floor(run: ProbeRun, seed: int, draws: int = NOISE_DRAWS) -> list[Row]:
    """Return rows of the probing protocol on noise: means over draws, with deviation `spread`.

    Every distinct prompt has one vector of independent normal numbers, as wide as the states. Items with the same
    prompt (the controls of a taxonomy's two datasets) share it, as their states are equal. So `transfer` shows the
    effect of shared controls alone, and `held_out` the floor after the split by scenario.
    """
    items, width = run.items, int(run.items["width"].iloc[0])
    prompts, place = np.unique(items["states_key"].to_numpy(str), return_inverse=True)
    places = {name: place[(items["dataset"] == name).to_numpy()] for name in dict.fromkeys(items["dataset"])}
    groups: dict[tuple[str, ...], list[Row]] = {}
    for draw in range(draws):
        vectors = np.random.default_rng([seed, draw]).standard_normal((len(prompts), width))
        for row in score_features(run, {name: vectors[rows] for name, rows in places.items()}):
            groups.setdefault(tuple(row[name] for name in ("analysis", "source", "target", "scope")), []).append(row)
    rows = []
    for group in groups.values():
        values = np.array([row["value"] for row in group], float)
        if np.isnan(values).any():  # no features of these items allow this metric
            continue
        rows.append(group[0] | {"value": values.mean(), "spread": values.std(), "low": None, "high": None})
    return rows
