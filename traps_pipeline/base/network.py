"""Check what the environment says of the network: proxies and certificates, which every client library reads by itself.

A wrong variable would otherwise end in an error of a library, which names no variable, at each call.
"""

from __future__ import annotations

import os
import ssl
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import urlsplit

from traps_pipeline.base.errors import TrapsError

PROXIES = ("http_proxy", "https_proxy", "all_proxy")  # in small or capital letters
CERTIFICATES = ("SSL_CERT_FILE", "REQUESTS_CA_BUNDLE", "CURL_CA_BUNDLE", "SSL_CERT_DIR")


def check_network() -> str:
    """Return what the environment says of proxies and certificates, in words.

    Raises TrapsError, which names the variable, for a proxy that cannot be used and certificates that are not there.
    """
    proxies = [name for name, value in os.environ.items() if name.lower() in PROXIES and value]
    certificates = [name for name in CERTIFICATES if os.environ.get(name)]
    for problem in (*map(_proxy_problem, proxies), *map(_certificates_problem, certificates)):
        if problem:
            raise TrapsError(problem)
    return f"{', '.join(proxies) or 'no proxy'}; {', '.join(certificates) or 'the usual certificates'}"


def _proxy_problem(variable: str) -> str:
    value = os.environ[variable]
    try:
        address = urlsplit(value if "://" in value else f"http://{value}")
        is_address = bool(address.hostname) and (address.port is None or address.port > 0) and not value.split()[1:]
    except ValueError:
        is_address, address = False, urlsplit("")
    if not is_address or address.scheme not in ("http", "https", "socks5", "socks5h"):
        return f"{variable} is no address of a proxy: write it as http://HOST:PORT, or unset it"
    if address.scheme.startswith("socks") and find_spec("socksio") is None:
        return f"{variable} names a SOCKS proxy, which needs the package socksio: pip install socksio, or unset it"
    return ""


def _certificates_problem(variable: str) -> str:
    value = os.environ[variable]
    if variable == "SSL_CERT_DIR":
        gone = [folder for folder in value.split(os.pathsep) if not Path(folder).is_dir()]
        return f"{variable} names the folder {gone[0]}, which is not there: mend or unset it" if gone else ""
    if not Path(value).exists():
        return f"{variable} names the file {value}, which is not there: mend or unset it"
    try:
        if Path(value).is_file():
            ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_verify_locations(cafile=value)
    except (OSError, ValueError):  # ssl.SSLError is an OSError
        return f"{variable} names the file {value}, which holds no certificates that can be read: mend or unset it"
    return ""
