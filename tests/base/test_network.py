"""A variable that no client library can use is named before anything is asked."""

from __future__ import annotations

import os
import re
from pathlib import Path

import certifi
import pytest

from tests.build.errors import raises
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.network import CERTIFICATES, PROXIES, check_network


@pytest.fixture(autouse=True)
def _plain_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.lower() in PROXIES or name in CERTIFICATES]:
        monkeypatch.delenv(name)


@pytest.mark.parametrize(
    ("variable", "value", "named"),
    [
        ("HTTP_PROXY", "http://", "http://HOST:PORT"),
        ("http_proxy", "http://proxy:port", "http://HOST:PORT"),
        ("HTTPS_PROXY", "ftp://proxy:21", "http://HOST:PORT"),
        ("HTTPS_PROXY", "http://proxy:0", "http://HOST:PORT"),
        ("ALL_PROXY", "http://[::1", "http://HOST:PORT"),
        ("ALL_PROXY", "http://a b:1", "http://HOST:PORT"),
        ("ALL_PROXY", "socks4://proxy:1080", "http://HOST:PORT"),
        ("SSL_CERT_FILE", "/nowhere/ca.pem", "/nowhere/ca.pem"),
        ("REQUESTS_CA_BUNDLE", "/nowhere/ca.pem", "/nowhere/ca.pem"),
        ("SSL_CERT_FILE", __file__, __file__),
        ("SSL_CERT_DIR", f"/:{__file__}", f" {__file__}"),
    ],
)
def test_what_cannot_be_used_is_named_by_its_variable(
    variable: str, value: str, named: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(variable, value)
    with raises(TrapsError, "base.network.check_network", variable, named):
        check_network()


def test_the_password_of_a_proxy_is_not_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HTTPS_PROXY", "http://me:s3cret-word@proxy:port")
    with raises(TrapsError, "base.network.check_network", "HTTPS_PROXY") as caught:
        check_network()
    assert "s3cret" not in str(caught.value)


@pytest.mark.parametrize("value", ["http://proxy:3128", "proxy:3128", "https://me:pw@proxy", "http://[::1]:3128/"])
def test_a_proxy_and_certificates_that_are_there_are_fine(
    value: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HTTP_PROXY", value)
    monkeypatch.setenv("SSL_CERT_FILE", certifi.where())
    monkeypatch.setenv("SSL_CERT_DIR", str(tmp_path))
    assert re.findall("[A-Z_]{9,}", check_network()) == ["HTTP_PROXY", "SSL_CERT_FILE", "SSL_CERT_DIR"]
