"""Check the proxy and certificate variables that client libraries read unasked."""

import ipaddress
import os
import ssl
import urllib.request
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from urllib.parse import urlsplit

from traps_pipeline.base.errors import TrapsError

PROXIES = ("http_proxy", "https_proxy", "all_proxy")  # in small or capital letters
_VARIABLES = tuple(name for low in (*PROXIES, "no_proxy") for name in (low, low.upper()))
PROXY_SCHEMES = ("http", "https")  # SOCKS takes a package of its own, in every client library
TLS_VARIABLES = ("SSL_CERT_FILE", "SSL_CERT_DIR")  # read by calls
CERTIFICATES = (*TLS_VARIABLES, "REQUESTS_CA_BUNDLE", "CURL_CA_BUNDLE")  # read by some library


@dataclass(frozen=True)
class Proxy:
    """A proxy, and the variable (or "the system's settings") that configures it."""

    variable: str
    url: str

    @property
    def address(self) -> str:
        """Scheme, host and port, without the name and password that the URL may hold."""
        scheme, _, authority = self.url.partition("://")
        return f"{scheme}://{authority.rpartition('@')[2].partition('/')[0]}"

    @property
    def problem(self) -> str | None:
        """The reason why no call can use this proxy; None if calls can."""
        if not _is_address(self.url):
            return f"{self.variable} is no address of a proxy: write it as http://HOST:PORT, or unset it"
        if urlsplit(self.url).scheme in PROXY_SCHEMES:
            return None
        return (
            f"{self.variable} names the proxy {self.address}, and calls go through http:// and https:// proxies alone: "
            "name one of these there, or add the host to NO_PROXY"
        )


def _is_address(url: str) -> bool:
    try:
        address = urlsplit(url)
        is_scheme = address.scheme in (*PROXY_SCHEMES, "socks5", "socks5h")
        return (
            is_scheme and bool(address.hostname) and (address.port is None or address.port > 0) and not url.split()[1:]
        )
    except ValueError:
        return False


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
    """Return the proxy configured for a URL; None for loopback addresses."""
    parts = urlsplit(url)
    return _proxy_of(parts.scheme, parts.hostname or "", tuple(os.environ.get(name) for name in _VARIABLES))


@lru_cache(maxsize=256)
def _proxy_of(scheme: str, host: str, _: tuple[str | None, ...]) -> Proxy | None:
    """Return the proxy for a host, cached while the variables keep their values."""
    proxies = urllib.request.getproxies()
    address = proxies.get(scheme) or proxies.get("all")
    if not address or is_loopback(host) or urllib.request.proxy_bypass(host):
        return None
    names = (f"{scheme}_proxy", "all_proxy")
    variables = [name for name, value in os.environ.items() if name.lower() in names and value == address]
    variable = variables[0] if variables else "the system's settings"
    return Proxy(variable, address if "://" in address else f"http://{address}")


def check_network() -> str:
    """Return the proxies and certificates that the environment configures, in words.

    Raises TrapsError that names the variable if its value is not a proxy's address or names missing certificates. A
    SOCKS proxy is refused if a call would go through it; loopback addresses bypass it.
    """
    proxies = [name for name, value in os.environ.items() if name.lower() in PROXIES and value]
    for name in proxies:
        value = os.environ[name]
        proxy = Proxy(name, value if "://" in value else f"http://{value}")
        if not _is_address(proxy.url):
            raise TrapsError(str(proxy.problem))
    if problem := certificate_problem(CERTIFICATES):
        raise TrapsError(problem)
    certificates = [name for name in CERTIFICATES if os.environ.get(name)]
    return f"{', '.join(proxies) or 'no proxy'}; certificates of {', '.join(certificates) or 'this machine'}"


def certificate_problem(variables: Sequence[str]) -> str | None:
    """Return what is wrong with the variables that name certificates, if anything."""
    for variable in variables:
        value = os.environ.get(variable)
        if value and (problem := _certificates_problem(variable, value)):
            return problem
    return None


def _certificates_problem(variable: str, value: str) -> str:
    if variable == "SSL_CERT_DIR":
        missing_folders = [folder for folder in value.split(os.pathsep) if not Path(folder).is_dir()]
        return (
            f"{variable} names the folder {missing_folders[0]}, which is not there: mend or unset it"
            if missing_folders
            else ""
        )
    if not Path(value).exists():
        return f"{variable} names the file {value}, which is not there: mend or unset it"
    try:
        if Path(value).is_file():
            ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_verify_locations(cafile=value)
    except (OSError, ValueError):  # ssl.SSLError is an OSError
        return f"{variable} names the file {value}, which holds no certificates that can be read: mend or unset it"
    return ""
