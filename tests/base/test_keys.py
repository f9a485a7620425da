"""A key is refused where it is read, in a sentence that names its variable and never its value."""

from __future__ import annotations

import pytest

from tests.build.errors import raises
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.keys import read_key

KEY = "sk-secretsecret123"
# What is wrong with a value: sentences differ where these do, and there alone.
WRONG = {
    "": "is not set",
    " \n": "holds no key",
    f"{KEY}\n": "ends with a line break",
    f"{KEY}\r\n": "ends with a line break",
    f"{KEY}\r": "ends with a carriage return",
    f"{KEY} ": "ends with a space",
    f" {KEY}": "begins with a space",
    f"{KEY}\t": "ends with a tab",
    f"{KEY}\n{KEY}": "contains a line break",
    f"{KEY}\x01x": "contains a control character",
    f"{KEY}\x7f": "ends with a control character",
    f"sk-ä{KEY}": "contains a character that is not ASCII",
    f"\ufeff{KEY}": "begins with a character that is not ASCII",
    f"{KEY}\u00a0": "ends with white space",
    f"{KEY}\udcff": "ends with a character that is not ASCII",
    f'"{KEY}"': "is wrapped in quotes",
    f"'{KEY}'": "is wrapped in quotes",
}


def test_what_is_no_key_is_named_without_the_value(monkeypatch: pytest.MonkeyPatch) -> None:
    told = dict[str, str]()
    for value, wrong in WRONG.items():
        monkeypatch.setenv("MYKEY", value)
        with raises(TrapsError, f"base.keys.{'check_key' if value else 'read_key'}", "MYKEY") as caught:
            read_key("MYKEY")
        assert "secret" not in str(caught.value)
        assert told.setdefault(wrong, str(caught.value)) == str(caught.value)
    assert len({*told.values()}) == len({*WRONG.values()})


@pytest.mark.parametrize("value", [KEY, "x", "a%41$b'c\"d", "=" * 4000])
def test_any_other_key_is_returned_as_it_stands(value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MYKEY", value)
    assert read_key("MYKEY") == value
