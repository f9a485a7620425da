"""The machine is looked at before the first stage, for what the stages to come need and nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from tests.conftest import ROOT, Checkout

pytestmark = pytest.mark.slow

EXPERIMENT = {
    "name": "tiny",
    "models": ["oracle"],
    "panel": "rules",
    "regimes": ["standard"],
    "runs": [1],
    "datasets": ["occlusion"],
    "scenarios": ["domino_chain-0001"],
}


def test_opengl_that_does_not_draw_ends_a_run_before_its_first_table_unless_the_clips_are_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    experiment = tmp_path / "tiny.yaml"
    experiment.write_text(yaml.safe_dump(EXPERIMENT))
    study = Checkout(ROOT, tmp_path / "study")
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    refused = study.traps("run", experiment)
    assert (refused.code, refused.raised) == (1, "scenes.picture.trial.check_rendering")
    (sentence,) = refused.err.splitlines()
    assert "MUJOCO_GL=nonsense" in sentence
    assert not any((study.workspace / "tables").iterdir())

    stages = ("--select", "scene_specs,videos", "--partition", "dominoes")
    refused = study.dagster("asset", "materialize", "-m", "traps_pipeline.definitions", *stages)
    assert refused.code == 1
    assert "MUJOCO_GL=nonsense" in refused.err
    assert not any((study.workspace / "tables").iterdir())

    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setenv("PYOPENGL_PLATFORM", "egl")
    refused = study.traps("run", experiment)
    assert (refused.code, refused.raised) == (1, "scenes.picture.trial.check_rendering")
    assert "MUJOCO_GL=osmesa, PYOPENGL_PLATFORM=egl" in refused.err
    monkeypatch.delenv("PYOPENGL_PLATFORM")
    monkeypatch.delenv("MUJOCO_GL")
    assert study.traps("run", experiment, "--until", "videos").code == 0

    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    study.traps("run", experiment, "--until", "responses").ok()


@pytest.mark.parametrize("budget", ["much", "-1", "nobody=3"])
def test_a_budget_that_is_none_is_refused_before_anything_is_written(tmp_path: Path, budget: str) -> None:
    experiment, study = tmp_path / "tiny.yaml", Checkout(ROOT, tmp_path / "study")
    experiment.write_text(yaml.safe_dump(EXPERIMENT))
    assert study.traps("run", experiment, f"--budget-usd={budget}").code == 1
    assert not study.workspace.exists()
    experiment.write_text(yaml.safe_dump(EXPERIMENT | {"model_budgets_usd": {"nobody": 3}}))
    for command in ("init", "run"):
        assert study.traps(command, experiment).code == 1
    assert not study.workspace.exists()


def test_budgets_of_the_command_are_kept_beside_those_of_the_experiment(tmp_path: Path) -> None:
    experiment, study = tmp_path / "tiny.yaml", Checkout(ROOT, tmp_path / "study")
    experiment.write_text(yaml.safe_dump(EXPERIMENT | {"model_budgets_usd": {"oracle": 3}}))
    budgets = ("--budget-usd", "20.50", "--budget-usd", "random-50=2")
    assert study.traps("run", experiment, *budgets, "--until", "scene_specs").code == 0
    kept = yaml.safe_load((study.workspace / "study.yaml").read_text())
    assert (kept["budget_usd"], kept["model_budgets_usd"]) == (20.5, {"oracle": 3.0, "random-50": 2.0})


def test_a_run_for_which_nothing_matches_says_so_and_fails(tmp_path: Path) -> None:
    study = Checkout(ROOT, tmp_path / "study")
    for name, changes in {
        "a": {"datasets": ["occlusion"]},
        "b": {"datasets": ["chaotic"], "models": ["always-abstain"]},
        "no-such-run": {"runs": [9]},
        "no-such-arm": {"datasets": ["predictable_cut"], "scenarios": ["domino_chain-0001"]},
    }.items():
        both = {"name": name, "scenarios": ["domino_chain-0001", "plinko-0001"]}
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump(EXPERIMENT | both | changes))
        place = "other" if name == "no-such-arm" else "study"
        assert study.traps("init", tmp_path / f"{name}.yaml", "--workspace", tmp_path / place).code == 0
    for name, place in (("no-such-run", "study"), ("no-such-arm", "other")):
        ran = study.traps("run", tmp_path / f"{name}.yaml", "--workspace", tmp_path / place)
        assert (ran.code, ran.raised) == (1, "pipeline.run_plan.RunPlan.require_work") and name in ran.err

    materialize = ("asset", "materialize", "-m", "traps_pipeline.definitions", "--select", "responses")
    wanted, unwanted = "occlusion|oracle__standard__run1", "chaotic|oracle__standard__run1"
    alone = study.dagster(*materialize, "--partition", unwanted)
    assert alone.code == 1
    assert any("study.yaml" in line and unwanted in line for line in alone.err.splitlines())
    backwards = study.dagster(*materialize, "--partition-range", f"{unwanted}...{wanted}")
    assert backwards.code == 1
    assert any(unwanted in line and wanted in line for line in backwards.err.splitlines())


def test_proxies_and_certificates_are_looked_at_where_something_is_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = {"id": "mine", "base_url": "http://127.0.0.1:9/v1", "media": "images"}
    experiment = tmp_path / "network.yaml"
    experiment.write_text(yaml.safe_dump(EXPERIMENT | {"models": [own], "judged_by_rules": True, "budget_usd": 1}))
    monkeypatch.setenv("SSL_CERT_FILE", "/nowhere/ca.pem")
    study = Checkout(ROOT, tmp_path / "study")
    refused = study.traps("run", experiment, "--no-preflight")
    assert (refused.code, refused.raised) == (1, "base.network.check_network")
    (sentence,) = refused.err.splitlines()
    assert "SSL_CERT_FILE" in sentence and "/nowhere/ca.pem" in sentence
    assert not any((study.workspace / "tables").iterdir())
    live = study.traps("models", "check", "--live", experiment)
    assert live.code == 1
    assert "SSL_CERT_FILE" in live.out
    assert "Traceback" not in live.err
