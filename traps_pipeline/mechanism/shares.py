"""Compute a steered model's abstention by steering path and set of paths (docs/spec.md 8.4).

They are computed from STEERING and STEERING_VOTES rows. A path asks each scenario once, so its Wilson interval covers
the variation of scenarios. Several paths ask the same scenario, and one answer may count in several paths; intervals
over paths therefore resample scenarios, not answers.
"""

from collections.abc import Iterator
from itertools import product
from typing import Any, cast

import numpy as np
import pandas as pd

from traps_pipeline.mechanism.mechanism_rows import SteeringEffectRow, SteeringShareRow
from traps_pipeline.mechanism.steering import UNSTEERED
from traps_pipeline.mechanism.transfer_paths import PATH_SETS, STEERING_PATHS
from traps_pipeline.protocol.datasets import taxonomy_of, transfer_type
from traps_pipeline.protocol.ratings import ABSTENTION, CORRECTNESS, majority, ratings, vote_decisions
from traps_pipeline.scoring.bootstrap import (
    RESAMPLES,
    SEED,
    TAXONOMIES,
    draw_scenarios,
    interval,
    resampled_sums,
    shares_of,
    with_unseen,
)
from traps_pipeline.scoring.metrics import wilson

ALL = "all"
_RUN = ["model", "directions", "regime"]
_CELL = [*_RUN, "dataset"]
_ALONG = ["source", "kind", "draw", "layer", "unit", "signs"]
_ANSWER = [*_CELL, *_ALONG, "dose", "item_id"]
VOTE_COLUMNS = [*_ANSWER, "side", "task", "judge", "valid", "abstained", "correct", "epoch", "benchmark_version"]
_EFFECT = [*_CELL, *_ALONG, "dose", "side"]
_PATH = [*_CELL, "source", "kind", "layer", "alpha", "side"]
_PATH_SETS = {ALL: STEERING_PATHS, **PATH_SETS}


def paper_protocol_rows(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of the paper's protocol: void or unsteered, alphas, signs by label."""
    return rows.loc[rows["kind"].isin(["void", UNSTEERED]) & (rows["unit"] == "alpha") & (rows["signs"] == "label")]


def answers_of_paths(answers: pd.DataFrame, votes: pd.DataFrame, fluency: pd.DataFrame | None = None) -> pd.DataFrame:
    """Return steered answers with verdicts (and `nats` by `fluency`), one row per path that they belong to."""
    columns = ["side", "alpha", "scenario_id", "alpha_relative", "degenerate", "request_key", "epoch"]
    judged_answers = _with_verdicts(pd.DataFrame(answers[[*_ANSWER, *columns]]), votes)
    keys = [*_CELL, "item_id", "request_key"]
    nats = pd.DataFrame(columns=[*keys, "nats"]) if fluency is None else fluency[[*keys, "nats"]]
    judged_answers = judged_answers.merge(nats, on=keys, how="left")
    steered_answers = judged_answers.loc[judged_answers["kind"] != UNSTEERED]
    unsteered_answers = judged_answers.loc[judged_answers["kind"] == UNSTEERED].drop(columns=_ALONG)
    keys = [*_RUN, "dataset", "side", "scenario_id"]  # compare a path with unsteered answers to its scenarios
    paths = steered_answers[[*keys, *_ALONG]].drop_duplicates()
    return pd.concat([steered_answers, unsteered_answers.merge(paths, on=keys)], ignore_index=True)


def _with_verdicts(answers: pd.DataFrame, votes: pd.DataFrame) -> pd.DataFrame:
    """Return the answers with `abstained` and `correct` of each cell's own votes; null where no majority decides."""
    votes_on, no_votes = dict(iter(votes.groupby(_CELL))), votes.head(0)
    parts: list[pd.DataFrame] = []
    for cell, cell_answers in answers.groupby(_CELL, sort=False):
        matrix = ratings(votes_on.get(cell, no_votes), answer=_ANSWER)
        tasks = {"abstained": ABSTENTION, "correct": CORRECTNESS}
        parts.append(
            cell_answers.assign(
                **{n: vote_decisions(majority(matrix.on(cell_answers, t)[0])) for n, t in tasks.items()}
            )
        )
    return pd.concat(parts, ignore_index=True)


def effect_rows(
    answers: pd.DataFrame, votes: pd.DataFrame, fluency: pd.DataFrame | None = None
) -> list[SteeringEffectRow]:
    """Return STEERING_EFFECTS rows: abstention by path, dose, kind of direction, draw, layer, side."""
    rows: list[SteeringEffectRow] = []
    for key, group in answers_of_paths(answers, votes, fluency).groupby(_EFFECT, sort=True):
        row_keys = dict(zip(_EFFECT, cast(tuple[Any, ...], key), strict=True))
        target = row_keys.pop("dataset")
        abstentions, correct = (group[name].dropna().to_numpy(bool) for name in ("abstained", "correct"))
        n, yes = len(abstentions), int(np.count_nonzero(abstentions))
        low, high = wilson(np.array([yes]), np.array([len(group)]))
        nats = group["nats"].dropna().to_numpy(float)
        relative = group["alpha_relative"].dropna()
        rows.append(
            SteeringEffectRow(
                **row_keys,
                target=target,
                transfer_type=transfer_type(str(row_keys["source"]), str(target)),
                alpha=float(group["alpha"].iloc[0]),
                alpha_relative=float(relative.iloc[0]) if len(relative) else None,
                correct=int(np.count_nonzero(correct)),
                n_correct=len(correct),
                degenerate=int(np.count_nonzero(group["degenerate"].notna())),
                n=n,
                n_missing=len(group) - n,
                abstained=yes,
                abstention=yes / len(group),
                undecided=1 - n / len(group),
                perplexity=float(np.exp(nats.mean())) if len(nats) else None,
                low=float(low[0]),
                high=float(high[0]),
                epoch="+".join(sorted(set(group["epoch"]))),
            )
        )
    return rows


def share_rows(
    answers: pd.DataFrame, votes: pd.DataFrame, resamples: int = RESAMPLES, seed: int = SEED
) -> list[SteeringShareRow]:
    """Return STEERING_SHARES rows: abstention under the paper's protocol, averaged over sets of paths.

    There are rows for each regime of directions and of answers and over all regimes, with an interval from resampled
    scenarios (all paths share the scenarios of a resample, and the unseen one).
    """
    path_answers = answers_of_paths(paper_protocol_rows(answers), paper_protocol_rows(votes))
    path_answers = path_answers.merge(
        path_answers.loc[path_answers["side"] == "void", ["model", "layer"]].drop_duplicates()
    )  # no sweep
    path_answers = path_answers.assign(
        undecided=path_answers["abstained"].isna(), abstained=path_answers["abstained"].eq(True).fillna(False)
    )
    rows: list[SteeringShareRow] = []
    for _, model_answers in path_answers.groupby("model", sort=True):
        paths = pd.DataFrame(model_answers[_PATH]).drop_duplicates(ignore_index=True)
        numbered = model_answers.merge(paths.reset_index(names="path"), on=_PATH)
        ends = _shares(numbered, len(paths), resamples, seed)
        for pool, members in _pools(paths):
            pool_answers = numbered.loc[np.isin(numbered["path"], members)]
            mean_ends = ends[:, members].mean(axis=1)
            low, high = interval(mean_ends[:, 1:], mean_ends[0, 0], (0.0, 1.0))
            rows.append(
                SteeringShareRow(
                    **pool,
                    n_paths=len(pool_answers[["source", "dataset"]].drop_duplicates()),
                    n=len(pool_answers),
                    n_answers=len(set(pool_answers["request_key"])),
                    n_scenarios=len(set(pool_answers["scenario_id"])),
                    abstention=float(mean_ends[0, 0]),
                    undecided=float(pool_answers.groupby("path")["undecided"].mean().mean()),
                    low=float(low),
                    high=float(high),
                    epoch="+".join(sorted(set(pool_answers["epoch"]))),
                )
            )
    return rows


def _shares(numbered: pd.DataFrame, n_paths: int, resamples: int, seed: int) -> np.ndarray:
    """Return ends of each path's share, (2, paths, 1 + resamples), observed first; paths share one unseen scenario."""
    ends = np.empty((2, n_paths, 1 + resamples))
    numbered = numbered.assign(taxonomy=numbered["dataset"].map(taxonomy_of))
    resampling = draw_scenarios(numbered, resamples, seed)
    for taxonomy in TAXONOMIES:
        own_answers = numbered.loc[numbered["taxonomy"] == taxonomy]
        names, weights = resampling.scenarios[taxonomy]
        path, path_names = pd.factorize(own_answers["path"])
        counts = np.zeros((len(names), len(path_names), 2))
        places = names.get_indexer(pd.Index(own_answers["scenario_id"])), path
        np.add.at(counts[..., 0], places, own_answers["abstained"].to_numpy(bool))
        np.add.at(counts[..., 1], places, 1)
        sums = with_unseen(
            resampled_sums(weights, counts), (counts[..., 1:] > 0).sum(axis=0), resampling.unseen(taxonomy, decisions=1)
        )
        ends[:, path_names] = shares_of(sums)[:, :, 0]
    return ends


def _pools(paths: pd.DataFrame) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """Yield the path sets to average: their naming columns, and rows of `paths`."""
    pairs = pd.Series(list(zip(paths["source"], paths["dataset"], strict=True)), index=paths.index)
    values_by_name = {name: [ALL, *sorted(set(paths[name]))] for name in ("directions", "regime")}
    for (path_set, members), directions, regime in product(
        _PATH_SETS.items(), values_by_name["directions"], values_by_name["regime"]
    ):
        is_member = pairs.isin(members)
        for name, value in (("directions", directions), ("regime", regime)):
            is_member &= (paths[name] == value) | (value == ALL)
        for key, group in paths.loc[is_member].groupby(["model", "kind", "layer", "alpha", "side"], sort=True):
            names = dict(zip(("model", "kind", "layer", "alpha", "side"), cast(tuple[Any, ...], key), strict=True))
            yield names | {"path_set": path_set, "directions": directions, "regime": regime}, group.index.to_numpy()
