"""The stubs in typings/, which pyright believes, name what the libraries have."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

from tests.conftest import ROOT

pytestmark = pytest.mark.slow
FOLDER = ROOT / "typings"


def functions(stub: Path) -> Iterator[tuple[str, ast.FunctionDef]]:
    """The public functions of a stub and the methods of its public classes, by their dotted names."""
    for node in ast.parse(stub.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef):
            yield node.name, node
        elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from ((f"{node.name}.{own.name}", own) for own in node.body if isinstance(own, ast.FunctionDef))


STUBS = [path for path in sorted(FOLDER.rglob("*.pyi")) if path.parent.name != "mujoco" and [*functions(path)]]


@pytest.mark.parametrize("stub", STUBS, ids=lambda path: str(path.relative_to(FOLDER)))
def test_every_function_of_a_stub_takes_the_librarys_parameters(stub: Path) -> None:
    module = import_module(".".join(stub.relative_to(FOLDER).with_suffix("").parts))
    for name, declared in functions(stub):
        found: object = module
        for part in name.split("."):
            found = getattr(found, part)
        wanted = {argument.arg for argument in (*declared.args.args, *declared.args.kwonlyargs)}
        if callable(found) and not hasattr(found, "nin"):  # a ufunc has no signature
            assert wanted <= {*inspect.signature(found).parameters}, name
