"""Sign a released folder with a key, in the OpenSSF's format, verifiable offline.

`model_signing` is an extra, and is imported only here. A signature by an elliptic key contains a random number, so it
is the only file of a release that differs between two builds.
"""

from importlib import import_module
from pathlib import Path
from typing import Any

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.extras import require_extra
from traps_pipeline.base.terminal import plain
from traps_pipeline.release.checksums import SIGNATURE


def _library() -> Any:
    require_extra("sign")
    return import_module("model_signing")


def sign(folder: Path, private_key: Path) -> Path:
    """Sign a folder with a PEM key; return the signature's path. Raises TrapsError."""
    library, path = _library(), folder / SIGNATURE
    try:
        config = library.signing.Config().use_elliptic_key_signer(private_key=private_key)
        config.set_hashing_config(_hashing_config(library, path)).sign(folder, path)
    except (ValueError, TypeError, OSError) as error:
        raise TrapsError(
            f"{private_key}: cannot sign ({plain(error)[:200]}); give a private elliptic key in PEM, e.g. of `openssl "
            "ecparam -name prime256v1 -genkey -noout -out KEY.pem`"
        ) from error
    return path


def signature_problem(folder: Path, public_key: Path) -> str:
    """Return what is wrong with a signature, if anything. Raises TrapsError."""
    library, path = _library(), folder / SIGNATURE
    if not path.is_file():
        raise TrapsError(f"{path}: is missing, so that there is nothing to verify; leave --key out")
    try:
        config = library.verifying.Config().use_elliptic_key_verifier(public_key=public_key)
        config.set_hashing_config(_hashing_config(library, path)).verify(folder, path)
    except (ValueError, TypeError, OSError) as error:
        return f"{SIGNATURE}: is not of this key over these files ({plain(error)[:300]})"
    return ""


def _hashing_config(library: Any, signature: Path) -> Any:
    return library.hashing.Config().set_ignored_paths(paths=[signature], ignore_git_paths=False)
