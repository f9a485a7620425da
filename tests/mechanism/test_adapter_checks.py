"""The checks of an adapter: each holds on the three families as the page says, and each loses where it is broken."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.build.errors import raises
from tests.local_models import FAMILIES, Family, model
from tests.models.local import check_table
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism import patching_effects
from traps_pipeline.mechanism.adapter_checks import CHECKS, Subject, brightening_clip
from traps_pipeline.mechanism.hook import Steering
from traps_pipeline.models.local import capture
from traps_pipeline.models.local import vision_cache as clips
from traps_pipeline.models.local.model import LocalModel

pytestmark = pytest.mark.slow
BY_NAME = {check.name: check for check in CHECKS}


def test_the_page_has_the_table_of_checks(tmp_path: Path) -> None:
    assert check_table.ON_PAGE.written() == check_table.table()
    assert [*check_table.NAMES] == [*FAMILIES]


def one_block_late(patch: pytest.MonkeyPatch) -> None:
    """States are taken before a block in place of behind it."""
    first = capture.first_tensor
    patch.setattr(capture, "first_tensor", lambda output: first(output) + 1)


def a_hook_that_stays(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Steering, "applied", _adding_always)


def _adding_always(self: Steering, model: LocalModel) -> Any:
    @contextmanager
    def applied() -> Iterator[None]:
        handle = model.block(self.layer).register_forward_hook(lambda _, __, out: out)
        try:
            yield
        finally:
            handle.remove()

    return applied()


def twice_as_far(patch: pytest.MonkeyPatch) -> None:
    """Nothing below the layer changes and everything above it does: only the state itself tells."""
    once = Steering.applied
    patch.setattr(Steering, "applied", lambda push, of: once(replace(push, alphas=(2 * push.alphas[0],)), of))


def rounded_features(patch: pytest.MonkeyPatch) -> None:
    made = clips._Features
    patch.setattr(clips, "_Features", lambda tokens, deepstack: made(tokens * 1.01, deepstack))


def paths_beside_the_stream_forgotten(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(patching_effects, "_residual_weights", lambda _, __: None)


@pytest.mark.parametrize(
    ("family", "check", "broken"),
    [
        ("qwen3-vl", "states", one_block_late),
        ("qwen3-vl", "alpha 0", a_hook_that_stays),
        ("qwen3-vl", "alpha", twice_as_far),
        ("qwen3-vl", "clips", rounded_features),
        ("gemma-4", "patching", paths_beside_the_stream_forgotten),
    ],
)
def test_a_check_loses_where_the_adapter_is_broken(
    family: Family, check: str, broken: Callable[[pytest.MonkeyPatch], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    subject = Subject(model(family), *brightening_clip())
    subject.model.clips = clips.ClipMemory()
    with monkeypatch.context() as patch:
        broken(patch)
        with raises(TrapsError, "mechanism.adapter_checks._require"):
            BY_NAME[check].found(subject)
    subject.model.clips = clips.ClipMemory()
    BY_NAME[check].found(subject)


def test_in_sixteen_bits_what_rounding_changes_is_not_looked_at() -> None:
    subject = Subject(model("qwen3-vl", dtype="bfloat16"), *brightening_clip())
    found = {check.name: check.found(subject) for check in CHECKS}
    assert found["states"].startswith(f"{subject.model.n_layers + 1} ")
    left_out = {name for name, said in found.items() if "bfloat16" in said}
    assert left_out == {check.name for check in CHECKS if check.exact}
    assert np.isfinite(subject.model.forward_states(subject.prompts[0]).raw).all()
