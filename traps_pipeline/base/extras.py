"""Declare the optional dependencies (`extras`), and name one that is missing."""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Literal, get_args

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.paths import IS_INSTALLED

ExtraName = Literal["api", "local", "nf4", "sign", "cluster", "ui", "web"]


@dataclass(frozen=True)
class Extra:
    """An optional dependency: its purpose, and the modules imported from it."""

    purpose: str
    modules: tuple[str, ...]


EXTRAS: Mapping[ExtraName, Extra] = {
    "api": Extra("asking models over the network", ("litellm", "mcp", "aiohttp")),
    "local": Extra("a model on this machine", ("torch", "torchvision", "transformers", "safetensors")),
    "nf4": Extra("quantisation nf4", ("bitsandbytes", "accelerate")),
    "sign": Extra("a signature", ("model_signing",)),
    "cluster": Extra("a study that hosts share", ("traps_cluster", "psycopg", "obstore")),
    "ui": Extra("Dagster's web server", ("dagster_webserver",)),
    "web": Extra("a page that listens", ("fastapi", "uvicorn")),
}


def install_line(name: ExtraName) -> str:
    """Return the command that installs an extra."""
    package = "traps-cluster" if name == "cluster" else f"traps-pipeline[{name}]"
    return f"python -m pip install '{package}'" if IS_INSTALLED else "make setup"


def find_missing(name: ExtraName, *modules: str) -> list[str]:
    """Return which modules of an extra (or only of these) are missing; import none."""
    return [module for module in modules or EXTRAS[name].modules if find_spec(module) is None]


def require_extra(name: ExtraName, *modules: str) -> None:
    """Raise TrapsError with the command to type unless an extra is installed."""
    if missing_modules := find_missing(name, *modules):
        raise TrapsError(_sentence(name, missing_modules))


def missing_extra_sentence(error: ModuleNotFoundError) -> str | None:
    """Return the sentence of `require_extra` for an ImportError; None outside all extras."""
    module = (error.name or "").partition(".")[0]
    names: tuple[ExtraName, ...] = get_args(ExtraName)
    return next((_sentence(name, [module]) for name in names if module in EXTRAS[name].modules), None)


def _sentence(name: ExtraName, absent: list[str]) -> str:
    verb = "is" if len(absent) == 1 else "are"
    return f"{EXTRAS[name].purpose} needs {' and '.join(absent)}, which {verb} not installed: `{install_line(name)}`"
