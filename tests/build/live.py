"""Live checks of an entry at the test provider."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from typing import Any

import pytest

from tests.conftest import KEY
from tests.providers.server import Provider
from traps_pipeline.checks.live_check import Live, check_live
from traps_pipeline.models import api, registry
from traps_pipeline.models.registry import PROTOCOL, Account, Entry, ModelEntry, Prices

NAME = "seer"


Check = Callable[..., Live]


@pytest.fixture
def check(provider: Provider, monkeypatch: pytest.MonkeyPatch) -> Check:
    """Checks an entry at the provider, or at another address, live."""

    def checked(kind: type[Entry] = ModelEntry, address: str = "", key: str | None = KEY, **changes: Any) -> Live:
        account = Account(key=key, base_url=address or f"{provider.url}/v1")
        for module in (api, registry):
            monkeypatch.setattr(module, "load_accounts", lambda: {"here": account})
        fields: dict[str, Any] = {"id": NAME, "backend": "api", "account": "here", "provider_id": f"openai/{NAME}"}
        fields |= {"prices": Prices(input=0, output=0, as_of=datetime.date(2026, 11, 1))}
        if kind is ModelEntry:
            fields |= {"params": {name: value for name, (_, value) in PROTOCOL.items()}}
            fields |= {"media": {"profile": "images", "fps": 5, "most": 25}}
        else:
            fields |= {"params": {"temperature": 0.8, "max_tokens": 512}}
        entry = kind.model_validate(fields | changes, context={"accounts": {"here": account}})
        (live,) = check_live([entry])
        return live

    return checked
