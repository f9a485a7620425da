"""A variable that no client library can use is named before anything is asked."""

from __future__ import annotations

import os
from pathlib import Path

import certifi
import pytest

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.network import CERTIFICATES, PROXIES, check_network


@pytest.fixture(autouse=True)
def _plain_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.lower() in PROXIES or name in CERTIFICATES]:
        monkeypatch.delenv(name)


@pytest.mark.parametrize(
    ("variable", "value", "problem"),
    [
        ("HTTP_PROXY", "http://", "is no address of a proxy"),
        ("http_proxy", "http://proxy:port", "is no address of a proxy"),
        ("HTTPS_PROXY", "ftp://proxy:21", "is no address of a proxy"),
        ("HTTPS_PROXY", "http://proxy:0", "is no address of a proxy"),
        ("ALL_PROXY", "http://[::1", "is no address of a proxy"),
        ("ALL_PROXY", "http://a b:1", "is no address of a proxy"),
        ("ALL_PROXY", "socks4://proxy:1080", "is no address of a proxy"),
        ("SSL_CERT_FILE", "/nowhere/ca.pem", "names the file /nowhere/ca.pem, which is not there"),
        ("REQUESTS_CA_BUNDLE", "/nowhere/ca.pem", "names the file /nowhere/ca.pem, which is not there"),
        ("SSL_CERT_FILE", __file__, f"names the file {__file__}, which holds no certificates"),
        ("SSL_CERT_DIR", f"/:{__file__}", f"names the folder {__file__}, which is not there"),
    ],
)
def test_what_cannot_be_used_is_named_by_its_variable(
    variable: str, value: str, problem: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(variable, value)
    with pytest.raises(TrapsError) as caught:
        check_network()
    assert str(caught.value).startswith(f"{variable} {problem}")


def test_the_password_of_a_proxy_is_not_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HTTPS_PROXY", "http://me:s3cret-word@proxy:port")
    with pytest.raises(TrapsError) as caught:
        check_network()
    assert "s3cret" not in str(caught.value)


@pytest.mark.parametrize("value", ["http://proxy:3128", "proxy:3128", "https://me:pw@proxy", "http://[::1]:3128/"])
def test_a_proxy_and_certificates_that_are_there_are_fine(
    value: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HTTP_PROXY", value)
    monkeypatch.setenv("SSL_CERT_FILE", certifi.where())
    monkeypatch.setenv("SSL_CERT_DIR", str(tmp_path))
    assert check_network() == "HTTP_PROXY; certificates of SSL_CERT_FILE, SSL_CERT_DIR"
