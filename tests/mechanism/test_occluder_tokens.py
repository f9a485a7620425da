"""States at the tokens that the occluder covers, from tables to tables: which clip an item is compared with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.build.errors import raises
from tests.build.mechanism import STANDARD
from tests.mechanism.study import PAIRS, make_study, register, tiny_entry
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism import stages
from traps_pipeline.mechanism.hidden_states import read_layer
from traps_pipeline.mechanism.mechanism_rows import PROBE_ITEMS, HiddenStatesRow
from traps_pipeline.mechanism.probe_items import other_clip, probe_items
from traps_pipeline.mechanism.probing_versions import extraction_version, states_folder
from traps_pipeline.protocol.cells import StatesCell
from traps_pipeline.protocol.datasets import ANSWERABLE
from traps_pipeline.storage.benchmark_tables import VIDEOS, VideoRow
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow


@pytest.fixture
def study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Workspace:
    register(monkeypatch, tiny_entry(tmp_path / "checkpoint"))
    return make_study(tmp_path)


def pooled(workspace: Workspace, pooling: str) -> Workspace:
    return workspace.allow(mechanism=workspace.mechanism.model_copy(update={"pooling": pooling}))


def states(workspace: Workspace, dataset: str) -> dict[str, HiddenStatesRow]:
    workspace.tables.write(PROBE_ITEMS, {"dataset": dataset}, probe_items(workspace, dataset), {})
    return {row.item_id: row for row in stages.extract_states(workspace, StatesCell(dataset, STANDARD))[0]}


def test_every_item_is_compared_with_the_other_clip_of_its_scenario(study: Workspace) -> None:
    own, ill_posed, answerable = (
        {row.item_id: row for row in probe_items(study, name)}
        for name in ("occlusion", "occlusion_ill_posed", ANSWERABLE)
    )
    void, control = own["occlusion:hidden-1:void"], own["occlusion:hidden-1:control"]
    assert void.media_digest != control.media_digest
    for row, other in ((control, void), (void, control), (answerable[f"{ANSWERABLE}:hidden-1:control"], control)):
        assert other_clip(study, vars(row)) == (study.resolve(other.clip), other.media_digest)
    both = [other_clip(study, vars(ill_posed[f"occlusion_ill_posed:hidden-1:{side}"])) for side in ("control", "void")]
    assert both == [(study.resolve(void.clip), void.media_digest)] * 2
    arm = vars(void) | {"media_digest": "a decoy's"}
    assert other_clip(study, arm) == (study.resolve(control.clip), control.media_digest)


def test_the_states_of_an_ill_posed_pair_are_those_where_the_occluder_would_be(study: Workspace) -> None:
    """A clip of this study is one visual token, which the occluder changes: its mean is that of all visual tokens."""
    changed = pooled(study, "changed")
    own, ill_posed = (states(changed, name) for name in ("occlusion", "occlusion_ill_posed"))
    for n in range(PAIRS):  # the same clip, question and other clip: the same states
        mine, theirs = own[f"occlusion:hidden-{n}:control"], ill_posed[f"occlusion_ill_posed:hidden-{n}:control"]
        assert mine.states_key == theirs.states_key
    read: dict[str, np.ndarray] = {}
    for of in (changed, pooled(study, "visual")):
        made = states(of, "occlusion")
        read[of.mechanism.pooling] = read_layer(states_folder(of, StatesCell("occlusion", STANDARD)), 2)[1]
        assert {row.pooling for row in made.values()} == {of.mechanism.pooling}
    assert (read["changed"] == read["visual"]).all() and np.isfinite(read["changed"]).all()
    with raises(TrapsError, "mechanism.hidden_states._pooled_tokens", "occlusion:hidden-", "unchanged"):
        states(pooled(study, "unchanged"), "occlusion")


def test_another_clip_of_the_other_side_makes_states_stale(study: Workspace) -> None:
    changed = pooled(study, "changed")
    before = [extraction_version(of, STANDARD) for of in (study, changed)]
    rows = study.tables.read(VIDEOS, {"category": "hidden"}).to_dict("records")
    rows[0] |= {"file_sha256": "0" * 64}
    study.tables.write(VIDEOS, {"category": "hidden"}, [VideoRow(**row) for row in rows], {})
    assert extraction_version(study, STANDARD) == before[0]  # the default does not read it
    assert extraction_version(changed, STANDARD) != before[1]
