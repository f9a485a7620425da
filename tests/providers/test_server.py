"""The provider that tests ask: how it fails follows from the request, and it keeps neither keys nor clips.

What it answers is read by the package itself, in `models/test_api.py` and `models/test_shapes.py`."""

from __future__ import annotations

import base64
import hashlib
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
from tests.providers.server import Provider, fingerprint

pytestmark = pytest.mark.slow  # starts a server
KEY = "sk-very-secret"
CLIP = b"\x00\x01clip" * 100
CODED = base64.b64encode(CLIP).decode()
CLIP_RECORD = {"sha256": hashlib.sha256(CLIP).hexdigest(), "bytes": len(CLIP)}


@pytest.fixture
def provider(shared_provider: Provider) -> Provider:
    return shared_provider.afresh()


def ask(provider: Provider, question: str, path: str = "/v1/chat/completions", **more: Any) -> int:
    """Ask a question about a clip; return the status."""
    uri = f"data:video/mp4;base64,{CODED}"
    parts = [{"type": "file", "file": {"file_data": uri}}, {"type": "text", "text": question}]
    body = {"model": "m", "messages": [{"role": "user", "content": parts}]} | more
    connection = http.client.HTTPConnection(urllib.parse.urlsplit(provider.url).netloc, timeout=60)
    headers = {"Content-Type": "application/json", "Authorization": f"Bearer {KEY}", "x-goog-api-key": KEY}
    connection.request("POST", path, json.dumps(body).encode(), headers)
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


def test_transient_faults_can_end_after_some_attempts(provider: Provider) -> None:
    met = faults(provider, faults={"server_error": 0.5, "empty": 0.5}, only_first_attempts=1)
    assert {*met[:20]} == {"server_error", "empty"} and {*met[20:]} == {None, "empty"}
    stats = provider.stats()
    assert (stats["requests"], stats["distinct_bodies"]) == (40, 20)


def test_one_model_can_fail_always_or_never(provider: Provider) -> None:
    provider.configure(faults={"server_error": 1}, fault_by_model={"m": "forbidden", "good": None})
    assert [ask(provider, "Which?", model=name) for name in ("m", "good", "other")] == [403, 200, 500]


def test_a_wrong_config_is_refused_and_changes_nothing(provider: Provider) -> None:
    before = provider.configure()
    for wrong in ({"faults": {"oops": 1}}, {"faults": {"empty": 0.6, "cut": 0.6}}, {"speed": 1}):
        with pytest.raises(urllib.error.HTTPError, match="400"):
            provider.configure(**wrong)
    assert provider.configure() == before


def test_records_hold_neither_keys_nor_clips(provider: Provider) -> None:
    ask(provider, "Which?", path=f"/v1/chat/completions?key={KEY}&alt=json")
    (record,) = provider.requests()
    assert KEY not in json.dumps(record) and CODED[:40] not in json.dumps(record)
    assert record["query"] == {"key": fingerprint(KEY), "alt": "json"}
    assert record["headers"]["authorization"] == f"Bearer {fingerprint(KEY)}"
    assert record["headers"]["x-goog-api-key"] == fingerprint(KEY)
    clip, question = record["body"]["messages"][0]["content"]
    assert clip["file"]["file_data"] == CLIP_RECORD | {"mime": "video/mp4"} and question["text"] == "Which?"


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
