"""The tables of probes and steering, compared with the paper's printed tables and hand-worked effects."""

from __future__ import annotations

import pandas as pd
import pytest

from tools.paper_audit.printed_rows import published_rows
from traps_pipeline.mechanism import effects
from traps_pipeline.mechanism.transfer_paths import PATH_SETS, STEERING_PATHS, TRANSFER_TYPES
from traps_pipeline.report.published_results import PublishedResults
from traps_pipeline.report.tables import probe_tables

PAPER = PublishedResults()


def made_up(abstention: dict[tuple[str, float], float], kind: str = "void", layer: int = 5) -> pd.DataFrame:
    """Effects in which a direction's source decides: occlusion sources move controls by 0.5, chaotic ones by 0.1."""
    rows = []
    for source, target in STEERING_PATHS:
        moved = 0.5 if source.startswith("occlusion") else 0.1
        for (side, alpha), base in abstention.items():
            value = base + (moved if side == "control" else -moved) * (alpha > 0)
            rows.append((source, target, side, alpha, value))
    frame = pd.DataFrame(rows, columns=["source", "target", "side", "alpha", "abstention"])
    return frame.assign(model="m", directions="guided", regime="guided", kind=kind, layer=layer)


BASE = {("control", 0.0): 0.2, ("control", 10.0): 0.2, ("void", 0.0): 0.8, ("void", 10.0): 0.8}


def test_means_over_the_eight_transfer_paths_are_those_of_the_papers_text() -> None:
    qwen = effects.regime_matrix(PAPER.effects.query("model == 'qwen3-vl-8b'")).query("path_set == 'transfer'").iloc[0]
    assert qwen["n_paths"] == 8
    assert (qwen["control_top"], qwen["void_top"]) == (pytest.approx(0.54, abs=0.005), pytest.approx(0.32, abs=0.005))
    prompts = {"direction_regime": "standard", "inference_regime": "guided", "direction_family": "all"}
    (printed,) = published_rows("steering_regime", model="qwen3-vl-8b", **prompts)
    assert (printed["control_alpha10"], printed["void_alpha10"]) == (54, 32)


def test_families_and_domains_of_made_up_effects_are_as_worked_out() -> None:
    rows = made_up(BASE)
    whole = effects.regime_matrix(rows).set_index("path_set")
    assert whole.loc["transfer", ["n_paths", "alpha", "control_0", "void_0"]].tolist() == [8, 10, 0.2, 0.8]
    assert whole.loc["transfer", "control_top"] == pytest.approx(0.2 + (4 * 0.5 + 4 * 0.1) / 8)
    families = effects.family_asymmetry(rows).set_index(["path_set", "family"])
    for path_set in PATH_SETS:
        assert families.loc[(path_set, "occlusion"), "control_top"] == pytest.approx(0.7)
        assert families.loc[(path_set, "chaotic"), "void_top"] == pytest.approx(0.7)
    domains = effects.domains(rows).set_index("source")
    assert len(domains) == 4 and domains[["same", "cross"]].notna().all(axis=None)
    assert domains.loc["chaotic", "same"] == pytest.approx(0.3)


def test_a_random_direction_stands_in_rows_of_its_own() -> None:
    rows = pd.concat([made_up(BASE), made_up(dict.fromkeys(BASE, 0.2), "random")])
    matrix = effects.regime_matrix(rows)
    assert matrix.groupby("kind").size().to_dict() == {"void": 2, "random": 2}
    assert matrix["kind"].tolist() == ["void", "random"] * 2


def test_the_sweep_is_the_mean_of_four_splits_on_their_own_controls() -> None:
    controls = {key: value for key, value in BASE.items() if key[0] == "control"}
    deep = made_up(controls, layer=9)
    rows = pd.concat([made_up(BASE), deep[deep["source"] == deep["target"]]])
    table = effects.sweep(rows).set_index(["layer", "alpha"])
    assert set(table["n_splits"]) == {4}
    assert table.loc[(9, 10.0), "control"] == pytest.approx((0.7 + 0.7 + 0.3 + 0.3) / 4)
    assert effects.sweep(made_up(BASE)).empty  # one layer is no sweep
    assert set(effects.paths(rows)["layer"]) == {5}  # the sweep has no voids: it is no path


def test_means_over_four_paths_differ_between_all_samples_and_cf_by_what_the_paper_claims() -> None:
    means = next(t for t in probe_tables.probes(PAPER) if t.name == "probe_means").rows
    qwen = means.query("model == 'qwen3-vl-8b'")
    assert qwen["transfer_type"].tolist() == list(TRANSFER_TYPES[:3]) and set(qwen["n_paths"]) == {4}
    assert (qwen["best_value"] - qwen["cf_value"]).abs().max() == pytest.approx(0.03, abs=0.005)
    assert qwen["best_value"].round(3).tolist() == [0.851, 0.726, 0.794]


def test_published_rows_without_a_figure_are_left_out_and_not_invented() -> None:
    cosines = PAPER.cosines.set_index(["model", "dataset", "other_dataset"])["cosine"]
    assert cosines["qwen3-vl-8b", "occlusion", "chaotic"] == -0.05
    assert cosines["gemma-4-e4b", "chaotic_ill_posed", "chaotic"] == 0.55
    assert ("llava-next-video-7b", "chaotic", "occlusion") not in cosines.index
    assert set(PAPER.effects["directions"]) == {"standard"} and set(PAPER.effects["regime"]) == {"guided"}
