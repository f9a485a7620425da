"""What errors about keys, names, variables of the environment and empty work say to do makes the same call succeed."""

from __future__ import annotations

import pytest

from tests.remedies.remedied import remedied
from traps_pipeline.scenes.picture.trial import check_rendering


@pytest.mark.slow
def test_variables_that_choose_an_opengl_that_does_not_draw_are_unset(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "nonsense")

    def unset() -> None:
        monkeypatch.delenv("MUJOCO_GL")
        monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)

    remedied(check_rendering, "scenes.picture.trial.check_rendering", unset)
