"""The researcher's API, and its page in docs, which runs as it is written."""

from __future__ import annotations

import ast
import doctest
import inspect
import io
import json
import re
from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from tests.build.errors import raises
from tests.build.mechanism import STANDARD, entry, extract_all, patch
from tests.build.mechanism import study as extracted
from tests.mechanism.study import PAIRS, write_verdicts
from tools.inside_notebook import NOTEBOOK, execute
from traps_pipeline import inside
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism import stages
from traps_pipeline.mechanism.baselines import RAW
from traps_pipeline.mechanism.gate import SOURCES, THRESHOLDS, gate_answers
from traps_pipeline.mechanism.gating import gate_items, gate_rows, gate_table
from traps_pipeline.mechanism.hook import Steering
from traps_pipeline.mechanism.layer_choice import pair_curves
from traps_pipeline.mechanism.mechanism_rows import PROBE_ITEMS, PROBES
from traps_pipeline.mechanism.notebook import ABSTENTION
from traps_pipeline.mechanism.probes import scenario_folds
from traps_pipeline.mechanism.stored_states import StoredStates
from traps_pipeline.models.local.adapter import load_local_model
from traps_pipeline.models.registry.entries import ModelEntry
from traps_pipeline.models.registry.prompts import system_prompt, vqa_prompt
from traps_pipeline.protocol.cells import Extraction
from traps_pipeline.storage.media import pick_frames
from traps_pipeline.storage.workspace import Workspace

__all__ = ["entry", "extracted", "patch"]  # fixtures

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def study(extracted: Workspace) -> Workspace:
    """Extracted, with directions and probes, and judged on one dataset."""
    write_verdicts(extracted, "chaotic", {f"plinko-{n}": n < 2 for n in range(PAIRS)})
    extracted.tables.write(PROBES, STANDARD.partition, stages.probe_rows(extracted, STANDARD), {})
    extract_all(extracted, ["occlusion"], Extraction("tiny", "guided"))
    return extracted


def test_the_notebook_runs_as_it_is_written(study: Workspace) -> None:
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    blocks = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    code = "\n".join(blocks).replace('".workspaces/mechanism"', repr(str(study.root))).replace('"pocket"', '"tiny"')
    assert len(blocks) >= 8
    execute([{"cell_type": "code", "source": [code]}])


def test_states_stand_beside_their_items_and_verdicts(study: Workspace) -> None:
    states = inside.load(study.root, "tiny", layer=2, datasets=["chaotic", "occlusion"])
    own = StoredStates.of(study, STANDARD)
    assert (states.X[: 2 * PAIRS] == own.read("chaotic", 2)).all() and len(states.X) == 4 * PAIRS
    judged = states.where("dataset == 'chaotic' and void").items.set_index("scenario_id")["abstained_standard"]
    assert judged.astype(bool).to_dict() == {f"plinko-{n}": n < 2 for n in range(PAIRS)}
    assert states.where(states.void).items["side"].unique().tolist() == ["void"]
    with raises(TrapsError, "mechanism.notebook.check_name", "twin_control"):
        inside.load(study.root, "tiny", layer=2, datasets=["twin_control"])


def test_a_direction_of_the_api_steers_as_the_stages_do(study: Workspace, entry: ModelEntry) -> None:
    model = load_local_model(entry)
    push = inside.direction(study, "tiny", "chaotic", layer=2)
    prompt = model.prompt("Look.", "Which?", np.full((2, 32, 32, 3), 90, np.uint8), [0.0, 1.0])
    theirs = model.generate([prompt], 4, None, Steering(push.vector, 2, (3.0,)))[0]
    with push.apply(model.network, 3.0):
        ours = model.generate([prompt], 4)[0]
    along, block = torch.from_numpy(push.vector), model.network.get_decoder().layers[1]
    plain = block.register_forward_hook(lambda module, args, output: output + 3.0 * along)  # of this class a tensor
    own = model.network.generate(**prompt.inputs, max_new_tokens=4, do_sample=False)[0, prompt.n_tokens :].tolist()
    plain.remove()
    assert ours.tokens == theirs.tokens and [*ours.tokens] == own[: len(ours.tokens)]
    before = model.forward_states(prompt).raw
    with push.apply(model, 1.0, change=lambda states, unit, dose: states - dose * (states @ unit)[..., None] * unit):
        without = model.forward_states(prompt).raw
    assert abs(without[2] @ push.vector) < 1e-4 < abs(before[2] @ push.vector)
    plain = block.self_attn.register_forward_hook(lambda module, args, output: (output[0] + 5.0 * along, *output[1:]))
    expected = model.forward_states(prompt).raw
    plain.remove()
    with push.apply(model, 5.0, site="attention"):
        changed = model.forward_states(prompt).raw  # along the unit vector, whose length is 1 but for rounding
    assert changed == pytest.approx(expected, abs=1e-4) and np.abs(expected[2] - before[2]).max() > 1e-2
    assert (model.forward_states(prompt).raw == before).all()  # every hook is gone
    with raises(TrapsError, "inside.Direction.apply", "amount", "gaps"), push.apply(model, 1.0, gaps=1.0):
        pass
    with raises(TrapsError, "inside._block", "9"), inside.Direction(push.vector, 9).apply(model, 1.0):
        pass


def test_a_gate_is_made_from_states_and_verdicts_that_exist(study: Workspace, entry: ModelEntry) -> None:
    states = StoredStates.of(study, STANDARD)
    rows = pd.DataFrame(gate_rows(study, entry, states))
    assert set(rows["regime"]) == {"standard"} and set(rows["threshold"]) == {"mid", "J", "conformal"}
    assert set(rows.query("features == 'states'")["source"]) == set(SOURCES)
    controls = {*RAW, "output margin", "first-token logits", "shuffled labels", "states"}
    assert set(rows.query("source == 'other datasets'")["features"]) == controls
    voids = rows.query("target == 'chaotic'")
    assert set(voids["plain_abs_rec"]) == {0.5}  # the verdicts: two of four voids
    assert (voids["abs_rec"] >= 0.5).all()  # a gate only adds abstentions
    never = rows.query("threshold == 'conformal' and target == 'chaotic'")
    assert (never["abs_rec"] == 0.5).all() and (never["expected_false_abs"] == 0).all()  # too few controls for 5 %


def test_a_gate_in_memory_decides_as_the_gate_stage_counts(study: Workspace, entry: ModelEntry) -> None:
    """`gate_answers` holds folds of scenarios out; the gate without such a fold decides the same about its items."""
    model, states, settings = load_local_model(entry), StoredStates.of(study, STANDARD), study.mechanism
    items = study.tables.read(PROBE_ITEMS, {"dataset": "chaotic"}).set_index("item_id")
    assert entry.media is not None
    about = {"folds": settings.probes.folds, "seed": settings.seed, "false_abs": settings.gate.false_abs}
    decided = set[bool]()
    # One source shares no scenario with the target; the other has its scenarios, of which a fold is held out.
    for source, leaves_out in (("one:occlusion", False), ("one:chaotic_ill_posed", True)):
        layer = inside.gate(study, "tiny", source=source).layer
        table = gate_table(states)
        features = {name: states.read(name, layer) for name in dict.fromkeys(table["dataset"])}
        counted = gate_answers(gate_items(table, features, False, 0), source, "chaotic", **about)
        names = table["scenario_id"].to_numpy(str)[counted.place]
        fold = scenario_folds(names, settings.probes.folds, settings.seed)
        for threshold, k in product(THRESHOLDS, range(settings.probes.folds)):
            without = sorted({*names[fold == k]}) if leaves_out else ()
            # Two of the four scenarios are left, which are as many as the folds.
            gate = inside.gate(study, "tiny", source=source, threshold=threshold, without=without)
            for row in np.flatnonzero(fold == k):
                item = items.loc[table["item_id"].iloc[counted.place[row]]]
                shown = pick_frames(study.resolve(item["clip"]), entry.media)
                prompt = model.prompt(vqa_prompt("standard"), item["question"], shown.frames, shown.times_s)
                assert gate.score(model, prompt) == pytest.approx(counted.score[row], abs=1e-6)
                theirs = bool(counted.score[row] > counted.threshold[threshold][row])
                assert gate.abstains(model, prompt) == theirs
                expected = ABSTENTION if theirs else model.generate([prompt], 4)[0].text
                assert gate.answer(model, prompt, 4) == expected
                decided.add(theirs)
    assert decided == {True, False}


def test_erasure_leaves_nothing_that_a_linear_probe_can_use_and_changes_little_else() -> None:
    rng = np.random.default_rng(0)
    void = np.arange(60) % 2 == 1
    states = rng.normal(size=(60, 8)) * rng.lognormal(size=8)
    states[void, :2] += 5
    gone = inside.erased(states, void)
    assert np.abs(gone[void].mean(axis=0) - gone[~void].mean(axis=0)).max() < 1e-9
    assert np.linalg.matrix_rank(gone - gone.mean(axis=0)) == 7
    assert np.abs(LogisticRegression().fit(gone, void).coef_).max() < 1e-4


def test_the_protocol_takes_any_probe_and_any_features_of_items(study: Workspace) -> None:
    states = inside.load(study, "tiny", layer=2)
    own = inside.protocol(study, "tiny", layer=2)
    assert inside.protocol(study, "tiny", layer=2, features=states).equals(own)
    plain = inside.from_sklearn(lambda: make_pipeline(StandardScaler(), LogisticRegression(tol=1e-10, max_iter=10_000)))
    theirs = inside.protocol(study, "tiny", layer=2, fit=plain)
    assert theirs["value"].to_numpy(float) == pytest.approx(own["value"].to_numpy(float), nan_ok=True)
    assert not inside.protocol(study, "tiny", layer=2, fit=inside.mean_difference).equals(own)
    some = states.where("dataset in ['chaotic', 'chaotic_ill_posed']")
    figures = inside.protocol(study, "tiny", layer=2, features=some)
    assert set(figures["source"]) == set(figures["target"]) == {"chaotic", "chaotic_ill_posed"}
    with raises(TrapsError, "inside.protocol.<locals>.read", "`features`", "2", "chaotic"):
        inside.protocol(study, "tiny", layer=2, features=inside.LoadedStates(some.X[2:], some.items.iloc[2:]))


def test_a_prompt_of_an_item_is_what_the_study_read_and_asked(study: Workspace, entry: ModelEntry) -> None:
    states = inside.load(study, "tiny", layer=2, datasets=["chaotic"])
    model, item = load_local_model(entry, inside=True), str(states.items["item_id"][1])
    assert (model.forward_states(inside.prompt(study, item)).raw[2] == states.X[1]).all()
    shown = inside.prompt(study, item, regime="guided", system="benchmark")
    assert system_prompt("guided") in shown.text and shown.text != inside.prompt(study, item, regime="guided").text


def test_the_layer_is_the_studys_where_none_is_named(study: Workspace) -> None:
    probes = study.tables.read(PROBES, STANDARD.partition)
    chosen = probes.loc[probes["chosen"].eq(True) & (probes["analysis"] == "transfer")].set_index("target")["layer"]
    layers = {name: inside.layer(study, "tiny", name) for name in ("chaotic", "occlusion")}
    assert layers == {name: set(chosen[name]).pop() for name in layers}
    of_own = inside.load(study, "tiny", datasets=["chaotic"])
    assert (of_own.X == inside.load(study, "tiny", layer=layers["chaotic"], datasets=["chaotic"]).X).all()
    assert inside.direction(study, "tiny", "occlusion").layer == layers["occlusion"]
    rows = inside.protocol(study, "tiny")
    assert {*rows.loc[rows["target"] == "chaotic", "layer"]} == {layers["chaotic"]}


def test_a_sweep_is_the_protocol_at_each_layer_beside_what_swapped_labels_give(study: Workspace) -> None:
    rows = inside.sweep(study, "tiny", draws=4)
    for layer, value in zip(rows["layer"], rows["value"], strict=True):
        curves = pair_curves(inside.protocol(study, "tiny", layer=layer).to_dict("records"))
        assert value == pytest.approx(np.mean([curve[layer] for curve in curves.values()]))
    assert (rows["null_low"] <= rows["null_high"]).all() and (rows["best_null"] >= rows["null_low"].max()).all()
    assert (rows.loc[0, ["value", "null_low", "null_high"]] == 0.5).all()  # the embedding of one and the same token


def test_no_repr_prints_an_array(study: Workspace, entry: ModelEntry) -> None:
    states = inside.load(study, "tiny", layer=2)
    objects = [
        states,
        inside.gate(study, "tiny", source="one:chaotic", layer=2),
        inside.fit_probe(states.X, states.void),
    ]
    objects += [inside.direction(study, "tiny", "chaotic", layer=2), inside.prompt(study, states.items["item_id"][0])]
    objects.append(inside.load_model(study, "tiny").forward_states(objects[-1]))  # type: ignore[arg-type]
    for thing in objects:
        assert not {"array", "tensor"} & {*re.findall("[a-z]+", repr(thing))} and len(repr(thing)) < 1000
    assert repr(states).startswith(f"LoadedStates({len(states.X)} x 64, chaotic")


@pytest.mark.parametrize(
    ("wrong", "names"),
    [
        (lambda study: inside.prompt(study, "chaotic:plinko-9:void"), ("plinko-9",)),
        (lambda study: inside.prompt(study, "chaos:plinko-0:void"), ("chaos", "chaotic")),
        (lambda study: inside.prompt(study, "chaotic:plinko-0:void", regime="gided"), ("gided", "guided")),
        (lambda study: inside.prompt(study, "chaotic:plinko-0:void", system="qva"), ("qva",)),
        (lambda study: inside.load(study, "tinny"), ("tinny", "tiny")),
        (lambda study: inside.load(study, "pocket"), ("pocket", "tiny")),
        (lambda study: inside.load(study, "tiny", prompt="gided"), ("gided", "guided")),
        (lambda study: inside.load(study, "tiny", layer=9), ("9", "normed")),
        (lambda study: inside.load(study, "tiny", layer="norm"), ("norm", "normed")),
        (lambda study: inside.load(study, "tiny", datasets=["caotic"]), ("caotic", "chaotic")),
        (lambda study: inside.load(study, "tiny").where("datset == 'chaotic'"), ("datset", "dataset")),
        (lambda study: inside.load(study, "tiny").where([True]), ("1",)),
        (lambda study: inside.layer(study, "tiny", "caotic"), ("caotic", "chaotic")),
        (lambda study: inside.protocol(study, "tiny", layer=9), ("9", "normed")),
        (lambda study: inside.direction(study, "tiny", "caotic"), ("caotic", "chaotic")),
        (lambda study: inside.direction(study, "tiny", "chaotic", kind="nul"), ("nul", "covariance")),
        (lambda study: inside.direction(study, "tiny", "chaotic", layer=9), ("9",)),
        (lambda study: inside.gate(study, "tiny", source="one:chaotic", layer=9), ("9",)),
        (lambda study: inside.load_model(study, "pocket"), ("pocket",)),
    ],
)
def test_a_wrong_name_is_answered_in_one_line_that_names_it_and_what_there_is(
    study: Workspace, wrong: Callable[[Workspace], object], names: tuple[str, ...]
) -> None:
    with raises(TrapsError, "", *names) as caught:
        wrong(study)
    assert "\n" not in str(caught.value)


def public_objects() -> dict[str, object]:
    """What `inside` gives: its own functions and classes, those that it passes on, and their methods."""
    names = {name: value for name, value in vars(inside).items() if not name.startswith("_")}
    again = ast.parse(Path(inside.__file__).read_text()).body
    passed_on = {
        alias.name for node in again if isinstance(node, ast.ImportFrom) for alias in node.names if alias.asname
    }
    own = {name: value for name, value in names.items() if getattr(value, "__module__", "") == inside.__name__}
    found = {name: value for name, value in (own | {n: names[n] for n in passed_on}).items() if value.__doc__}
    for owner in (value for value in own.values() if inspect.isclass(value)):
        methods = {name: value for name, value in vars(owner).items() if not name.startswith("_")}
        found |= {f"{owner.__name__}.{name}": value for name, value in methods.items() if value.__doc__}
    return {name: value for name, value in found.items() if callable(value) or isinstance(value, property)}


def test_every_public_docstring_has_an_example_that_gives_what_it_says(study: Workspace, entry: ModelEntry) -> None:
    model = load_local_model(entry)
    prompt = model.prompt("Look.", "Which?", np.full((2, 32, 32, 3), 90, np.uint8), [0.0, 1.0])
    names = {"inside": inside, "np": np, "local_model": model, "prompt": prompt}
    names |= {"network": model.network, "inputs": prompt.inputs}
    objects = public_objects()
    assert {"load", "LoadedStates.where", "Direction.apply", "gate", "erased"} <= {*objects}
    for name, value in objects.items():
        text = (inspect.getdoc(value) or "").replace(".workspaces/mechanism", str(study.root)).replace("pocket", "tiny")
        assert "Examples\n--------\n>>> " in text, name
        example = doctest.DocTestParser().get_doctest(text, dict(names), name, None, None)
        report = io.StringIO()
        failed = doctest.DocTestRunner(verbose=False).run(example, out=report.write).failed
        assert failed == 0, report.getvalue()
