"""An experiment names models and their questions; the error about a wrong one names file and field."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from tests.build.errors import raises
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.pipeline.experiment import load_experiment
from traps_pipeline.protocol.datasets import DATASETS, datasets_of_category
from traps_pipeline.scoring.doses import DATASETS_READ, RULES
from traps_pipeline.storage.study import Study


def experiment(tmp_path: Path, text: str) -> str:
    (tmp_path / "my.yaml").write_text("name: my\nmodels: [oracle, random-50]\n" + text)
    return str(tmp_path / "my.yaml")


def test_all_datasets_and_regimes_are_asked_where_none_is_named_and_a_model_has_no_more_runs_than_it_has(
    tmp_path: Path,
) -> None:
    cells = load_experiment(experiment(tmp_path, "runs: [1, 2, 3]\n")).cells()
    by_model = [sum(c.evaluation.model == model for c in cells) for model in ("oracle", "random-50")]
    assert by_model == [len(DATASETS) * 3 * 1, len(DATASETS) * 3 * 3]
    assert len(set(cells)) == len(cells)
    some = load_experiment(experiment(tmp_path, "datasets: [chaotic]\nregimes: [json]\n")).cells()
    assert [cell.key for cell in some] == ["chaotic|oracle__json__run1", "chaotic|random-50__json__run1"]


def test_the_experiments_of_hypotheses_ask_every_dose_and_what_it_is_compared_with() -> None:
    for name in ("hypotheses", "hypotheses-pocket"):
        found = load_experiment(name)
        assert set(found.datasets) == set(DATASETS_READ)
        assert {*RULES} <= {*found.models}  # the trivial thing that would give a number too
        assert not {"occlusion_ill_posed", "chaotic_ill_posed"} & {*found.datasets}  # so it has no overall PECS


def test_the_experiment_of_graded_cuts_asks_scenarios_that_have_one() -> None:
    found, released = load_experiment("graded"), load_released()
    assert (found.datasets, found.regimes) == (["graded"], ["priced", "probabilities", "logprobs"])
    assert {released[scenario].taxonomy for scenario in found.study.scenarios or ()} == {"chaotic"}


def test_the_study_of_an_experiment_is_its_benchmark_subset_panel_and_budget(tmp_path: Path) -> None:
    text = "per_family: 2\nepoch: '7'\nbudget_usd: 3\n"
    assert load_experiment(experiment(tmp_path, text)).study == Study(per_family=2, epoch="7", budget_usd=3)


@pytest.mark.parametrize(
    "text",
    [
        "datasets: [chaos]\n",
        "regimes: []\n",
        "regimes: [json, json]\n",
        "runs: [0]\n",
        "runs: [1, 1]\n",
        "scenarios: [plinko-0001, plinko-0002, plinko-0001]\n",
        "mechanism: {models: {m: {steering: 1, centroid: 1}}, prompts: [standard, standard]}\n",
        "mechanism: {models: {m: {steering: 1, centroid: 1, sweep: [2, 2]}}}\n",
        "model: oracle\n",
        "per_family: 0\n",
        "budget_usd: -1\n",
        "per_family: 1\nscenarios: [plinko-0001]\n",
        "epoch: 'a b'\n",
        "datasets: [\n",
        "datasets: [schema_abstain]\n",
        "scenarios: []",
        "runs: []",
    ],
)
def test_a_wrong_experiment_names_its_file_and_field(tmp_path: Path, text: str) -> None:
    with raises(TrapsError, "base.yamlfile", "my.yaml"):
        load_experiment(experiment(tmp_path, text))


def test_an_arm_of_an_earlier_version_is_answered_with_what_takes_its_place(tmp_path: Path) -> None:
    with raises(TrapsError, "base.yamlfile", "crossed", "two_events"):
        load_experiment(experiment(tmp_path, "datasets: [occlusion, crossed]\n"))


@pytest.mark.parametrize(
    ("datasets", "scenarios"),
    [("[two_events]", "[slide-e001]"), ("[length_matched]", "[plinko-0001]"), ("[occlusion]", "[plinko-0001]")],
)
def test_an_experiment_that_looks_inside_without_pairs_is_refused_before_anything_is_made(
    tmp_path: Path, datasets: str, scenarios: str
) -> None:
    inside = "mechanism: {models: {pocket: {steering: 3, centroid: 4}}}\n"
    with raises(TrapsError, "base.yamlfile.name_file_in_errors", "my.yaml", datasets[1:-1], *DATASETS):
        load_experiment(experiment(tmp_path, f"datasets: {datasets}\nscenarios: {scenarios}\n{inside}"))
    load_experiment(experiment(tmp_path, f"datasets: {datasets}\nscenarios: {scenarios}\n"))


def test_an_unknown_model_or_experiment_is_answered_with_the_known_ones(tmp_path: Path) -> None:
    path = tmp_path / "other.yaml"
    path.write_text("name: other\nmodels: [oracle, gpt-6]\n")
    with raises(TrapsError, "base.yamlfile.name_file_in_errors", "other.yaml", "gpt-6"):
        load_experiment(str(path))
    with raises(TrapsError, "pipeline.experiment.load_experiment", "demmo", "demo"):
        load_experiment("demmo")


def test_no_panel_judges_unless_the_experiment_the_command_or_the_study_names_it(tmp_path: Path) -> None:
    silent = load_experiment(experiment(tmp_path, ""))
    with raises(TrapsError, "models.registry.judges.load_panel", "--panel"):
        silent.judged(None, None)
    assert silent.judged(None, "rules").panel == "rules"
    assert silent.judged(Study(panel="paper"), None).panel == "paper"
    named = load_experiment(experiment(tmp_path, "panel: paper\n"))
    assert named.judged(Study(panel="rules"), "paper").panel == "paper"
    with raises(TrapsError, "pipeline.experiment.Experiment.judged", "rules", "paper"):
        named.judged(None, "rules")


def test_rules_judge_reference_models_and_others_only_where_somebody_says_so(tmp_path: Path) -> None:
    path = tmp_path / "my.yaml"
    path.write_text("name: my\nmodels: [oracle, gpt-5-high]\npanel: rules\n")
    mine = load_experiment(str(path))
    with raises(TrapsError, "models.registry.judges.require_panel", "gpt-5-high", "--judged-by-rules"):
        mine.judged(None, None)
    assert mine.judged(None, None, judged_by_rules=True).judged_by_rules
    assert mine.judged(Study(panel="rules", judged_by_rules=True), None).panel == "rules"


def test_the_paper_experiment_holds_the_behavioural_and_the_mechanistic_half() -> None:
    paper = load_experiment("paper")
    # Sixteen models on four datasets under three regimes; fifteen of them in three runs, the greedy one in one.
    assert len(paper.models) == 16 and len(paper.cells()) == (15 * 3 + 1) * 3 * 4
    inside = paper.mechanism
    assert inside is not None and inside.steering is not None and inside.pooling == "last"
    assert {name: layers.steering for name, layers in inside.models.items()} == {
        "qwen3-vl-8b": 20,
        "gemma-4-e4b": 35,
        "llava-next-video-7b": 28,
    }
    assert inside.models["gemma-4-e4b"].sweep == (1, 17)  # and 35, which is steered anyway
    media = inside.models["qwen3-vl-8b"].media
    assert media is not None and media.uniform == 25  # as its steering was; it answers about 16 frames
    assert (inside.steering.alphas, inside.steering.pairs) == ((2, 5, 10), 50)
    assert (inside.steering.well_posed_pairs, inside.steering.ill_posed_pairs) == (100, 50)
    assert inside.steering.direction_regimes == inside.steering.inference_regimes == ("standard", "guided")


def test_the_lite_set_is_100_scenarios_of_each_taxonomy_with_every_family_in_its_share(tmp_path: Path) -> None:
    lite = load_experiment(experiment(tmp_path, "scenarios: lite\n")).scenarios
    assert lite is not None and len(set(lite)) == 200
    released = load_released()
    for taxonomy in ("occlusion", "chaotic"):
        whole = Counter(spec.family for spec in released.values() if datasets_of_category(spec.category)[0] == taxonomy)
        part = Counter(released[name].family for name in lite if released[name].family in whole)
        assert sum(part.values()) == 100 and part.keys() <= whole.keys()
        assert all(abs(part[family] - 100 * n / sum(whole.values())) <= 1 for family, n in whole.items())
