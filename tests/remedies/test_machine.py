"""What errors about keys, names, variables of the environment and empty work say to do makes the same call succeed."""

from __future__ import annotations

import pytest

from tests.remedies.remedied import remedied
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.scenes.picture.trial import check_rendering


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variable", "value"),
    [("MUJOCO_GL", "nonsense"), ("GALLIUM_DRIVER", "nonsense"), ("MESA_GL_VERSION_OVERRIDE", "1.0")],
)
def test_variables_that_choose_an_opengl_that_does_not_draw_are_named_and_unset(
    monkeypatch: pytest.MonkeyPatch, variable: str, value: str
) -> None:
    monkeypatch.setenv(variable, value)
    with pytest.raises(TrapsError, match=f"cannot render clips with .*{variable}={value}"):
        check_rendering()

    def unset() -> None:
        monkeypatch.delenv(variable)
        monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)

    remedied(check_rendering, "scenes.picture.trial.check_rendering", unset)
