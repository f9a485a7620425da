"""Register scene families by name: a file in `families` adds one, or an installed package (`base.plugins`).

A family that would spoil a benchmark is refused: an unknown category, a question that two families have, a hidden
element that is drawn depending on what is seen.
"""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
import re
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from traps_pipeline.base.digests import digest, file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.plugins import plugins
from traps_pipeline.protocol.datasets import CHAOTIC_CATEGORIES, EXTENSION_CATEGORIES, OCCLUSION_CATEGORIES
from traps_pipeline.scenes import families as package

if TYPE_CHECKING:
    from traps_pipeline.scenes.physics.kit import Family

CATEGORIES = {"occlusion": OCCLUSION_CATEGORIES + EXTENSION_CATEGORIES, "chaotic": CHAOTIC_CATEGORIES}


@cache
def family_names() -> tuple[str, ...]:
    """Return the names of all families, sorted; nothing is imported.

    Raises TrapsError if a package adds a family under a name of ours.
    """
    own = {module.name for module in pkgutil.iter_modules(package.__path__)}
    for name in own & plugins("families").keys():
        raise plugins("families")[name].error("has the name of a family of this project")
    return tuple(sorted(own | plugins("families").keys()))


@cache
def get_family(name: str) -> Family:
    """Return the family of that name.

    Raises KeyError for an unknown name, TrapsError if its file defines none, another name or an unknown category.
    """
    from traps_pipeline.scenes.physics.kit import Family

    if name not in family_names():
        raise KeyError(f"unknown family {name!r}; known: {', '.join(family_names())}")
    plugin = plugins("families").get(name)
    module = plugin.load() if plugin else importlib.import_module(f"{package.__name__}.{name}")
    family = getattr(module, "FAMILY", None)
    if not isinstance(family, Family):
        raise TrapsError(f"{_file(name)} defines no FAMILY = scene_family(...); write it, or take the file away")
    if family.name != name:
        raise TrapsError(
            f"{_file(name)} defines a family named {family.name!r}; give it the name of its file, {name!r}, or rename "
            "the file"
        )
    categories = CATEGORIES[family.taxonomy]
    if family.category not in categories:
        raise TrapsError(
            f"{_file(name)}: unknown category {family.category!r}; write one of the categories of {family.taxonomy} "
            f"families: {', '.join(categories)}"
        )
    return family


def family_digest(name: str) -> str:
    """Return the SHA-256 of a family's file, the text that drew its records; in a package, of all modules beside it."""
    plugin = plugins("families").get(name)
    module = plugin.entry_point.module if plugin else f"{package.__name__}.{name}"
    module_spec = importlib.util.find_spec(module)
    assert module_spec is not None and module_spec.origin is not None, f"{_file(name)} is a file"
    file = Path(module_spec.origin)
    is_in_package = plugin is not None and "." in module
    return digest([*map(file_digest, sorted(file.parent.glob("*.py")))]) if is_in_package else file_digest(file)


def added_digests() -> list[str]:
    """Return the digests of families that packages add, which decide clips and verdicts as our own code does."""
    return [family_digest(name) for name in sorted(plugins("families"))]


@cache
def families() -> tuple[Family, ...]:
    """Return all families by name. Raises TrapsError if two share a question template."""
    every_family = tuple(get_family(name) for name in family_names())
    owner_of: dict[str, str] = {}
    for family in every_family:
        for template in family.questions:
            owner = owner_of.setdefault(re.sub(r"\{\w+\}", "{}", template), family.name)
            if owner != family.name:
                raise TrapsError(
                    f"{_file(owner)} and {_file(family.name)} have one question template, {template!r}; "
                    "word it differently in the newer one"
                )
    return every_family


@cache
def fit_to_sample(name: str) -> Family:
    """Return a family after checking that scenarios may be drawn from it.

    Raises TrapsError if another family has its question, or its hidden element depends on what is seen.
    """
    from traps_pipeline.scenes.parts.independence import dependence

    families()
    family = get_family(name)
    dependent = dependence(family)
    if dependent is not None:
        raise TrapsError(
            f"{_file(name)}: the hidden element is drawn depending on what is seen: {dependent}; "
            "draw it from nothing but its own values, `hidden(...)`, and what is seen not from it"
        )
    return family


def _file(name: str) -> str:
    plugin = plugins("families").get(name)
    return f"{plugin.package}: {plugin.entry_point.module}.py" if plugin else f"scenes/families/{name}.py"
