"""The environment's say in a connection: which proxy it names, which certificates, and what is wrong with them."""

from __future__ import annotations

import ipaddress
import os
import urllib.request
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

PROXY_SCHEMES = ("http", "https")  # SOCKS takes a package of its own, in every client library
CERTIFICATES = ("SSL_CERT_FILE", "SSL_CERT_DIR")


@dataclass(frozen=True)
class Proxy:
    """A proxy as the environment names it. variable: the variable's name, or "the system's settings"."""

    variable: str
    url: str

    @property
    def address(self) -> str:
        """Scheme, host and port, without the name and password that the URL may hold."""
        scheme, _, rest = self.url.partition("://")
        return f"{scheme}://{rest.rpartition('@')[2].partition('/')[0]}"

    @property
    def problem(self) -> str | None:
        """Return why no call can go through this proxy; None if one may."""
        if urlsplit(self.url).scheme in PROXY_SCHEMES:
            return None
        return (
            f"{self.variable} names the proxy {self.address}, and calls go through http:// and https:// proxies alone: "
            "name one of these there, or add the host to NO_PROXY"
        )


def is_loopback(host: str) -> bool:
    """Return whether a host name or address is this machine's own."""
    host = host.strip("[]").rstrip(".").lower()
    if host == "localhost" or host.endswith(".localhost"):
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def proxy_of(url: str) -> Proxy | None:
    """Return the proxy that the environment names for a URL; None for loopback addresses, whatever it says."""
    parts = urlsplit(url)
    host = parts.hostname or ""
    proxies = urllib.request.getproxies()
    address = proxies.get(parts.scheme) or proxies.get("all")
    if not address or is_loopback(host) or urllib.request.proxy_bypass(host):
        return None
    names = (f"{parts.scheme}_proxy", "all_proxy")
    variables = [name for name, value in os.environ.items() if name.lower() in names and value == address]
    variable = variables[0] if variables else "the system's settings"
    return Proxy(variable, address if "://" in address else f"http://{address}")


def certificate_problem() -> str | None:
    """Return the sentence about a variable that names certificates which are not there; None if there is none."""
    for name in CERTIFICATES:
        value = os.environ.get(name)
        if value and not Path(value).exists():
            return f"{name} names {value}, which does not exist: correct it, or unset it"
    return None
