"""The mechanistic stages from tables to tables, on a tiny random checkpoint of a real class."""

from __future__ import annotations

import json
from collections.abc import Iterable

import numpy as np
import pandas as pd
import pytest
from pydantic import ValidationError

from tests.build.errors import raises
from tests.build.mechanism import STANDARD, entry, extract_all, own, patch, study
from tests.mechanism.study import PAIRS, write_items, write_verdicts
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.judging.panel import tasks_for
from traps_pipeline.mechanism import stages
from traps_pipeline.mechanism.cosines import cosine_rows
from traps_pipeline.mechanism.directions import vector_digest
from traps_pipeline.mechanism.hook import Steering
from traps_pipeline.mechanism.mechanism_rows import (
    DIRECTIONS,
    HIDDEN_STATES,
    PROBE_ITEMS,
    STEERING,
    STEERING_VOTES,
)
from traps_pipeline.mechanism.nulls import null_rows, pecs_rows
from traps_pipeline.mechanism.probing_versions import extraction_version, joined_models, steering_version
from traps_pipeline.mechanism.shares import effect_rows, paper_protocol_rows
from traps_pipeline.mechanism.steering import (
    UNSTEERED,
    collect_steered,
    collect_steering_votes,
    count_answers,
    strengths,
)
from traps_pipeline.mechanism.stored_states import StoredStates
from traps_pipeline.models.registry.entries import ModelEntry
from traps_pipeline.models.registry.local_settings import MechanismSpec
from traps_pipeline.models.request import WITH_TEXT
from traps_pipeline.pipeline.graph import the_graph
from traps_pipeline.pipeline.lineage import Lineage
from traps_pipeline.pipeline.wanted import StudyPartitions
from traps_pipeline.protocol.cells import Extraction, StatesCell, SteeringCell
from traps_pipeline.protocol.datasets import ANSWERABLE, DATASETS, taxonomy_of
from traps_pipeline.protocol.regimes import RANDOM_WEIGHTS
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.media import MediaSpec
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.study import Asked, MechanismSettings
from traps_pipeline.storage.tables import Table
from traps_pipeline.storage.workspace import Workspace

__all__ = ["entry", "own", "patch", "study"]  # fixtures

pytestmark = pytest.mark.slow


def test_answerable_items_are_the_void_clips_with_the_question_that_they_answer(study: Workspace) -> None:
    own = study.tables.read(PROBE_ITEMS, {"dataset": ANSWERABLE}).set_index("scenario_id")
    voids = study.tables.read(ITEMS, {"dataset": "occlusion"}).query("side == 'void'").set_index("scenario_id")
    assert (own["media_digest"] == voids["media_digest"]).all() and set(own["side"]) == {"control"}
    assert own.loc["hidden-2", "question"] == "Which colour is the floor of hidden-2?"
    other = study.tables.read(PROBE_ITEMS, {"dataset": "chaotic"})
    assert other["question"].tolist() == study.tables.read(ITEMS, {"dataset": "chaotic"})["question"].tolist()


def test_a_second_extraction_computes_nothing_and_a_corrected_item_alone_is_extracted_again(own: Workspace) -> None:
    assert extract_all(own) == 0
    items = own.tables.read(ITEMS, {"dataset": "chaotic"})
    clips = {(r["scenario_id"], r["side"]): (r["clip"], r["media_digest"]) for r in items.to_dict("records")}
    before = own.tables.read(HIDDEN_STATES, StatesCell("chaotic", STANDARD).partition).set_index("item_id")
    names = sorted(set(items["scenario_id"]))
    write_items(own, "chaotic", names, clips, **{names[0]: "Which side does the ball end on?"})
    # control and void of one scenario of chaotic
    assert extract_all(own) == 2
    after = own.tables.read(HIDDEN_STATES, StatesCell("chaotic", STANDARD).partition).set_index("item_id")
    changed = before.index[(before["states_key"] != after["states_key"]).to_numpy()]
    assert sorted(changed) == [f"chaotic:{names[0]}:control", f"chaotic:{names[0]}:void"]


def test_states_stand_in_the_order_of_their_table(study: Workspace) -> None:
    states = StoredStates.of(study, STANDARD)
    ill_posed = states.dataset("chaotic_ill_posed")
    controls = [states.read(d, 3)[(states.dataset(d)["side"] == "control").to_numpy()] for d in DATASETS[2:]]
    assert np.allclose(*controls, atol=1e-5)  # the same clip and question
    assert not np.allclose(states.read("chaotic", 3), states.read("chaotic_ill_posed", 3), atol=1e-3)
    assert len(ill_posed) == 2 * PAIRS and states.n_layers == 5


@pytest.mark.parametrize("lost", ["shard-00000.safetensors", "shard-00000.parquet", "ids.parquet", "a torn index"])
def test_lost_states_are_stale_and_made_again_as_they_were(own: Workspace, lost: str) -> None:
    cell, folder = StatesCell("chaotic", STANDARD), own.root / "states" / "tiny" / "standard" / "chaotic"

    def reasons() -> set[str]:
        return {*Lineage(own).status("hidden_states", cell.key).reasons}

    before, sound = StoredStates.of(own, STANDARD).read("chaotic", 3), reasons()
    if lost == "a torn index":
        (folder / "ids.parquet").write_bytes(b"torn")
        with raises(TrapsError, "storage.parquet._verified_bytes", str(folder / "ids.parquet")):
            StoredStates.of(own, STANDARD).read("chaotic", 3)
    else:
        (folder / lost).unlink()
    assert len(reasons() - sound) == 1
    _, made = stages.extract_states(own, cell)
    assert reasons() == sound and (made == 0 or lost != "a torn index")
    assert (StoredStates.of(own, STANDARD).read("chaotic", 3) == before).all()


@pytest.mark.parametrize("ending", [".safetensors", ".json"])
def test_lost_or_damaged_directions_are_made_again_as_they_were(own: Workspace, ending: str) -> None:
    def reasons() -> set[str]:
        return {*Lineage(own).status("directions", STANDARD.key).reasons}

    before, sound = own.tables.read(DIRECTIONS, STANDARD.partition), reasons()
    file = own.root / "directions" / "tiny" / "standard" / f"chaotic{ending}"
    file.write_bytes(file.read_bytes()[:-9])
    named = str(file.with_suffix(".safetensors")), "`traps run`"
    with raises(TrapsError, "mechanism.directions.load_directions", *named) as damaged:
        stages.saved_directions(own, STANDARD)
    assert reasons() == sound and damaged.value.__cause__ is not None
    file.unlink()
    with raises(TrapsError, "mechanism.directions.load_directions", *named) as missing:
        stages.saved_directions(own, STANDARD)
    assert len(reasons() - sound) == 1 and missing.value.__cause__ is None
    again = pd.DataFrame(stages.direction_rows(own, STANDARD))
    assert set(again["direction_digest"]) == set(before["direction_digest"]) and reasons() == sound


def test_directions_are_what_the_states_say(study: Workspace) -> None:
    table = study.tables.read(DIRECTIONS, STANDARD.partition)
    assert len(table) == 4 * (1 + 2) * 5  # the void direction and two draws of a null, at five layers
    row = table.query("dataset == 'occlusion' and kind == 'void' and layer == 2").iloc[0]
    said = json.loads(study.resolve(row["path"]).with_suffix(".json").read_text())
    states, items = (StoredStates.of(study, STANDARD), StoredStates.of(study, STANDARD).dataset("occlusion"))
    chosen, at = items["scenario_id"].isin(said["scenarios"]).to_numpy(), states.read("occlusion", 2).astype(float)
    void = (items["side"] == "void").to_numpy()
    difference = at[chosen & void].mean(axis=0) - at[chosen & ~void].mean(axis=0)
    saved = stages.saved_directions(study, STANDARD)["occlusion"].void[2]
    assert np.allclose(saved, difference / np.linalg.norm(difference), atol=1e-6)
    assert row["direction_digest"] == vector_digest(saved) and row["n_pairs"] == 3
    assert row["norm"] == pytest.approx(np.linalg.norm(difference), rel=1e-5)
    assert row["residual_norm"] == pytest.approx(np.linalg.norm(at[chosen & ~void], axis=1).mean(), rel=1e-5)
    cosines = pd.DataFrame(cosine_rows(study))
    same = cosines.query("dataset == other_dataset and prompt == other_prompt")
    assert np.allclose(same["cosine"], 1) and len(cosines.query("layer == 2")) == 16
    assert np.allclose(same["disattenuated"].dropna(), 1) and cosines.query("layer == 2")["split_half"].notna().all()


def test_probes_take_confabulated_items_from_the_verdicts(own: Workspace) -> None:
    write_verdicts(own, "occlusion", {f"hidden-{n}": n > 2 for n in range(PAIRS)})
    write_verdicts(own, "chaotic", {f"plinko-{n}": False for n in range(PAIRS)})
    write_verdicts(own, "chaotic_ill_posed", {f"plinko-{n}": True for n in range(PAIRS)})
    rows = pd.DataFrame(stages.probe_rows(own, STANDARD))
    cf = rows.query("analysis == 'confabulated'")
    assert set(cf.query("target == 'occlusion' and source == 'chaotic'")["n_voids"]) == {3}
    notes = cf[cf["value"].isna()].set_index(["source", "target"])["note"]
    assert len(notes) == 10
    none, unasked = notes["chaotic", "chaotic_ill_posed"], notes["chaotic", "occlusion_ill_posed"]
    assert all(name in none for name in ("tiny", str(PAIRS), "chaotic_ill_posed", "standard"))
    assert "occlusion_ill_posed|tiny__standard__run1" in unasked and "|" not in none


def test_probes_of_another_prompt_are_fitted_where_they_are_asked_for(own: Workspace, entry: ModelEntry) -> None:
    """Under the guided prompt there are states of the four datasets alone, so that nothing scores look-alikes."""
    asked = Asked(datasets=DATASETS, models=("tiny",), regimes=("standard",), runs=(1,), mechanism=True)
    own = own.allow(experiments={"inside": asked}, scenarios=["plinko-0001", "drop_split-0001"])
    for prompts in (("standard",), ("standard", "guided")):
        probes = own.mechanism.probes.model_copy(update={"prompts": prompts})
        own = own.allow(mechanism=own.mechanism.model_copy(update={"probes": probes}))
        for name, of in (("probes", (*prompts, *RANDOM_WEIGHTS)), ("probe_baselines", prompts[:1])):
            expected = [f"tiny__{prompt}" for prompt in of]
            assert the_graph()[name].wanted(StudyPartitions(own)) == expected
    guided = Extraction("tiny", "guided")
    for dataset in DATASETS:
        cell = StatesCell(dataset, guided)
        own.tables.write(HIDDEN_STATES, cell.partition, stages.extract_states(own, cell)[0], {})
    of = {each.prompt: pd.DataFrame(stages.probe_rows(own, each)) for each in (STANDARD, guided)}
    found, here = ({*of[prompt]["analysis"]} for prompt in ("standard", "guided"))
    assert found - here == {"answerable_void", "answerable_control"} and here < found
    assert {*of["guided"]["prompt"]} == {"guided"}
    both = of["guided"].merge(of["standard"], on=["analysis", "source", "target", "layer", "scope"])
    assert not np.allclose(both["value_x"].astype(float), both["value_y"].astype(float), equal_nan=True)


def test_a_model_that_is_not_local_or_not_asked_for_is_told(study: Workspace, entry: ModelEntry) -> None:
    with raises(TrapsError, "mechanism.stages.examined_model", "oracle", "reference"):
        stages.examined_model(study, "oracle")
    with raises(TrapsError, "mechanism.stages.examined_model", "mechanism.models", "qwen3-vl-8b"):
        stages.examined_model(study, "qwen3-vl-8b")
    with raises(TrapsError, "storage.workspace.Workspace.mechanism", str(study.root / "study.yaml"), "`mechanism:`"):
        _ = study.allow(mechanism=None).mechanism
    study.save_study()


def test_a_layer_that_the_model_has_not_is_told_before_anything_is_extracted(own: Workspace) -> None:
    layers = {"tiny": {"steering": 9, "centroid": 1}}
    wrong = own.allow(mechanism=MechanismSettings.model_validate({"models": layers}))
    with raises(TrapsError, "mechanism.stages._check_layers", "mechanism.models.tiny.steering", "9", "4"):
        stages.extract_states(wrong, StatesCell("chaotic", Extraction("tiny", "guided")))
    assert not (own.root / "states" / "tiny" / "guided").exists()


# --- steering ---------------------------------------------------------------------------------------------------------


def written(
    workspace: Workspace, table: Table, done: Iterable[tuple[SteeringCell, StageOutput]]
) -> list[tuple[SteeringCell, StageOutput]]:
    """Write each cell as it is done."""
    kept = []
    for cell, made in done:
        workspace.tables.write(table, cell.partition, made.rows(table), {}, failed=made.tally.errors)
        kept.append((cell, made))
    return kept


@pytest.fixture(scope="module")
def steered(study: Workspace, entry: ModelEntry) -> Workspace:
    """All four targets, steered and judged."""
    cells = [SteeringCell.make(dataset, "tiny", "standard", "guided") for dataset in DATASETS]
    along = {"standard": stages.saved_directions(study, STANDARD)}
    done = written(study, STEERING, collect_steered(study, entry, cells, along))
    # Of the two scenarios a well-posed direction comes from one, so its own taxonomy has one. chaotic: 3 doses on both
    # sides of 1 + 2 + 2 + 2 scenarios; + on both sides 3 x 2, of which the controls are asked already; 2 nulls x 2 rows
    # at each dose; the sweep's 2 controls; 4 rows as they are
    rows = {cell.dataset: (len(made.rows(STEERING)), made.tally.asked) for cell, made in done}
    assert rows["chaotic"] == rows["occlusion"] == (66, 63)
    # ill-posed: 3 sources, whose controls the well-posed cell has asked: its voids are new, its nulls, and its sweep
    assert rows["chaotic_ill_posed"] == rows["occlusion_ill_posed"] == (74, 3 * 5 + 3 * 2 + 3 * 2 * 4 + 2 * 2 + 2)
    planned = count_answers(study.mechanism, "tiny", DATASETS, {"occlusion": PAIRS, "chaotic": PAIRS})
    assert planned["guided"].total() == sum(asked for _, asked in rows.values()) and set(planned) == {"guided"}
    votes = written(study, STEERING_VOTES, collect_steering_votes(study, cells))
    judged = [[row for row in made.rows(STEERING) if row.outcome in WITH_TEXT] for _, made in done]
    tasks = [
        sum(len(tasks_for(row.side)) for row in rows) for rows in judged
    ]  # controls are judged for correctness too
    assert [len(made.rows(STEERING_VOTES)) for _, made in votes] == [3 * n for n in tasks]
    return study


def test_no_answer_is_steered_along_a_direction_that_comes_from_its_scenario(steered: Workspace) -> None:
    answers = steered.tables.read_all(STEERING).query(f"kind != '{UNSTEERED}'")
    of = stages.saved_directions(steered, STANDARD)
    assert of["chaotic"].scenarios & {*steered.tables.read_all(STEERING)["scenario_id"]}
    assert not [1 for row in answers.to_dict("records") if row["scenario_id"] in of[row["source"]].scenarios]


def test_a_steered_answer_is_the_models_own_under_the_hook(steered: Workspace, entry: ModelEntry) -> None:
    from traps_pipeline.models.local.adapter import load_local_model
    from traps_pipeline.models.registry.prompts import system_prompt
    from traps_pipeline.storage.media import pick_frames

    model, items = load_local_model(entry), steered.tables.read(ITEMS, {"dataset": "chaotic"}).set_index("item_id")
    answers = steered.tables.read_all(STEERING, dataset="chaotic")
    vector = stages.saved_directions(steered, STANDARD)["occlusion"].void[2]
    assert entry.media is not None
    for side, sign in (("control", 1), ("void", -1)):
        row = answers.query(f"source == 'occlusion' and kind == 'void' and alpha == 8 and side == '{side}'").iloc[0]
        item = items.loc[row["item_id"]]
        shown = pick_frames(steered.resolve(item["clip"]), entry.media)
        prompt = model.prompt(system_prompt("guided"), item["question"], shown.frames, shown.times_s.tolist())
        said = model.generate([prompt], 4, None, Steering(vector, 2, (sign * 8.0,)))[0].text.strip()
        assert (row["text"] or "") == said
    assert row["alpha_relative"] == pytest.approx(
        8 / stages.saved_directions(steered, STANDARD)["occlusion"].residual_norms[2]
    )


def test_the_panel_judges_every_answer_with_a_text(steered: Workspace) -> None:
    answers, votes = steered.tables.read_all(STEERING), steered.tables.read_all(STEERING_VOTES)
    keys = ["dataset", "source", "kind", "draw", "layer", "unit", "dose", "signs", "item_id"]
    texts = answers.loc[answers["outcome"].isin(WITH_TEXT), keys]
    correctness = votes.query("task == 'correctness'")
    assert set(correctness["side"]) == {"control"} and set(correctness["invalid_reason"]) == {"unread"}
    votes = votes.query("task == 'abstention'")
    of_answer = votes.groupby(keys)
    assert set(of_answer.groups) == set(texts.itertuples(index=False, name=None)) != set()
    assert set(of_answer["judge"].nunique()) == set(of_answer.size()) == {3}
    assert set(votes["invalid_reason"]) == {"unread"} and votes["abstained"].isna().all()  # texts of a random model
    ledger = steered.votes.read("tiny__guided__steered").rows
    assert {*votes["vote_key"], *correctness["vote_key"]} == set(ledger)


def effects_of_wrong_answers(steered: Workspace) -> pd.DataFrame:
    """Return the effects as if the judges had read a wrong answer in every text: those of a random model are unread."""
    votes = steered.tables.read_all(STEERING_VOTES).assign(valid=True)
    for name, task in (("abstained", "abstention"), ("correct", "correctness")):
        votes.loc[votes["task"] == task, name] = False
    return pd.DataFrame(effect_rows(steered.tables.read_all(STEERING), votes))


def test_effects_put_the_model_as_it_is_into_every_path(steered: Workspace) -> None:
    effects = effects_of_wrong_answers(steered)
    main = paper_protocol_rows(effects).query("layer == 2")
    assert len(main.groupby(["source", "target"])) == 14
    answers = main["n"] + main["n_missing"]  # at alpha 0 as many: the path's own scenarios, not all
    own = main["source"].isin(["occlusion", "chaotic"]) & (
        main["source"].map(taxonomy_of) == main["target"].map(taxonomy_of)
    )
    assert set(main["alpha"]) == {0, 2, 8} and (answers == np.where(own, 1, 2)).all()
    plain = main.query("alpha == 0 and target == 'chaotic'")
    assert plain.groupby("side")["abstained"].nunique().max() == 1
    assert set(effects.query("layer == 1")["side"]) == {"control"}  # the sweep
    assert (effects["low"].dropna() <= effects["abstention"].dropna()).all()


def test_nulls_and_policies_stand_beside_every_own_direction(steered: Workspace) -> None:
    effects = effects_of_wrong_answers(steered)
    nulls, pecs = pd.DataFrame(null_rows(effects)), pd.DataFrame(pecs_rows(effects))
    assert set(nulls["target"]) == {*DATASETS, "all"} and set(nulls["null"]) == {"covariance"}
    doses = {*zip(nulls["unit"], nulls["dose"], strict=True)}
    assert set(nulls["draws"]) == {2} and doses == {("alpha", 2.0), ("alpha", 8.0), ("gap", 0.5)}
    gaps = {name: of.gaps[2] for name, of in stages.saved_directions(steered, STANDARD).items()}
    doses = effects.query("unit == 'gap' and dose == 0.5 and layer == 2")
    assert np.allclose(doses["alpha"], 0.5 * doses["source"].map(gaps).astype(float))
    assert set(pecs.query("signs == 'plus'")["source"]) == set(DATASETS)
    label, plus = (pecs.query(f"signs == '{s}' and source == target").reset_index(drop=True) for s in ("label", "plus"))
    assert (label["acc"].dropna() == plus["acc"].dropna()).all()  # controls are the same under both policies


def test_a_study_may_show_other_frames_where_it_looks_inside_than_where_it_asks(own: Workspace) -> None:
    settings, shown = own.mechanism, MediaSpec(profile="frames", uniform=4)
    models = {"tiny": settings.models["tiny"].model_copy(update={"media": shown})}
    other = own.allow(mechanism=settings.model_copy(update={"models": models}))
    assert stages.examined_model(other, "tiny").media == shown != stages.examined_model(own, "tiny").media
    for version, key in ((extraction_version, STANDARD), (steering_version, "tiny__standard__guided")):
        assert version(other, key) != version(own, key)  # pyright: ignore[reportArgumentType]


def test_steering_refuses_layers_and_sources_that_are_not_there(study: Workspace) -> None:
    directions, settings = stages.saved_directions(study, STANDARD), study.mechanism
    wrong = settings.models["tiny"].model_copy(update={"steering": 5})
    with raises(TrapsError, "mechanism.steering._in_range", "mechanism.models", "5", "4"):
        strengths("chaotic", wrong, settings, directions)
    with raises(TrapsError, "mechanism.steering.strengths", "chaotic", "hidden_states"):
        strengths("chaotic", settings.models["tiny"], settings, {})
    only = {"chaotic": directions["chaotic"]}  # a study of one dataset steers the paths that it has
    assert {s.source for s, _ in strengths("chaotic", settings.models["tiny"], settings, only)} == {"chaotic", "none"}


def test_settings_that_cannot_be_are_refused() -> None:
    layers = {"tiny": {"steering": 2, "centroid": 1}}
    of_prompts = {"models": layers, "prompts": ["standard"]}
    for wrong, *named in (
        ({"models": {}}, "models", "too_short"),
        ({"models": layers, "probes": {"shuffles": 5}}, "probes.shuffles", "greater_than_equal"),
        (of_prompts | {"steering": {"direction_regimes": ["guided"]}}, "steering.direction_regimes", "['guided']"),
        (of_prompts | {"steering": None, "probes": {"prompts": ["guided"]}}, "probes.prompts", "['guided']"),
        ({"models": layers, "steering": {"alphas": [5, 2]}}, "steering.alphas", "(5.0, 2.0)"),
        ({"models": {"a__b": layers["tiny"]}}, "models", "'a__b'", "value_error"),
    ):
        with raises(ValidationError, "MechanismSettings", *named):
            MechanismSettings.model_validate(wrong)


def test_a_row_of_states_and_answers_names_the_two_models_that_it_joins(own: Workspace, entry: ModelEntry) -> None:
    """One precision and the same frames are one model; other frames, or NF4 inside, are two."""
    assert joined_models(entry, own.mechanism) is None
    packed = entry.model_copy(update={"mechanism": MechanismSpec(quantisation="nf4")})
    assert joined_models(packed, own.mechanism) == "states: nf4, 2 frames; answers: float32, 2 frames"
    layers = own.mechanism.models["tiny"].model_copy(update={"media": MediaSpec(profile="frames", fps=4)})
    shown = own.mechanism.model_copy(update={"models": {"tiny": layers}})
    assert joined_models(entry, shown) == "states: float32, 4 frames a second; answers: float32, 2 frames"
