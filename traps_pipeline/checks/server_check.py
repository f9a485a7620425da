"""Check key, address and list of models of a server before it is asked."""

from contextlib import suppress
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.network import check_network, is_loopback
from traps_pipeline.base.terminal import plain
from traps_pipeline.checks.wire_check import model_name
from traps_pipeline.models.registry.entries import Account, Entry

REACH_S = 5.0  # time-out of the request for the list
BAD_REQUEST = 400


@dataclass(frozen=True)
class ServerCheck:
    """What a server says of itself before any model is called.

    problem: why asking is useless; unlisted: the server's own list of models lacks the name; refused: the list, which
    needs only a key, is refused. Neither is certain: some servers list what was downloaded, or examples, and a litellm
    proxy without a database answers 400 to a wrong key.
    """

    problem: str = ""
    unlisted: str = ""
    refused: str = ""


def check_server(entry: Entry, account: Account) -> ServerCheck:
    """Check the key, the address, and the server's own list of models if it has one."""
    from traps_pipeline.models.wire.httpx_transport import get_url

    try:
        check_network()
        secret = account.secret()
    except TrapsError as error:
        return ServerCheck(str(error))
    if account.base_url is None:
        return ServerCheck()
    headers = {"Authorization": f"Bearer {secret}"} if secret else {}
    try:
        answer = get_url(f"{account.base_url.rstrip('/')}/models", headers, REACH_S)
    except TrapsError as error:
        return ServerCheck(nobody_at(account.base_url, plain(str(error))))
    if answer.status_code in (401, 403):
        return ServerCheck(wrong_key(account))
    if answer.status_code == BAD_REQUEST and account.key:
        list_problem = f"{account.base_url} refuses even its list of models (HTTP 400), which wants nothing but a key"
        return ServerCheck(refused=f"{list_problem}: is the one in {account.key} right?")
    served_names = [str(model["id"]) for model in _served_models(answer) if isinstance(model, dict) and "id" in model]
    if served_names and model_name(entry) not in served_names:
        name_problem = (
            f"{account.base_url} serves no {model_name(entry)!r}; it lists {plain(', '.join(served_names[:8]))[:200]}"
        )
        return ServerCheck(unlisted=name_problem)
    return ServerCheck()


def nobody_at(address: str, why: str = "the cause stands above") -> str:
    """Return the error message for an address at which no server listens."""
    is_here = is_loopback(urlsplit(address).hostname or "")
    remedy = "start the server there" if is_here else "look at this machine's network, proxy variables and NO_PROXY"
    return f"nothing answers at {address} ({why}): {remedy}, or mend its `base_url`"


def wrong_key(account: Account) -> str:
    """Return the error message for a key that is refused or missing."""
    location = f" at {account.base_url}" if account.base_url else ""
    if account.key:
        return f"the key in {account.key} is not accepted{location}: export the right one"
    return f"a key is wanted{location}: name its variable as `key`"


def _served_models(answer: Any) -> list[Any]:
    if answer.status_code == 200:
        with suppress(ValueError, AttributeError):
            model_list = answer.json().get("data")
            return model_list if isinstance(model_list, list) else []
    return []
