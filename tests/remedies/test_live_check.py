"""What the check of a model says to do makes the same check find nothing; what a server of pages says lets one in."""

from __future__ import annotations

import socket

import pytest

from tests.build.guard import PEOPLE, ask
from tests.build.live import NAME, Check, check
from tests.conftest import KEY
from tests.providers.server import Provider
from tests.remedies.remedied import remedied
from traps_pipeline.base.webguard import public_name, token_for

__all__ = ["check"]  # the fixture


@pytest.mark.slow
def test_an_address_that_is_mended_is_answered(check: Check) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{free.getsockname()[1]}/v1"
    (problem,) = check(address=address).problems
    assert "start the server there, or mend its `base_url`" in problem
    assert check().problems == []


@pytest.mark.slow
def test_a_name_that_is_listed_is_the_model_that_is_meant(check: Check, provider: Provider) -> None:
    provider.configure(served=["an-example"])
    assert "make sure that it is the model that you mean" in check().notes[0]
    provider.configure(served=[NAME])
    assert check().notes == []


@pytest.mark.slow
def test_a_right_key_is_accepted(check: Check, provider: Provider, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRAPS_TEST_WRONG_KEY", "sk-wrong")
    provider.configure(fault_by_model={NAME: "unauthorized"})
    (problem,) = check(key=KEY).problems
    assert f"the key in {KEY} is not accepted" in problem and "export the right one" in problem
    (problem,) = check(key=None).problems
    assert "a key is wanted" in problem and "name its variable as `key`" in problem
    provider.configure(fault_by_model={})
    assert check(key=KEY).problems == []


@pytest.mark.slow
def test_a_model_without_a_schema_says_so_in_its_entry(check: Check, provider: Provider) -> None:
    provider.configure(scripts={NAME: {"": "red and then blue"}})
    (problem,) = check().problems
    assert "it ignores the schema" in problem and "say `json_schema: false` and why under waivers" in problem
    found = check(json_schema=False, waivers={"json_schema": "the server has none"})
    assert found.problems == [], found.problems


@pytest.mark.slow
def test_a_model_that_refuses_a_schema_is_asked_without_one(check: Check, provider: Provider) -> None:
    provider.configure(unstructured=[NAME])
    (problem,) = check().problems
    assert "it refuses structured output (http_400): say `json_schema: false` and why under waivers" in problem
    found = check(json_schema=False, waivers={"json_schema": "the server refuses it"})
    assert found.problems == [], found.problems


@pytest.mark.slow
def test_a_model_that_thinks_in_its_answer_says_so_in_its_entry(check: Check, provider: Provider) -> None:
    said = '<think>red, then blue</think>{"reason": "seen", "final_answer": "red and blue"}'
    provider.configure(scripts={NAME: {"": said}})
    (problem,) = check().problems
    assert 'say `thinking: "<think>"` in its entry' in problem
    assert check(thinking="<think>").problems == []


# --- servers of pages -------------------------------------------------------------------------------------------------


def test_the_address_that_was_printed_lets_a_browser_in() -> None:
    status, text, _ = ask()
    assert status == 403 and "open the address that `make ui` printed" in text
    status, text, _ = ask(host="example.org")
    assert status == 421 and "open the address that `make ui` printed" in text
    status, _, headers = ask(f"token={PEOPLE['jd']}")  # as the printed address has it
    assert (status, headers["location"]) == (303, "/")
    assert ask(cookie=headers["set-cookie"].partition(";")[0])[:2] == (200, "jd")


def test_a_server_listens_beyond_this_machine_with_a_token_of_ones_own() -> None:
    def listen(host: str, token: str | None = None) -> str:
        return token_for(host, token, danger="see all", variable="TRAPS_TOKEN")

    mine = "a-token-that-nobody-guesses"
    for host, token in (("0.0.0.0", mine), ("127.0.0.1", None)):
        found = remedied(
            lambda: listen("0.0.0.0"),
            "base.webguard.token_for",
            again=lambda host=host, token=token: listen(host, token),
        )
        assert found == mine if token else len(found) > 20


def test_a_server_behind_another_one_is_given_its_address() -> None:
    name = remedied(
        lambda: public_name("labels.example.org"),
        "base.webguard.public_name",
        again=lambda: public_name("https://labels.example.org"),
    )
    assert name == "labels.example.org"
