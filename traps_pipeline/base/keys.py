"""Read API keys from the environment; refuse a key that no header can carry.

This is the one place that reads them. A key in a file is refused too: what an entry holds is stored in the ledger, the
workspace and releases.
"""

import os
import re
import unicodedata
from collections.abc import Mapping
from typing import Annotated, Any
from urllib.parse import urlsplit

from pydantic import AfterValidator

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.redaction import remember

# Parameters that hold a key, or that send it to another address than the account's.
_NO_PARAMETER = re.compile(
    r"(api|access)[_-]?key$|(^|[_-])(token|secret|password|credentials|authorization|headers)$|^(api_base|base_url)$",
    re.IGNORECASE,
)
_NAMES = {"\n": "a line break", "\r": "a carriage return", "\t": "a tab", " ": "a space"}


def read_key(variable: str) -> str:
    """Return the key in a variable. Raises TrapsError if it is not set or refused."""
    value = optional_key(variable)
    if value is None:
        raise TrapsError(f"{variable} is not set; export the key, or leave the models that need it out")
    return value


def optional_key(variable: str) -> str | None:
    """Return the key in a variable, None if not set. Raises TrapsError if refused."""
    value = os.environ.get(variable)
    if not value:
        return None
    remember(value)
    check_key(variable, value)
    return value


def check_key(variable: str, value: str) -> None:
    """Raise TrapsError unless a key (or address with a password) is printable ASCII.

    White space is refused, not stripped, so that every program reads the same key from the variable. The error names
    the variable and never the value.
    """
    problem = _problem(value)
    if problem:
        raise TrapsError(f"{variable} {problem}: export it again, as printable ASCII characters without white space")


def check_parameters(params: Mapping[str, Any]) -> None:
    """Raise ValueError, without the value, if parameters hold a key or an address."""
    for name, value in params.items():
        if _NO_PARAMETER.search(str(name)):  # a token's number in `logit_bias`
            raise ValueError(
                f"params: {name} is none, since parameters are kept as they are: export the key, name its variable as "
                "`key`, and give the address as `base_url`"
            )
        for inner in value if isinstance(value, list) else [value]:
            if isinstance(inner, Mapping):
                check_parameters(inner)


def check_address(address: str) -> str:
    """Return the address if it holds no key; else raise ValueError without quoting it."""
    parts = urlsplit(address)
    if parts.username is not None or parts.query or parts.fragment:
        raise ValueError("holds more than scheme, host, port and path: export the key and name its variable as `key`")
    return address


def check_variable(name: str) -> str:
    """Return the variable's name if it is no key; else raise ValueError without it."""
    if not re.fullmatch(r"[A-Z][A-Z0-9_]*", name):
        raise ValueError("is the name of the environment variable that holds a key, such as MY_KEY, not the key itself")
    return name


Address = Annotated[str, AfterValidator(check_address)]
Variable = Annotated[str, AfterValidator(check_variable)]


def _problem(value: str) -> str:
    """Return why a value is no key, beginning with a verb; empty if it may be one."""
    if not value.strip():
        return "holds no key"
    for verb, character in (("ends with", value[-1]), ("begins with", value[0])):
        if name := _name_of(character):
            return f"{verb} {name}"
    if name := next(filter(None, map(_name_of, value)), ""):
        return f"contains {name}"
    if len(value) > 1 and value[0] == value[-1] and value[0] in "\"'":
        return "is wrapped in quotes"
    return ""


def _name_of(character: str) -> str:
    """Return the name of a character that no key contains; empty for any other."""
    if character in _NAMES:
        return _NAMES[character]
    if character.isascii() and character.isprintable():
        return ""
    if character.isspace():
        return "white space"
    return "a control character" if unicodedata.category(character) == "Cc" else "a character that is not ASCII"
