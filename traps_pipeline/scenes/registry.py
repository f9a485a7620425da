"""Families by name. A family's module is imported when it is asked for; adding a file adds a family."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache

from traps_pipeline.scenes import families as package
from traps_pipeline.scenes.kit import Family


@cache
def family_names() -> tuple[str, ...]:
    """Names of all families, sorted; nothing is imported."""
    return tuple(sorted(module.name for module in pkgutil.iter_modules(package.__path__)))


@cache
def get_family(name: str) -> Family:
    """The family of that name. Raises KeyError with the known names."""
    if name not in family_names():
        raise KeyError(f"unknown family {name!r}; known: {', '.join(family_names())}")
    family = importlib.import_module(f"{package.__name__}.{name}").FAMILY
    if family.name != name:
        raise ValueError(f"scenes/families/{name}.py defines a family named {family.name!r}; they must agree")
    return family


@cache
def families() -> tuple[Family, ...]:
    """All families, in the order of their names."""
    return tuple(get_family(name) for name in family_names())
