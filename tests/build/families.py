"""The page's scene family, added for one test: a fixture to import."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from tests.conftest import ROOT
from traps_pipeline.scenes import families as package
from traps_pipeline.scenes import family_registry as registry
from traps_pipeline.scenes.observe import family_asking

(PAGE,) = re.findall(r"^```python\n(.*?)^```$", (ROOT / "docs" / "scenes.md").read_text(), re.DOTALL | re.MULTILINE)


Add = Callable[..., None]


def forget() -> None:
    for cached in (registry.family_names, registry.get_family, registry.families, registry.fit_to_sample):
        cached.cache_clear()
    family_asking.cache_clear()


@pytest.fixture
def add(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Add]:
    """Adds a family file beside the others for one test: the page's, with some of its text replaced."""
    monkeypatch.setattr(package, "__path__", [*package.__path__, str(tmp_path)])
    added: list[str] = []

    def add(name: str, **changes: Sequence[str]) -> None:
        text = PAGE.replace('"plank_post"', f'"{name}"')
        for old, new in changes.values():
            assert old in text
            text = text.replace(old, new)
        (tmp_path / f"{name}.py").write_text(text)
        added.append(name)
        forget()

    yield add
    monkeypatch.undo()
    for name in added:
        sys.modules.pop(f"{package.__name__}.{name}", None)
    forget()
