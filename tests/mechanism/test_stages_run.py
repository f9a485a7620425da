"""`traps run` makes the mechanistic stages through Dagster; a second run computes nothing."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

from tests.build.inside import with_mechanism
from tests.conftest import Checkout, Finished, copied, once
from traps_pipeline.mechanism.control_rows import PATCHING, PROBE_BASELINES, STEERING_NULLS
from traps_pipeline.mechanism.mechanism_rows import PROBES, STEERING_EFFECTS, STEERING_VOTES
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow


def counted(finished: Finished) -> tuple[int, ...]:
    """Items extracted, steered answers asked, votes on them."""
    assert finished.code == 0, finished.out + finished.err
    found = re.search(r"inside models: (\d+) items .*? (\d+) steered .*? (\d+) votes on them", finished.out)
    assert found, finished.out
    return tuple(map(int, found.groups()))


@pytest.fixture
def examined(small: Checkout, tmp_path_factory: pytest.TempPathFactory, tmp_path: Path) -> tuple[Checkout, Finished]:
    """A copy of a study that was run with a look into a tiny model, and what that run printed."""

    def make(folder: Path) -> str:
        study = copied(small, folder)
        finished = study.traps("run", with_mechanism(study))
        assert finished.code == 0, finished.out + finished.err
        return finished.out

    made = once(tmp_path_factory, "examined", make)
    shutil.copytree(made, tmp_path, symlinks=True, dirs_exist_ok=True)
    return Checkout(tmp_path / "checkout", tmp_path / "study"), Finished(0, made.with_suffix(".out").read_text(), "")


@pytest.mark.promise
def test_traps_run_looks_into_a_model_once(examined: tuple[Checkout, Finished]) -> None:
    study, finished = examined
    extracted, answers, votes = counted(finished)
    tables = Workspace.open(study.workspace).tables
    judged, effects = tables.read_all(STEERING_VOTES), tables.read(STEERING_EFFECTS, {})
    assert extracted > 0 and answers > 0 and votes > 3 * answers  # controls are judged for correctness too
    assert len(judged) > answers  # controls stand in two datasets
    assert len(effects.groupby(["source", "target"])) == 4  # the paths between the two
    nulls, baselines = tables.read(STEERING_NULLS, {}), tables.read_all(PROBE_BASELINES)
    assert set(nulls["draws"]) == {2} and set(nulls["dose"]) == {1}
    assert {"question words", "output margin", "noise"} <= set(baselines["features"])
    patched = tables.read_all(PATCHING)
    assert patched.query("layer == 4 and group == 'last' and source == 'pair' and site == 'residual'")["n"].max() == 2
    assert set(patched.loc[patched["effect"].notna()].groupby(["dataset", "into", "source"]).size()) == {6}
    assert ((patched["n"] + patched["n_left_out"]) > 0).all()
    assert tables.read_all(PROBES)["note"].notna().any()  # tiny was not asked under standard: no Cf->Cf, and why
    assert counted(study.traps("run", "inside.yaml")) == (0, 0, 0)


# Each stage is made once more, and while it is at work one of its inputs changes: a table or report of a stage above is
# given another version, a source another content. Printed: what is stale afterwards, and what was changed.
MEANWHILE = """
import json
import dagster as dg
import pyarrow.parquet as pq
from traps_pipeline.definitions import defs
from traps_pipeline.pipeline.graph import Source, name_of, the_graph
from traps_pipeline.pipeline.lineage import Lineage, _report_state
from traps_pipeline.pipeline.run import dagster_history
from traps_pipeline.storage.parquet import write_sealed
from traps_pipeline.pipeline.runs import RunsHere
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.pipeline.wanted import StudyPartitions

workspace, graph = Workspace.open(), the_graph()
job = defs.resolve_implicit_global_asset_job_def()

def change(name, key):
    one = graph.declared[name]
    if isinstance(one, Source):
        former = one.version
        object.__setattr__(one, "version", lambda workspace, k: "changed" if k == key else former(workspace, k))
        return lambda: object.__setattr__(one, "version", former)
    table = one.table is not None
    path = workspace.tables.path(one.table, one.columns(key)) if table else _report_state(workspace, one)
    content = path.read_bytes()
    if table:
        data = pq.read_table(path)
        state = json.loads(data.schema.metadata[b"traps"]) | {"version": "0" * 16}
        write_sealed(path, data, {b"traps": json.dumps(state).encode()})
    else:
        path.write_text(json.dumps(json.loads(content) | {"version": "0" * 16}))
    return lambda: path.write_bytes(content)

def meanwhile(stage, key, parent):
    undo = []
    make = stage.make
    def made(workspace, k):
        found = make(workspace, k)
        undo.append(change(*parent))
        return found
    def collected(workspace, keys):
        for found in make(workspace, keys):
            undo.append(change(*parent))
            yield found
    object.__setattr__(stage, "make", collected if stage.side_by_side else made)
    try:
        [ran] = RunsHere(history, job).make([stage], [(key, key)], {})
        problems = ran.problems
        status = Lineage(workspace).status(stage.name, key)
    finally:
        object.__setattr__(stage, "make", make)
        for one in undo:
            one()
    told = {"changed": name_of(parent), "problems": problems, "told": len(undo), "why": status.reasons}
    return {"stage": stage.name, **told}

def made_above(stage):
    key, versions = stage.wanted(StudyPartitions(workspace))[0], Lineage(workspace)
    return [(p, k) for p, keys in graph.parents(stage.name, key).items() for k in keys if versions.version(p, k)]

# Nothing is gated here, since no experiment asks the tiny model; what is made from that has nothing above it.
wanted = [stage for stage in graph.stages if stage.wanted(StudyPartitions(workspace)) and made_above(stage)]
print("STAGES", *(stage.name for stage in wanted))
with dagster_history(workspace) as history:
    for stage in wanted:
        print("MADE", json.dumps(meanwhile(stage, stage.wanted(StudyPartitions(workspace))[0], made_above(stage)[-1])))
"""


def test_an_input_that_changes_while_a_stage_is_at_work_leaves_the_stage_stale(
    examined: tuple[Checkout, Finished],
) -> None:
    study, _ = examined
    walked = study.python("-c", MEANWHILE)
    assert walked.code == 0, walked.err
    found = [json.loads(line.removeprefix("MADE ")) for line in walked.out.splitlines() if line.startswith("MADE ")]
    assert [one["stage"] for one in found] == walked.out.splitlines()[0].removeprefix("STAGES ").split()
    for one in found:
        assert one["problems"] == [] and one["told"] == 1, one
        assert one["why"] == [f"{one['changed']} changed"], one
