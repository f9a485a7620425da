"""What a probe or a gate does to items that look like voids and have an answer (clips as short as a void),
what a gate does on states that no training made, and states under the benchmark's own prompts: through the stages, on a
tiny random checkpoint."""

from __future__ import annotations

import shutil
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from tests.build.errors import raises
from tests.build.mechanism import STANDARD, entry, extract_all, patch
from tests.mechanism.study import CATEGORY, PAIRS, filled, make_study, register
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.judging.judging_rows import VERDICTS
from traps_pipeline.mechanism import stages
from traps_pipeline.mechanism.baselines import MARGIN, output_features
from traps_pipeline.mechanism.control_rows import MODEL, RESIDUAL, STATES, GateRow
from traps_pipeline.mechanism.gate import OTHER_DATASETS, THRESHOLDS, gate_answers
from traps_pipeline.mechanism.gating import gate_items, gate_rows, gate_table, read_states
from traps_pipeline.mechanism.item_scores import item_score_rows
from traps_pipeline.mechanism.leads import lead_rows, nuisance_components, placed, residual
from traps_pipeline.mechanism.lens import lens_rows
from traps_pipeline.mechanism.margin import is_abstention_start
from traps_pipeline.mechanism.mechanism_rows import PROBE_ITEMS, PROBES
from traps_pipeline.mechanism.probes import auroc
from traps_pipeline.mechanism.probing import ProbeRun
from traps_pipeline.mechanism.sentences import mean_log_probabilities, sentence_rows
from traps_pipeline.mechanism.stored_states import StoredStates
from traps_pipeline.mechanism.transfer_paths import LOOK_ALIKES
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.models.local.adapter import load_local_model
from traps_pipeline.models.local.capture import first_tensor
from traps_pipeline.models.local.library import load_transformers
from traps_pipeline.models.registry.entries import ModelEntry
from traps_pipeline.models.registry.local_settings import MechanismSpec
from traps_pipeline.models.registry.prompts import system_prompt, vqa_prompt
from traps_pipeline.protocol.cells import Cell, Evaluation, Extraction
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.protocol.regimes import RANDOM_WEIGHTS
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.media import pick_frames
from traps_pipeline.storage.study import ProbeSettings
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow
__all__ = ["entry", "patch"]  # fixtures
ARMS = ("length_matched",)
EVERY = (*DATASETS, *ARMS)
RANDOM = [Extraction("tiny", name) for name in RANDOM_WEIGHTS]


@pytest.fixture(scope="module")
def study(entry: ModelEntry, patch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """Extracted, probed and judged; a void's clip stands for both panels, a control's for the short clip."""
    workspace = make_study(tmp_path_factory.mktemp("study"))
    for arm, shown in zip(ARMS, ("control",), strict=True):
        rows = []
        for row in workspace.tables.read(ITEMS, {"dataset": LOOK_ALIKES[arm]}).to_dict("records"):
            if row["side"] == shown:
                name = f"{arm}:{row['scenario_id']}"
                made: dict[str, Any] = {str(key): value for key, value in row.items()}
                made |= {"item_id": f"{name}:control", "pair_id": name, "dataset": arm, "side": "control"}
                made |= {"question": f"Where does {row['scenario_id']} end?", "ground_truth": "left"}
                rows.append(ITEMS.row_type(**made))
        workspace.tables.write(ITEMS, {"dataset": arm}, rows, {})
    for extraction in (STANDARD, *RANDOM):
        extract_all(workspace, EVERY, extraction)
        workspace.tables.write(PROBES, extraction.partition, stages.probe_rows(workspace, extraction), {})
    for dataset in EVERY:
        partition = {"dataset": dataset, "model": "tiny", "regime": "standard", "run": 1}
        items = workspace.tables.read(ITEMS, {"dataset": dataset}).to_dict("records")
        judged = [
            filled(
                VERDICTS, **partition, **{name: row[name] for name in ("item_id", "pair_id", "scenario_id", "side")},
                abstained=row["side"] == "void" and number % 4 == 1, correct=row["side"] == "control" or None,
            )
            for number, row in enumerate(items)
        ]  # fmt: skip
        workspace.tables.write(VERDICTS, partition, judged, {})
    workspace.tables.write(PROBES, STANDARD.partition, stages.probe_rows(workspace, STANDARD), {})
    return workspace


@pytest.fixture(scope="module")
def gates(study: Workspace, entry: ModelEntry) -> list[GateRow]:
    return gate_rows(study, entry, StoredStates.of(study, STANDARD))


# --- look-alikes as targets -------------------------------------------------------------------------------------------


def test_short_clips_are_probe_items_and_targets_of_every_probe(study: Workspace) -> None:
    for arm in ARMS:
        items = study.tables.read(PROBE_ITEMS, {"dataset": arm})
        assert items["item_id"].tolist() == [f"{arm}:{CATEGORY[LOOK_ALIKES[arm]]}-{n}:control" for n in range(PAIRS)]
    rows = pd.DataFrame(study.tables.read(PROBES, STANDARD.partition))
    layers = StoredStates.of(study, STANDARD).n_layers
    for arm in ARMS:
        for analysis in ("answerable_void", "answerable_control"):
            found = rows[(rows["analysis"] == analysis) & (rows["target"] == arm)]
            assert set(zip(found["source"], found["layer"], strict=True)) == {
                (source, layer) for source in DATASETS for layer in range(layers)
            }
            assert {*found["n_voids"]} == {*found["n_controls"]} == {PAIRS}


@pytest.mark.parametrize("arm", ARMS)
def test_a_probe_that_reads_what_look_alikes_share_with_voids_is_told_from_one_that_reads_what_they_do_not(
    arm: str,
) -> None:
    """Layer 0 holds what voids and look-alikes have (the length), layer 1 what voids alone have."""
    rng, rows, states = np.random.default_rng(0), [], dict[tuple[str, int], np.ndarray]()
    for dataset in (*DATASETS, arm):
        taxonomy = LOOK_ALIKES.get(dataset, dataset.split("_")[0])
        sides = ("control",) if dataset == arm else ("control", "void")
        of = [(dataset, f"{taxonomy}-{n:02d}", side, "sub") for n in range(60) for side in sides]
        rows += of
        void = np.array([side == "void" for *_, side, _ in of])
        for layer, shown in ((0, void | (dataset == arm)), (1, void)):
            states[dataset, layer] = rng.normal(size=(len(of), 3))
            states[dataset, layer][:, 0] = 8.0 * shown + rng.normal(size=len(of))
    items = pd.DataFrame(rows, columns=["dataset", "scenario_id", "side", "sub_scenario"])
    run = ProbeRun(items, lambda d, n: states[d, n], 2, 1, ProbeSettings(folds=4, resamples=100), 7)
    source = LOOK_ALIKES[arm]
    for layer, against_voids, against_controls in ((0, 0.5, 1.0), (1, 1.0, 0.5)):
        value = {
            row["analysis"]: row["value"]
            for row in run.comparable_rows(layer)
            if (row["source"], row["target"]) == (source, arm)
        }
        assert value["answerable_void"] == pytest.approx(against_voids, abs=0.2)
        assert value["answerable_control"] == pytest.approx(against_controls, abs=0.2)


def test_a_gate_reports_how_many_look_alikes_it_abstains_on(gates: list[GateRow]) -> None:
    for arm in ARMS:
        rows = [row for row in gates if row.target == arm and row.features == "states"]
        assert {row.threshold for row in rows} == {*THRESHOLDS} and OTHER_DATASETS in {row.source for row in rows}
        for row in rows:
            assert (row.n_controls, row.n_voids) == (PAIRS, 0)
            assert row.false_abs in {k / PAIRS for k in range(PAIRS + 1)} and row.pecs is None


# --- a network that has learnt nothing --------------------------------------------------------------------------------


def test_states_of_random_weights_are_those_of_a_fresh_network_of_the_class_and_differ_by_seed(
    study: Workspace, entry: ModelEntry
) -> None:
    stream, trained = torch.get_rng_state(), load_local_model(entry, inside=True)
    states = [StoredStates.of(study, extraction) for extraction in (STANDARD, *RANDOM)]
    read = [of.read("chaotic", trained.n_layers) for of in states]
    for one, other in ((0, 2), (1, 2)):  # the tiny checkpoint is itself a fresh network, of seed 0
        assert np.abs(read[one] - read[other]).max(axis=1).min() > 1e-2  # of every item
    assert len({of.items["checkpoint_digest"].iloc[0] for of in states}) == 3
    items = study.tables.read(PROBE_ITEMS, {"dataset": "chaotic"}).to_dict("records")
    for seed, found in enumerate(read[1:]):
        with torch.random.fork_rng(devices=[]):  # once more, in plain transformers
            torch.manual_seed(seed)
            network = load_transformers().AutoModelForImageTextToText.from_config(trained.network.config).eval()
        captured = list[torch.Tensor]()
        network.get_decoder().layers[-1].register_forward_hook(lambda _, __, out, to=captured: to.append(out))
        for row, expected in zip(items, found, strict=True):
            prompt = own_prompt(study, entry, {str(k): v for k, v in row.items()}, vqa_prompt("standard"))
            with torch.no_grad():
                network(**prompt)
            assert np.array_equal(first_tensor(captured[-1])[0, -1].numpy(), expected)
    assert torch.equal(stream, torch.get_rng_state())


def test_gates_of_random_weights_stand_beside_the_trained_ones_but_where_the_entry_says_not(
    study: Workspace, entry: ModelEntry, gates: list[GateRow]
) -> None:
    rows = [row for row in gates if row.features in RANDOM_WEIGHTS]
    assert {(row.features, row.source, row.regime) for row in rows} == {
        (name, OTHER_DATASETS, "standard") for name in RANDOM_WEIGHTS
    }
    assert all(row.pecs is not None and row.auroc is not None for row in rows if row.target in DATASETS)
    without = entry.model_copy(update={"mechanism": MechanismSpec(random_weights=False)})
    with pytest.MonkeyPatch.context() as patch:
        register(patch, without)
        states = StoredStates.of(study, STANDARD)
        assert not {*RANDOM_WEIGHTS} & {row.features for row in gate_rows(study, without, states)}
        assert {row.subject for row in lead_rows(study, without, states)} == {MODEL, *ARMS}


# --- states among their rivals ----------------------------------------------------------------------------------------


def test_every_subject_has_states_and_rivals_by_probes_that_saw_neither_dataset_nor_scenario(
    study: Workspace, entry: ModelEntry
) -> None:
    rows = pd.DataFrame(lead_rows(study, entry, StoredStates.of(study, STANDARD)))
    subjects = {
        (MODEL, *DATASETS),
        *((name, *DATASETS) for name in RANDOM_WEIGHTS),
        *((a, LOOK_ALIKES[a]) for a in ARMS),
    }
    assert {(str(s), *part["target"].unique()) for s, part in rows.groupby("subject", sort=False)} == subjects
    states = rows.loc[rows["features"] == STATES]
    best = rows.loc[~rows["features"].isin([STATES, RESIDUAL])].groupby(["subject", "target"])["auroc"].max()
    leads = states.set_index(["subject", "target"])
    assert np.allclose(leads["auroc"] - best.reindex(leads.index), leads["lead"])
    assert (leads["lead_low"] <= leads["lead_high"]).all() and rows["auroc"].between(0, 1).all()
    (own,) = states.loc[(states["subject"] == MODEL) & (states["target"] == "chaotic")].to_dict("records")
    table, layer = gate_table(StoredStates.of(study, STANDARD)), int(own["layer"])
    features = read_states(StoredStates.of(study, STANDARD), EVERY, layer)
    items, folds = gate_items(table, features, shuffled=False, seed=0), study.mechanism.probes.folds
    decisions = gate_answers(items, OTHER_DATASETS, "chaotic", folds=folds, seed=study.mechanism.seed, false_abs=0.05)
    void = table.loc[table["dataset"] == "chaotic", "void"].to_numpy(bool)
    assert own["auroc"] == pytest.approx(float(auroc(void, decisions.score)))


def test_a_placebo_takes_the_place_of_a_datasets_voids_and_of_nothing_else() -> None:
    rows = [("occlusion", True, "a"), ("occlusion", False, "b"), ("chaotic", True, "c"), ("removed", False, "d")]
    table = pd.DataFrame(rows, columns=["dataset", "void", "item_id"])
    mask, placed_table = placed(table, "occlusion", "removed")
    assert mask.tolist() == [False, True, True, True]
    assert placed_table.to_records(index=False).tolist() == [
        ("occlusion", False, "b"), ("chaotic", True, "c"), ("occlusion", True, "d"),
    ]  # fmt: skip
    mask, same = placed(table, "occlusion", None)
    assert mask.tolist() == [True, True, True, False] and same["item_id"].tolist() == ["a", "b", "c"]


def test_residual_states_hold_nothing_linear_in_the_nuisances() -> None:
    rng = np.random.default_rng(0)
    length, noise = rng.normal(size=(80, 1)), rng.normal(size=(80, 3))
    states = np.hstack([5 * length + 2, noise, length - noise[:, :1]])
    components = nuisance_components([length, np.zeros((80, 2))])
    left = residual(states, components)
    assert components.shape == (80, 1) and np.abs(left[:, 0]).max() < 1e-9
    assert np.abs(length[:, 0] @ left).max() < 1e-9 and np.abs(left.mean(axis=0)).max() < 1e-9


def own_prompt(workspace: Workspace, entry: ModelEntry, row: dict, system: str) -> dict[str, torch.Tensor]:
    assert entry.media is not None
    shown = pick_frames(workspace.resolve(row["clip"]), entry.media)
    model = load_local_model(entry, inside=True)
    return dict(model.prompt(system, row["question"], shown.frames, shown.times_s).inputs)


# --- the benchmark's own prompts --------------------------------------------------------------------------------------


def test_states_under_the_benchmarks_own_prompt_have_other_keys_and_are_the_librarys(
    study: Workspace, entry: ModelEntry, tmp_path: Path
) -> None:
    shutil.copytree(study.root, tmp_path / "study", symlinks=True)
    own = Workspace.open(tmp_path / "study")
    own = own.allow(mechanism=own.mechanism.model_copy(update={"system": "benchmark"}))
    before = StoredStates.of(study, STANDARD).dataset("chaotic")
    extract_all(own, ["chaotic"])
    states = StoredStates.of(own, STANDARD)
    assert states.dataset("chaotic")["item_id"].tolist() == before["item_id"].tolist()
    assert not {*states.dataset("chaotic")["states_key"]} & {*before["states_key"]}
    model = load_local_model(entry, inside=True)
    items = own.tables.read(PROBE_ITEMS, {"dataset": "chaotic"}).set_index("item_id")
    for place, name in enumerate(states.dataset("chaotic")["item_id"]):
        row = {str(key): value for key, value in items.loc[name].to_dict().items()}
        with torch.no_grad():
            inputs = own_prompt(own, entry, row, system_prompt("standard"))
            library = model.network(**inputs, output_hidden_states=True).hidden_states
        for layer in range(model.n_layers):  # the library's last one is normed
            assert np.array_equal(states.read("chaotic", layer)[place], library[layer][0, -1].numpy())
        assert np.array_equal(states.read("chaotic", "normed")[place], library[-1][0, -1].numpy())


# --- states and output, item by item and layer by layer ---------------------------------------------------------------


def test_every_item_has_a_score_of_states_a_margin_and_its_verdict(study: Workspace, entry: ModelEntry) -> None:
    states = StoredStates.of(study, STANDARD)
    rows = pd.DataFrame(item_score_rows(study, entry, states))
    assert {*rows["item_id"]} == {*states.items.loc[states.items["dataset"].isin(DATASETS), "item_id"]}
    verdicts = study.tables.read_all(VERDICTS).set_index("item_id")["abstained"]
    assert (rows.set_index("item_id")["abstained_standard"] == verdicts.loc[rows["item_id"]]).all()
    assert rows["abstained_guided"].isna().all()  # not asked
    for dataset, of in rows.groupby("dataset"):
        margins = output_features(entry, states, states, [str(dataset)])[MARGIN][str(dataset)][:, 0]
        assert of["margin"].to_numpy(float) == pytest.approx(margins)
        (layer,) = {*of["layer"]}
        table, features = gate_table(states), read_states(states, EVERY, layer)
        others = gate_answers(gate_items(table, features, shuffled=False, seed=0), "other datasets", str(dataset),
                        folds=study.mechanism.probes.folds, seed=study.mechanism.seed, false_abs=0.05)  # fmt: skip
        assert of["others"].to_numpy(float) == pytest.approx(others.score - others.threshold["mid"])


def test_the_lens_is_the_models_norm_and_head_on_each_layer_and_ends_at_the_output_margin(
    study: Workspace, entry: ModelEntry
) -> None:
    states, model = StoredStates.of(study, STANDARD), load_local_model(entry, inside=True)
    rows = pd.DataFrame(lens_rows(study, entry, states)).set_index(["dataset", "layer"])
    assert len(rows) == len(DATASETS) * states.n_layers
    void = (states.dataset("chaotic")["side"] == "void").to_numpy()
    margins = output_features(entry, states, states, ["chaotic"])[MARGIN]["chaotic"][:, 0]
    last = rows.loc[("chaotic", model.n_layers)]
    assert (last["voids"], last["controls"]) == pytest.approx((margins[void].mean(), margins[~void].mean()), abs=1e-4)
    with torch.no_grad():
        raw = torch.from_numpy(states.read("chaotic", 2))
        logits = model.network.lm_head(model.network.model.language_model.norm(raw))
        logits[:, model.network.generation_config.suppress_tokens] = -torch.inf  # pictures' tokens are never answers
        chance = logits.softmax(-1)
    begins = [t for t in range(chance.shape[1]) if is_abstention_start(model.processor.tokenizer.decode([t]))]
    told = chance[:, begins].sum(1)
    odds = torch.log(told / (1 - told)).numpy()
    assert rows.loc[("chaotic", 2), "voids"] == pytest.approx(odds[void].mean(), abs=1e-3)


def test_an_item_has_the_likelihood_of_its_answer_and_of_the_likeliest_abstention(
    study: Workspace, entry: ModelEntry
) -> None:
    """`test_sentences.py` holds likelihoods against the library's own."""
    item = study.tables.read(PROBE_ITEMS, {"dataset": "chaotic"}).iloc[0]
    partition = Cell("chaotic", Evaluation("tiny", "standard", 1)).partition
    texts = {item["item_id"]: "It ends left.", "chaotic:plinko-1:void": None}
    answers = [
        filled(RESPONSES, item_id=name, text=text, created_at=datetime.now(UTC), **partition)
        for name, text in texts.items()
    ]
    study.tables.write(RESPONSES, partition, answers, {})
    rows = {row.item_id: row for row in sentence_rows(study, entry, STANDARD)}
    row, model = rows[item["item_id"]], load_local_model(entry, inside=True)
    assert entry.media is not None
    shown = pick_frames(study.resolve(item["clip"]), entry.media)
    prompt = model.prompt(system_prompt("standard"), item["question"], shown.frames, shown.times_s)
    said = [*study.mechanism.sentences, "It ends left."]
    tokens = [model.processor.tokenizer(text, add_special_tokens=False).input_ids for text in said]
    *abstentions, own = mean_log_probabilities(model, prompt, tokens)
    assert row.own == pytest.approx(own, abs=1e-5) and row.own_tokens == 13
    assert row.abstention == pytest.approx(max(abstentions), abs=1e-5)
    assert row.sentence == said[int(np.argmax(abstentions))]
    assert rows["chaotic:plinko-1:void"].own is None and len(rows) == 2 * PAIRS
    with raises(TrapsError, "mechanism.sentences.sentence_rows", "guided"):
        sentence_rows(study, entry, Extraction("tiny", "guided"))
