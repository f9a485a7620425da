"""What errors about keys, names, variables of the environment and empty work say to do makes the same call succeed."""

from __future__ import annotations

from pathlib import Path

import certifi
import pytest

from tests.remedies.remedied import remedied
from traps_pipeline.base.keys import read_key
from traps_pipeline.base.names import check_name
from traps_pipeline.base.network import check_network
from traps_pipeline.orchestration.run import require_work
from traps_pipeline.scenes.trial import check_rendering
from traps_pipeline.storage.study import Asked, Study
from traps_pipeline.storage.workspace import Workspace


def test_a_key_is_exported_again_as_it_should_be(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MYKEY", "sk-0123456789\n")
    assert remedied(
        lambda: read_key("MYKEY"),
        "export it again, as printable ASCII characters without white space",
        lambda: monkeypatch.setenv("MYKEY", "sk-0123456789"),
    )


@pytest.mark.parametrize(
    ("variable", "value", "sentence"),
    [
        ("ALL_PROXY", "proxy:port", "is no address of a proxy: write it as http://HOST:PORT, or unset it"),
        ("ALL_PROXY", "socks5://proxy:1080", "names a SOCKS proxy, which needs the package socksio: pip install"),
        ("SSL_CERT_FILE", "/nowhere", "names the file {}, which is not there: mend or unset it"),
        ("SSL_CERT_FILE", __file__, "names the file {}, which holds no certificates that can be read: mend or unset"),
        ("SSL_CERT_DIR", "/nowhere", "names the folder {}, which is not there: mend or unset it"),
    ],
)
def test_a_variable_of_the_network_is_mended_or_unset(
    variable: str, value: str, sentence: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("traps_pipeline.base.network.find_spec", lambda name: None)
    monkeypatch.setenv(variable, value)
    remedied(check_network, sentence, lambda: monkeypatch.delenv(variable))
    mended = {"ALL_PROXY": "http://proxy:3128", "SSL_CERT_FILE": certifi.where(), "SSL_CERT_DIR": "/"}
    monkeypatch.setenv(variable, mended[variable])
    assert variable in check_network()


@pytest.mark.slow
def test_variables_that_choose_an_opengl_that_does_not_draw_are_unset(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "nonsense")

    def unset() -> None:
        monkeypatch.delenv("MUJOCO_GL")
        monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)

    remedied(check_rendering, "this machine cannot render clips with {} ({}): unset these variables", unset)


def test_a_name_is_changed_to_what_the_sentence_asks_for() -> None:
    remedied(
        lambda: check_name("a...b"),
        "must match [a-z0-9.-]+, begin and end with a letter or digit, have no two dots in a row",
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
        "experiment {} asks nothing: none of its scenarios belongs to its datasets",
        again=lambda: require_work(study("chaotic"), "mine", None),
    )
    remedied(
        lambda: require_work(study("chaotic"), "mine", "hidden_states"),
        "--until {}: experiment {} wants nothing of it; name another stage",
        again=lambda: require_work(study("chaotic"), "mine", "items"),
    )
