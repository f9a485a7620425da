"""The provider that tests ask: how it fails follows from the request, and it keeps no clips.

What it answers is read by the package itself, in `models/test_api.py` and `models/test_shapes.py`."""

from __future__ import annotations

import base64
import http.client
import json
import os
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.parse
from collections.abc import Callable
from typing import Any

import pytest

from tests.conftest import ROOT
from tests.providers.server import Provider

pytestmark = pytest.mark.slow  # starts a server
CLIP = b"\x00\x01clip" * 100
CODED = base64.b64encode(CLIP).decode()


@pytest.fixture
def provider(shared_provider: Provider) -> Provider:
    return shared_provider.afresh()


def ask(provider: Provider, question: str) -> int:
    """Ask a question about a clip; return the status."""
    uri = f"data:video/mp4;base64,{CODED}"
    parts = [{"type": "file", "file": {"file_data": uri}}, {"type": "text", "text": question}]
    body = {"model": "m", "messages": [{"role": "user", "content": parts}]}
    connection = http.client.HTTPConnection(urllib.parse.urlsplit(provider.url).netloc, timeout=60)
    connection.request("POST", "/v1/chat/completions", json.dumps(body), {"Content-Type": "application/json"})
    status = connection.getresponse().status
    connection.close()
    return status


def faults(provider: Provider, **config: Any) -> list[str | None]:
    """Return the faults of two attempts of each of 20 bodies."""
    provider.afresh(**config)
    for _attempt in range(2):
        for number in range(20):
            ask(provider, f"question {number}")
    return [record["fault"] for record in provider.requests()]


def wait_until(is_true: Callable[[], bool]) -> None:
    end = time.monotonic() + 90
    while not is_true():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_seed_decides_which_attempts_fail(provider: Provider) -> None:
    shares = {"faults": {"server_error": 0.2, "empty": 0.3}}
    first = faults(provider, seed=1, **shares)
    assert first == faults(provider, seed=1, **shares) != faults(provider, seed=2, **shares)
    assert {*first} == {"server_error", "empty", None}
    assert first[:20] != first[20:], "an attempt after a failure draws again"
    assert CODED[:40] not in json.dumps(provider.requests())


def test_it_ends_with_its_parent() -> None:
    script = """
import os
from tests.providers.server import Provider
print(Provider.start().url, flush=True)
os.kill(os.getpid(), 9)
"""
    command, environment = [sys.executable, "-c", script], os.environ | {"PYTHONPATH": str(ROOT)}
    parent = subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True, check=False)
    address = urllib.parse.urlsplit(parent.stdout.strip())

    def is_gone() -> bool:
        with socket.socket() as client:
            return client.connect_ex((address.hostname, address.port)) != 0

    assert parent.returncode == -9 and address.port
    wait_until(is_gone)
