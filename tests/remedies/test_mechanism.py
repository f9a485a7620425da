"""What errors about states, probes and directions say to do lets the same stage, fit or hook succeed."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.local_models import QUESTIONS, SYSTEM, ask, model
from tests.mechanism.study import PAIRS, SETTINGS, make_study, write_verdicts
from tests.mechanism.test_directions import origin, pair_states
from tests.mechanism.test_gate import study as gated
from tests.mechanism.test_probes import LAYERS, random_states
from tests.mechanism.test_probes import study as probed
from tests.mechanism.test_stages import STANDARD, entry, own, patch, study
from tests.remedies.remedied import carries_out, remedied
from traps_pipeline import inside
from traps_pipeline.base.partitions import DATASETS, Extraction, StatesCell
from traps_pipeline.benchmark.tables import SCENE_SPECS, VIDEOS
from traps_pipeline.mechanism import margin, stages
from traps_pipeline.mechanism.baselines import output_margins, probed_items
from traps_pipeline.mechanism.contrast import contrast_states
from traps_pipeline.mechanism.directions import extract_directions, load_directions, save_directions
from traps_pipeline.mechanism.gate import OTHER_DATASETS, Items, decide
from traps_pipeline.mechanism.hidden_states import Item, Pooling, item_states
from traps_pipeline.mechanism.hook import Steering
from traps_pipeline.mechanism.other_probes import fit_named
from traps_pipeline.mechanism.patched import WELL_POSED, patching_rows
from traps_pipeline.mechanism.probe_items import probe_items
from traps_pipeline.mechanism.probes import fit_probe, scenario_folds, solve_gram
from traps_pipeline.mechanism.probing import NothingConfabulated, ProbeRun, confabulated_scenarios
from traps_pipeline.mechanism.steering import strengths
from traps_pipeline.mechanism.stored import StoredStates
from traps_pipeline.mechanism.tables import DIRECTIONS, HIDDEN_STATES, PROBE_ITEMS
from traps_pipeline.models.local.adapter import load_local_model
from traps_pipeline.models.registry import ModelEntry
from traps_pipeline.orchestration.wanted import Wanted
from traps_pipeline.storage.study import Asked, MechanismSettings, PatchingSettings, ProbeSettings
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow
__all__ = ["entry", "own", "patch", "study"]  # fixtures
CHAOTIC = StatesCell("chaotic", STANDARD)


def extracted(workspace: Workspace, cell: StatesCell = CHAOTIC) -> Callable[[], None]:
    """The stage hidden_states of a partition, materialized."""

    def make() -> None:
        rows, _ = stages.extract_states(workspace, cell)
        workspace.tables.write(HIDDEN_STATES, cell.partition, rows, {})

    return make


def with_directions(workspace: Workspace) -> Callable[[], None]:
    """The stage directions, materialized."""

    def make() -> None:
        workspace.tables.write(DIRECTIONS, STANDARD.partition, stages.direction_rows(workspace, STANDARD), {})

    return make


# --- arrays -----------------------------------------------------------------------------------------------------------


def test_a_probe_is_fitted_to_more_items_and_to_finite_states() -> None:
    states, void = random_states(20, 5)
    remedied(
        lambda: fit_probe(states[void], void[void]),
        "a probe needs void and control items, but {} of {} items are void; extract more items",
        again=lambda: fit_probe(states, void),
    )
    gram = states @ states.T
    remedied(
        lambda: solve_gram(np.full((20, 20), np.nan), void),
        "the states are not finite, or too large for float64; extract them again",
        again=lambda: solve_gram(gram, void),
    )
    for folds, scenarios in ((4, 4), (5, 5)):
        remedied(
            lambda: scenario_folds(np.arange(4), 5, seed=1),
            "{} folds need {} scenarios, but there are {}; lower `folds` or extract more",
            again=lambda folds=folds, scenarios=scenarios: scenario_folds(np.arange(scenarios), folds, seed=1),
        )


def test_a_protocol_runs_on_states_that_were_extracted_again() -> None:
    items, states = probed(pairs=4)
    settings = ProbeSettings(folds=2, resamples=100, shuffles=20)

    def run(rows: pd.DataFrame, of: Callable[[str, int], np.ndarray]) -> object:
        return ProbeRun(rows, of, LAYERS, 1, settings, 7).layer_rows(0)

    def whole(dataset: str, layer: int) -> np.ndarray:
        return states[dataset, layer]

    remedied(
        lambda: run(items.iloc[:0], whole),
        "mechanism/probing.py | no hidden states of any dataset; materialize hidden_states first",
        again=lambda: run(items, whole),
    )
    remedied(
        lambda: run(items, lambda dataset, layer: states[dataset, layer][:3]),
        "items, or not all finite; materialize hidden_states for this dataset again",
        again=lambda: run(items, whole),
    )


def test_more_scenarios_have_confabulations() -> None:
    rows = pd.DataFrame([("a", "void", False), ("b", "void", True)], columns=["scenario_id", "side", "abstained"])
    found = remedied(
        lambda: confabulated_scenarios(rows[1:], "chaotic", "m"),
        "there is no Cf->Cf probe of this dataset; take more scenarios, or read the all-sample curves",
        again=lambda: confabulated_scenarios(rows, "chaotic", "m"),
        error=NothingConfabulated,
    )
    assert found == {"a"}


def test_directions_of_more_scenarios_are_made_and_damaged_files_are_written_again(tmp_path: Path) -> None:
    void, control = pair_states()
    made = remedied(
        lambda: extract_directions(void[:, :1], control[:, :1], [1]),
        "a direction needs two pairs at least, but states are {} and {} (layers, pairs, width); take more scenarios",
        again=lambda: extract_directions(void, control, [1]),
    )
    path = tmp_path / "chaotic.safetensors"

    def made_again() -> None:
        path.unlink()
        save_directions(path, made, origin())

    save_directions(path, made, origin())
    path.write_bytes(path.read_bytes()[:-1])
    remedied(lambda: load_directions(path), "{}: damaged ({}); delete it, then `traps run` makes it again", made_again)
    from safetensors.numpy import load_file, save_file

    from traps_pipeline.base.digests import file_digest

    save_file({"void": load_file(path)["void"]}, path)
    note = json.loads(path.with_suffix(".json").read_text())
    path.with_suffix(".json").write_text(json.dumps(note | {"tensors_sha256": file_digest(path)}))
    remedied(
        lambda: load_directions(path),
        "was written by an earlier version; delete it, then `traps run` makes it again",
        made_again,
    )


# --- stages -----------------------------------------------------------------------------------------------------------


def test_states_that_are_missing_or_damaged_are_extracted_again(own: Workspace) -> None:
    folder = own.root / "states" / "tiny" / "standard" / "chaotic"

    def read() -> object:
        return StoredStates.of(own, STANDARD).read("chaotic", 2)

    shutil.rmtree(folder)
    remedied(read, "hidden states are missing or not finished; materialize hidden_states", extracted(own))
    shard = next(folder.glob("shard-*.safetensors"))
    shard.write_bytes(shard.read_bytes()[:100])

    def deleted_and_run() -> None:
        shard.unlink()
        extracted(own)()

    remedied(read, "cannot be read ({}); delete it, then `traps run` extracts its items again", deleted_and_run)
    rows = own.tables.read(HIDDEN_STATES, CHAOTIC.partition)
    own.tables.write(HIDDEN_STATES, CHAOTIC.partition, rows.assign(states_key="another"), {})
    remedied(read, "the shards hold other items than the table; materialize hidden_states for it again", extracted(own))


def test_states_of_another_prompt_are_read_once_they_are_extracted(own: Workspace) -> None:
    guided = Extraction("tiny", "guided")
    remedied(
        lambda: StoredStates.of(own, guided),
        "mechanism/stored.py | no hidden states of {}; materialize hidden_states for it first",
        extracted(own, StatesCell("chaotic", guided)),
    )


def test_directions_are_made_once_states_settings_and_files_are_as_told(own: Workspace) -> None:
    settings = own.mechanism
    own.allow(mechanism=settings.model_copy(update={"steering": None}))
    remedied(
        lambda: stages.direction_rows(Workspace.open(own.root), STANDARD),
        "so the number of pairs for a direction is not known; set it there and in the experiment",
        lambda: own.allow(mechanism=settings),
    )
    file = own.root / "directions" / "tiny" / "standard" / "chaotic.safetensors"
    other = own.root / "directions" / "tiny" / "standard" / "occlusion.safetensors"
    shutil.copy(other, file)
    note = json.loads(other.with_suffix(".json").read_text())
    file.with_suffix(".json").write_text(json.dumps(note | {"dataset": "chaotic"}))

    def deleted_and_run() -> None:
        file.unlink()
        with_directions(own)()

    remedied(
        lambda: stages.saved_directions(own, STANDARD),
        "differs from the directions in the table; delete it, then `traps run` makes it again",
        deleted_and_run,
    )
    shutil.rmtree(own.root / "tables" / "directions")
    remedied(
        lambda: stages.cosine_rows(own),
        "cosines: no directions yet; materialize directions first",
        with_directions(own),
    )


def test_directions_are_made_once_a_dataset_of_the_pairs_has_states(own: Workspace) -> None:
    for dataset in DATASETS:
        own.tables.path(HIDDEN_STATES, StatesCell(dataset, STANDARD).partition).unlink()
    remedied(
        lambda: stages.direction_rows(own, STANDARD),
        "directions {}: no hidden states of any dataset; materialize hidden_states first",
        extracted(own),
    )


def test_a_target_is_steered_once_directions_lead_to_it(own: Workspace) -> None:
    settings, directions = own.mechanism, stages.saved_directions(own, STANDARD)
    layers = settings.models["tiny"]
    remedied(
        lambda: strengths("chaotic", layers, settings, {}),
        "no direction leads to {}; materialize hidden_states and directions first",
        again=lambda: strengths("chaotic", layers, settings, directions),
    )
    fewer = {
        name: extract_directions(*pair_states(layers=5, width=len(of.void[0])), [1], draws=1)
        for name, of in directions.items()
    }
    for of in fewer.values():
        of.vectors.pop("covariance", None)
    remedied(
        lambda: strengths("chaotic", layers, settings, fewer),
        "the directions of {} have no {} draw {}; materialize directions again",
        again=lambda: strengths("chaotic", layers, settings, stages.saved_directions(own, STANDARD)),
    )
    zero = stages.saved_directions(own, STANDARD)
    for of in zero.values():
        of.vectors["void"][0][1] = 0.0
    at_one = layers.model_copy(update={"steering": 1, "sweep": ()})
    remedied(
        lambda: strengths("chaotic", at_one, settings, zero),
        "is zero, since the sides do not differ there; name another layer in the experiment and in study.yaml",
        again=lambda: strengths("chaotic", layers.model_copy(update={"sweep": ()}), settings, zero),
    )


def test_a_model_and_its_layers_are_read_once_the_study_names_them(own: Workspace) -> None:
    settings = own.mechanism
    own.allow(
        mechanism=MechanismSettings.model_validate(SETTINGS | {"models": {"tiny": {"steering": 9, "centroid": 1}}})
    )
    remedied(
        lambda: stages.extract_states(Workspace.open(own.root), CHAOTIC),
        "(layer 0 is the embeddings); name one of these in the experiment and in study.yaml",
        lambda: own.allow(mechanism=settings),
    )
    remedied(
        lambda: stages.examined_model(Workspace.open(own.root), "qwen3-vl-8b"),
        "study.yaml: mechanism.models does not name {}; add it with its layers",
        lambda: own.allow(
            mechanism=settings.model_copy(
                update={"models": {**settings.models, "qwen3-vl-8b": settings.models["tiny"]}}
            )
        ),
    )


@carries_out("there are no verdicts {}; run the model under standard first")
def test_a_dataset_has_confabulations_once_the_model_was_run(own: Workspace) -> None:
    problem = stages.confabulations(own, "tiny").problems["chaotic"]
    assert problem.startswith("there are no verdicts chaotic|tiny__standard__run1; run the model under standard first")
    write_verdicts(own, "chaotic", {f"plinko-{n}": n > 1 for n in range(PAIRS)})
    found = stages.confabulations(own, "tiny")
    assert "chaotic" not in found.problems and found.scenarios["chaotic"] == {"plinko-0", "plinko-1"}


def test_probe_items_are_made_once_scenes_and_clips_are(entry: ModelEntry, tmp_path: Path) -> None:
    workspace = make_study(tmp_path)
    hidden = {"category": "hidden"}
    specs, videos = (workspace.tables.read(table, hidden) for table in (SCENE_SPECS, VIDEOS))

    def answerable() -> list[object]:
        return list(probe_items(workspace, "occlusion_answerable"))

    workspace.tables.write(VIDEOS, hidden, videos[videos["side"] == "control"], {})
    remedied(
        answerable,
        "{}: has no void clip yet; materialize videos for {}",
        lambda: workspace.tables.write(VIDEOS, hidden, videos, {}),
    )
    workspace.tables.path(SCENE_SPECS, hidden).unlink()
    remedied(
        answerable,
        "no occlusion scenarios yet; materialize scene_specs and videos first",
        lambda: workspace.tables.write(SCENE_SPECS, hidden, specs, {}),
    )


def test_a_direction_of_this_model_and_a_block_that_it_has_are_steered(study: Workspace, entry: ModelEntry) -> None:
    model = load_local_model(entry)
    push = inside.direction(study, "tiny", "chaotic", layer=2)

    def steer(vector: np.ndarray, layer: int) -> Callable[[], None]:
        def call() -> None:
            with Steering(vector, layer, (3.0,)).applied(model):
                pass

        return call

    remedied(
        steer(push.vector[:-1], 2),
        "whose states are {} finite numbers: extract it from this model",
        again=steer(push.vector, 2),
    )
    remedied(
        steer(push.vector, 9),
        "(layer 0 are the embeddings, layer l the output of the l-th block): name one of these",
        again=steer(push.vector, 4),
    )

    def apply(of: inside.Direction, **dose: float) -> Callable[[], None]:
        def call() -> None:
            with of.apply(model, **dose):
                pass

        return call

    bare = inside.Direction(push.vector, 2)
    for right in ({"amount": 1.0}, {"gaps": 1.0}):
        remedied(apply(push, amount=1.0, gaps=1.0), "give amount, or gaps, and not both", again=apply(push, **right))
    for of, dose in ((bare, {"amount": 1.0}), (push, {"gaps": 1.0})):
        remedied(
            apply(bare, gaps=1.0),
            "this direction has no class gap; give amount, or take a direction of `inside.direction`",
            again=apply(of, **dose),
        )


def test_items_and_states_are_joined_once_states_are_extracted_again(own: Workspace) -> None:
    items = own.tables.read(PROBE_ITEMS, {"dataset": "chaotic"})
    own.tables.write(PROBE_ITEMS, {"dataset": "chaotic"}, items[1:], {})
    joined = remedied(
        lambda: probed_items(own, StoredStates.of(own, STANDARD), "chaotic"),
        "probe_items {}: has no {}, which has states; materialize hidden_states again",
        extracted(own),
    )
    assert list(joined["item_id"]) == list(items["item_id"][1:])


def test_a_margin_is_read_and_parts_are_averaged_under_a_pooling_that_there_is(
    own: Workspace, entry: ModelEntry
) -> None:
    settings = own.mechanism

    def pooled(pooling: str) -> Workspace:
        own.allow(mechanism=settings.model_copy(update={"pooling": pooling}))
        return Workspace.open(own.root)

    extracted(pooled("mean"))()
    margins = remedied(
        lambda: output_margins(entry, StoredStates.of(own, STANDARD), ["chaotic"]),
        "states are means over tokens; set `pooling: last` to read the output margin",
        lambda: extracted(pooled("last"))(),
    )
    assert np.isfinite(margins["chaotic"]).all() and len(margins["chaotic"]) == 2 * PAIRS


def test_parts_that_a_prompt_lacks_are_not_averaged() -> None:
    of = model("llava-next-video")
    prompt = ask(of, QUESTIONS[1])

    def states(pooling: Pooling) -> Callable[[], object]:
        about = {"system": SYSTEM, "question": QUESTIONS[1]}
        return lambda: item_states(of, Item("one", "control", about, lambda: prompt), prompt, pooling)

    remedied(
        states("stamps"),
        "mechanism/hidden_states.py | {}: its prompt for {} has no {}; choose another pooling",
        again=states("question"),
    )


def test_what_needs_an_abstentions_first_token_is_left_out_for_a_model_without_one(
    own: Workspace, entry: ModelEntry, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = Asked(datasets=("chaotic",), models=("tiny",), regimes=("standard",), runs=(1,), mechanism=True)
    patching = own.mechanism.model_copy(update={"patching": PatchingSettings(pairs=1)})
    own.allow(mechanism=patching, experiments={"inside": asked}, scenarios=["plinko-0001"])
    monkeypatch.setattr(margin, "begins_abstention", lambda token: False)  # as in a vocabulary of another language

    def patched_if_wanted() -> object:
        workspace = Workspace.open(own.root)
        return patching_rows(workspace, entry, STANDARD) if Wanted(workspace).patches else None

    nothing = remedied(
        patched_if_wanted,
        "so its output margin cannot be read; set `patching: null` in the experiment and in study.yaml",
        lambda: Workspace.open(own.root).allow(mechanism=patching.model_copy(update={"patching": None})),
    )
    assert nothing is None


def test_a_model_that_cannot_be_patched_is_left_out(
    own: Workspace, entry: ModelEntry, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = Asked(datasets=("chaotic",), models=("tiny",), regimes=("standard",), runs=(1,), mechanism=True)
    patching = own.mechanism.model_copy(update={"patching": PatchingSettings(pairs=1)})
    own.allow(mechanism=patching, experiments={"inside": asked}, scenarios=["plinko-0001"])
    text = load_local_model(entry, inside=True).network.config.get_text_config()
    monkeypatch.setattr(text, "altup_num_inputs", 4, raising=False)  # as Gemma 3n has several residual streams

    def patched_if_wanted() -> object:
        workspace = Workspace.open(own.root)
        return patching_rows(workspace, entry, STANDARD) if Wanted(workspace).patches else None

    nothing = remedied(
        patched_if_wanted,
        "so that its effects would be too small; set `patching: null` in the experiment and in study.yaml",
        lambda: Workspace.open(own.root).allow(mechanism=patching.model_copy(update={"patching": None})),
    )
    assert nothing is None


def test_activations_are_patched_once_there_are_probe_items(own: Workspace, entry: ModelEntry) -> None:
    own.allow(mechanism=own.mechanism.model_copy(update={"patching": PatchingSettings(pairs=1, sites=("residual",))}))
    items = {dataset: own.tables.read(PROBE_ITEMS, {"dataset": dataset}) for dataset in WELL_POSED}
    for dataset in WELL_POSED:
        own.tables.path(PROBE_ITEMS, {"dataset": dataset}).unlink()
    rows = remedied(
        lambda: patching_rows(Workspace.open(own.root), entry, STANDARD),
        "patching: no pairs of a well-posed dataset; materialize probe_items first",
        lambda: own.tables.write(PROBE_ITEMS, {"dataset": "chaotic"}, items["chaotic"], {}),
    )
    assert {row.dataset for row in rows} == {"chaotic"}


def test_pairs_of_statements_are_read_once_the_dataset_has_states(own: Workspace) -> None:
    cell = StatesCell("occlusion", STANDARD)
    own.tables.path(HIDDEN_STATES, cell.partition).unlink()
    made = remedied(
        lambda: contrast_states(own, STANDARD, 2, ["occlusion"]),
        "mechanism/contrast.py | no hidden states of {}; materialize hidden_states for it first",
        extracted(own, cell),
    )
    assert len(made["occlusion"]) == 2 * PAIRS


def test_features_of_all_items_are_put_through_the_protocol(study: Workspace) -> None:
    whole = inside.load(study, "tiny", layer=2)

    def figures(features: inside.Loaded) -> Callable[[], pd.DataFrame]:
        return lambda: inside.protocol(study, "tiny", layer=2, features=features)

    remedied(
        figures(inside.Loaded(whole.X[2:], whole.items.iloc[2:])),
        "`features` lacks {} items of {}; give all items of it",
        again=figures(whole),
    )


def test_a_gate_is_fitted_once_a_dataset_of_its_source_has_states() -> None:
    items, _ = gated()
    target = (items.table["dataset"] == "chaotic").to_numpy()
    alone = Items(items.table[target].reset_index(drop=True), items.features[target])
    settings = {"folds": 3, "seed": 1, "false_abs": 0.05}
    remedied(
        lambda: decide(alone, OTHER_DATASETS, "chaotic", **settings),
        "a gate from {} has no items; extract the hidden states of its datasets first",
        again=lambda: decide(items, OTHER_DATASETS, "chaotic", **settings),
    )


def test_a_further_probe_is_named_by_a_name_that_there_is() -> None:
    states, void = random_states(20, 5)
    remedied(
        lambda: fit_named("os.system", 1),
        "no probe {}; name one of {}, or a classifier of scikit-learn by its class, e.g. LinearSVC",
        again=lambda: fit_named("mean difference", 1),
    )
    fit = remedied(
        lambda: fit_named("StackingClassifier", 1),
        "probe {} cannot be made without settings ({}); name another classifier",
        again=lambda: fit_named("LinearSVC", 1),
    )
    assert fit(states, void).scores(states).shape == (20,)
