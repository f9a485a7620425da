"""Private names of libraries are few, known, and held by upper bounds: a minor version may change them."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT

PACKAGE = ROOT / "traps_pipeline"
# Each private name of a library, with its library, the files that use it and why no public name will do.
PRIVATE = {
    "dagster._core.definitions.asset_checks.asset_check_evaluation": (
        *("dagster", "pipeline/history.py", "names the event that a check evaluates"),
    ),
    "dagster._core.definitions.source_asset": ("dagster", "pipeline/step.py", "hands on without an event"),
    "dagster._core.storage.noop_compute_log_manager": ("dagster", "pipeline/run.py", "keeps no output of steps"),
    "dagster._daemon": ("dagster", "pipeline/webserver.py", "runs as a process, as Dagster itself starts it"),
    "dagster._core.workspace.context": ("dagster", "pipeline/webserver.py", "serves"),
    "dagster._core.workspace.load_target": ("dagster", "pipeline/webserver.py", "serves"),
    "litellm._internal_context": ("litellm", "models/wire/api.py", "calls are not logged twice"),
    "litellm.integrations.custom_logger": ("litellm", "models/wire/api.py", "calls are not priced twice"),
    "litellm.llms.custom_httpx.http_handler": (
        "litellm",
        "models/wire/api.py",
        "calls leave through models/wire/httpx_transport.py",
    ),
    "response._hidden_params": ("litellm", "models/wire/api.py", "a price there keeps litellm from looking for one"),
    "module._forward_hooks": ("torch", "mechanism/adapter_checks.py", "whether steering leaves hooks behind"),
}


_MODULE = re.compile(r"[a-z]\w*(\.\w+)+")


def private_names(folder: Path) -> dict[str, set[str]]:
    """Private names of libraries in the modules below a folder, each with the files that use it.

    Counted are private modules, modules inside a library that are imported by name, and attributes with an underscore
    that this code does not define: on `self` nowhere, on `super()` at all, on anything else not in the same file.
    """
    trees = {path.relative_to(folder).as_posix(): ast.parse(path.read_text()) for path in folder.rglob("*.py")}
    defined = {name: set(_defined(tree)) for name, tree in trees.items()}
    everywhere = set().union(*defined.values())
    names: dict[str, set[str]] = {}
    for file, tree in trees.items():
        for node in ast.walk(tree):
            for name in [*_modules(node), *_attributes(node, defined[file], everywhere)]:
                names.setdefault(name, set()).add(file)
    return names


def _defined(tree: ast.AST) -> list[str]:
    names = []
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                names.append(name)
            case ast.Name(id=name, ctx=ast.Store()):
                names.append(name)
            case ast.Attribute(value=ast.Name(id="self" | "cls"), attr=name, ctx=ast.Store()):
                names.append(name)
    return names


def _modules(node: ast.AST) -> list[str]:
    match node:
        case ast.Import(names=aliases):
            modules = [alias.name for alias in aliases if _is_private(alias.name)]
        case ast.ImportFrom(module=str(module), level=0, names=aliases):
            modules = [module] if any(_is_private(f"{module}.{alias.name}") for alias in aliases) else []
        case ast.Constant(value=str(name)) if _MODULE.fullmatch(name) and _is_private(name):
            modules = [name]  # as in settings that name a class by its module
        case ast.Call(func=ast.Name(id=called) | ast.Attribute(attr=called), args=[ast.Constant(value=str(name))]):
            modules = [name] if called == "import_module" and "." in name else []
        case _:
            modules = []
    ours = {*sys.stdlib_module_names, PACKAGE.name}
    return [module for module in modules if module.partition(".")[0] not in ours]


def _is_private(name: str) -> bool:
    return any(part.startswith("_") for part in name.split("."))


def _attributes(node: ast.AST, here: set[str], everywhere: set[str]) -> list[str]:
    if not isinstance(node, ast.Attribute) or not node.attr.startswith("_") or node.attr.endswith("__"):
        return []
    owner = ast.unparse(node.value)
    own = {"self": everywhere, "cls": everywhere, "super()": set(), "os": {"_exit"}}.get(owner, here)
    return [] if node.attr in own else [f"{owner}.{node.attr}"]


@pytest.mark.slow
@pytest.mark.promise
def test_every_private_name_of_a_library_is_listed_with_its_files() -> None:
    assert private_names(PACKAGE) == {name: set(files.split()) for name, (_, files, _) in PRIVATE.items()}


def test_a_library_whose_private_names_are_used_has_an_upper_bound_with_its_reason() -> None:
    lines = (ROOT / "pyproject.toml").read_text().splitlines()
    # Of transformers no private module is imported: what its models' blocks are called with is as private.
    for library in {library for library, _, _ in PRIVATE.values()} | {"transformers"}:
        (line,) = (line for line in lines if re.search(rf'"{library}>=', line))
        lowest, highest = re.search(rf'"{library}>=([\d.]+),<([\d.]+)"', line).groups()  # type: ignore[union-attr]
        major, minor = map(int, lowest.split(".")[:2])
        # A GPU may want a later minor version of torch; none has renamed what is used of it.
        # Of transformers two minor versions pass the checks of an adapter.
        next_one = (major + 1,) if library == "torch" else (major, minor + 1 + (library == "transformers"))
        assert tuple(map(int, highest.split("."))) <= next_one, line
        assert "# private: " in line, line
