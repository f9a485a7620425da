"""A key is refused where it is read, in a sentence that names its variable and never its value."""

from __future__ import annotations

import pytest

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.keys import read_key

KEY = "sk-secretsecret123"
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


@pytest.mark.parametrize("value", WRONG)
def test_what_is_no_key_is_named_without_the_value(value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MYKEY", value)
    with pytest.raises(TrapsError) as caught:
        read_key("MYKEY")
    assert str(caught.value).startswith(f"MYKEY {WRONG[value]}")
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize("value", [KEY, "x", "a%41$b'c\"d", "=" * 4000])
def test_any_other_key_is_returned_as_it_stands(value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MYKEY", value)
    assert read_key("MYKEY") == value
