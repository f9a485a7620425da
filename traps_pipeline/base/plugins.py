"""Find what installed packages add: scene families, and backends of models and judges.

A package names each in its entry points (docs/scenes.md, docs/models.md); nothing of it is imported before its use.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.suggestions import did_you_mean

Group = Literal["families", "models", "judges"]
KINDS: Mapping[Group, str] = {"families": "scene family", "models": "backend of models", "judges": "backend of judges"}


@dataclass(frozen=True)
class Plugin:
    """An object that an installed package adds under a name. package: its distribution and version."""

    group: Group
    name: str
    package: str
    entry_point: EntryPoint

    def load(self) -> Any:
        """Import it. Raises TrapsError naming the package, whatever its code raises."""
        try:
            return self.entry_point.load()
        except Exception as error:  # whatever foreign code raises
            raise self.error(f"cannot be loaded ({type(error).__name__}: {error})") from error

    def error(self, problem: str) -> TrapsError:
        """Return an error of this plugin, with the remedy."""
        distribution = self.package.partition(" ")[0]
        return TrapsError(
            f"{self.package}: {KINDS[self.group]} {self.name!r} ({self.entry_point.value}) {problem}; correct and "
            f"install it again, or `python -m pip uninstall {distribution}`"
        )


@cache
def plugins(group: Group) -> dict[str, Plugin]:
    """Return a group's plugins by name. Raises TrapsError if two packages add one name."""
    named: dict[str, Plugin] = {}
    for entry_point in entry_points(group=f"traps.{group}"):
        distribution = entry_point.dist
        package = f"{distribution.name} {distribution.version}" if distribution else entry_point.module
        plugin = Plugin(group, entry_point.name, package, entry_point)
        if (other := named.setdefault(plugin.name, plugin)).package != package:
            raise plugin.error(f"has the name of one of {other.package}")
    return named


def name_with_package(group: Group, name: str) -> str:
    """Return a name, with the package and version that add it if it is none of this project's own."""
    plugin = plugins(group).get(name)
    return f"{name} ({plugin.package})" if plugin else name


def require_known(name: str, group: Group, own: Collection[str]) -> str:
    """Return a backend's name. Raises ValueError if it is unknown, TrapsError if a package has one of ours."""
    known = [*own, *plugins(group)]
    if name in own and name in plugins(group):  # the package would stand in the keys of answers: all are asked again
        raise plugins(group)[name].error("has the name of a backend of this project")
    if name not in known:
        raise ValueError(
            f"{name!r} is none; known: {', '.join(known)}{did_you_mean(name, known)}; a package adds one by an "
            f"entry point of the group traps.{group}"
        )
    return name
