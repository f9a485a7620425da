"""What errors about keys, names, variables of the environment and empty work say to do makes the same call succeed."""

from __future__ import annotations

from pathlib import Path

import certifi
import pytest

from tests.remedies.remedied import remedied
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.keys import read_key
from traps_pipeline.base.names import check_name
from traps_pipeline.base.network import check_network
from traps_pipeline.pipeline.selection import require_work
from traps_pipeline.scenes.picture.trial import check_rendering
from traps_pipeline.storage.study import Asked, Study
from traps_pipeline.storage.workspace import Workspace


def test_a_key_is_exported_again_as_it_should_be(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MYKEY", "sk-0123456789\n")
    assert remedied(
        lambda: read_key("MYKEY"),
        "base.keys.check_key",
        lambda: monkeypatch.setenv("MYKEY", "sk-0123456789"),
    )


@pytest.mark.parametrize(
    ("variable", "value"),
    [
        ("ALL_PROXY", "proxy:port"),
        ("SSL_CERT_FILE", "/nowhere"),
        ("SSL_CERT_FILE", __file__),
        ("SSL_CERT_DIR", "/nowhere"),
    ],
)
def test_a_variable_of_the_network_is_mended_or_unset(
    variable: str, value: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(variable, value)
    remedied(check_network, "base.network.check_network", lambda: monkeypatch.delenv(variable))
    mended = {"ALL_PROXY": "http://proxy:3128", "SSL_CERT_FILE": certifi.where(), "SSL_CERT_DIR": "/"}
    monkeypatch.setenv(variable, mended[variable])
    assert variable in check_network()


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


def test_a_name_is_changed_to_what_the_sentence_asks_for() -> None:
    remedied(
        lambda: check_name("a...b"),
        "base.names.check_name",
        again=lambda: check_name("a.b"),
        error=ValueError,
    )


def test_an_experiment_asks_something_of_the_stage_that_is_named(tmp_path: Path) -> None:
    def study(dataset: str) -> Workspace:
        asked = Asked(datasets=(dataset,), models=("oracle",), regimes=("standard",), runs=(1,))
        made = Study(scenarios=["plinko-0001"], experiments={"mine": asked})
        return Workspace.create(tmp_path / dataset, made)

    remedied(
        lambda: require_work(study("occlusion"), "mine", None),
        "pipeline.selection.require_work",
        again=lambda: require_work(study("chaotic"), "mine", None),
    )
    remedied(
        lambda: require_work(study("chaotic"), "mine", "hidden_states"),
        "pipeline.selection.require_work",
        again=lambda: require_work(study("chaotic"), "mine", "items"),
    )
