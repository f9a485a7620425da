"""Private names of libraries that the package uses: each is listed with its reason, each library is bounded."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator

import pytest

from tests.conftest import ROOT
from tests.test_rooms import files, imported

# What is used, as "MODULE NAME", and why nothing public does. An underscore makes a name private; so does a module of
# a library whose documentation does not have it.
UNDOCUMENTED = ("litellm", "dagster_postgres", "dagster_ray", "dagster_webserver", "transformers.models")
IMPORTS = {
    "dagster._core.definitions.selector JobSubsetSelector": "runs on a cluster are made without its GraphQL server",
    "dagster._core.launcher WorkerStatus": "what `check_run_worker_health` of a launcher returns",
    "dagster._core.storage.base_storage DagsterStorage": "a storage of one's own has no public base",
    "dagster._core.storage.cloud_storage_compute_log_manager TruncatingCloudStorageComputeLogManager": "so of logs",
    "dagster._core.storage.compute_log_manager ComputeIOType": "named in the signatures of that base",
    "dagster._core.storage.event_log SqliteEventLogStorage": "its SQLite storage, with connections that are kept",
    "dagster._core.storage.local_compute_log_manager IO_TYPE_EXTENSION": "where a run's own host has its logs",
    "dagster._core.storage.local_compute_log_manager LocalComputeLogManager": "where a run's own host has its logs",
    "dagster._core.storage.runs SqliteRunStorage": "its SQLite storage, with connections that are kept",
    "dagster._core.storage.sqlite_storage DagsterSqliteStorage": "its SQLite storage, with connections that are kept",
    "dagster._core.workspace.context WorkspaceProcessContext": "pages behind a guard; runs on a cluster",
    "dagster._core.workspace.context WorkspaceRequestContext": "type of what the former makes",
    "dagster._core.workspace.load_target ModuleTarget": "where the former finds the stages",
    "dagster._core.workspace.load_target WorkspaceFileTarget": "where the former finds the stages",
    "dagster._serdes ConfigurableClass": "`dagster.yaml` makes only such classes",
    "dagster._serdes ConfigurableClassData": "what such a class is made from",
    "dagster_postgres DagsterPostgresStorage": "the storage that hosts share; no documentation has the class itself",
    "dagster_postgres.utils DagsterPostgresException": "what a database that is away raises",
    "dagster_ray RayRunLauncher": "its quoting is mended in a subclass",
    "dagster_webserver.app create_app_from_workspace_process_context": "Dagster's pages behind a guard",
    "litellm._internal_context is_internal_call": "its log of every call has no public switch",
    "litellm.integrations.custom_logger CustomLogger": "its price tables have no public switch",
    "litellm.llms.custom_httpx.http_handler AsyncHTTPHandler": "its clients get their transport there",
    "yaml._yaml CParser": "libyaml's parser alone, under a loader of ours that refuses tags",
}
# Attributes: name, library, and why. One that a file of ours assigns, too, is not seen.
ATTRIBUTES = {
    "_base_dir": ("dagster", "where Dagster's SQLite storage lies"),
    "_conn_string": ("dagster", "where Dagster's SQLite storage lies"),
    "_db_lock": ("dagster", "the SQLite storage makes a file's tables once"),
    "_engine": ("dagster-postgres", "its parts are to share one connection"),
    "_forward_hooks": ("torch", "a check sees that steering leaves no hook"),
    "_hidden_params": ("litellm", "a hook sets a response's price there"),
    "_initdb": ("dagster", "the SQLite storage makes a file's tables once"),
    "_initialized_dbs": ("dagster", "the SQLite storage makes a file's tables once"),
    "_launch_ray_job": ("dagster-ray", "its quoting is mended in a subclass"),
}
DISTRIBUTIONS = {"yaml": "pyyaml"}
OURS = {*sys.stdlib_module_names, "traps_pipeline"}


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


def private_imports(tree: ast.AST) -> Iterator[str]:
    """Private modules and names that a file imports, as "MODULE NAME", or "MODULE" where no name is taken from it."""
    for node in ast.walk(tree):
        match node:
            case ast.ImportFrom(module=str(module), names=names):
                taken = [(module, alias.name) for alias in names]
            case ast.Import(names=names):
                taken = [(alias.name, "") for alias in names]
            case ast.Attribute(value=ast.Call(args=[ast.Constant(value=str(module))]) as call, attr=name) if (
                ast.unparse(call.func).endswith("import_module")
            ):
                taken = [(module, name)]
            case ast.Call(func=function, args=[ast.Constant(value=str(module)), *_]) if ast.unparse(function).endswith(
                "import_module"
            ):
                taken = [(module, "")]
            case _:
                continue
        for module, name in taken:
            whole = f"{module}.{name}" if name else module
            undocumented = any(whole.startswith(f"{each}.") for each in UNDOCUMENTED)
            if module.split(".")[0] not in OURS and (undocumented or any(map(is_private, whole.split(".")))):
                yield f"{module} {name}".strip()


def defined(tree: ast.AST) -> set[str]:
    """Names of functions, variables and attributes that a file defines."""
    own = set[str]()
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
                own.add(name)
            case ast.Attribute(attr=name, ctx=ast.Store(), value=ast.Name("self")) | ast.Name(name, ast.Store()):
                own.add(name)
    return own


def private_attributes(tree: ast.AST, own: set[str]) -> Iterator[str]:
    """Private attributes that a file takes from an object or a base class, but for those that are the project's own."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and is_private(node.attr):
            owner = ast.unparse(node.value)
            if owner not in OURS and (owner == "super()" or node.attr not in own):
                yield node.attr


def test_the_list_has_every_private_name_of_a_library_that_the_package_uses_and_no_other() -> None:
    known = files()
    trees = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in known.items()}
    imports, attributes = set[str](), set[str]()
    for name, tree in trees.items():
        imports |= {*private_imports(tree)}
        if {*private_attributes(tree, own := defined(tree))}:  # or of a base class in a file of ours that it imports
            bases = {module for _, module in imported(known[name].read_text(encoding="utf-8"), known)}
            attributes |= {*private_attributes(tree, own.union(*(defined(trees[base]) for base in bases)))}
    # A module that is imported as a whole for one of its names is listed by that name.
    imports -= {one for one in imports if any(each.startswith(f"{one} ") for each in imports)}
    assert imports == {*IMPORTS}
    assert attributes == {*ATTRIBUTES}


@pytest.mark.parametrize(
    ("source", "private"),
    [
        ("from dagster._core.launcher import WorkerStatus", "dagster._core.launcher WorkerStatus"),
        ("def late():\n    from numpy import _core", "numpy _core"),
        ("import pandas._libs as libs", "pandas._libs"),
        ("from litellm.llms.openai import chat", "litellm.llms.openai chat"),
        ("from transformers.models.qwen3_vl import modeling", "transformers.models.qwen3_vl modeling"),
        ("kept = import_module('litellm.caching').Cache", "litellm.caching Cache"),
        ("kept = importlib.import_module('dagster._utils')", "dagster._utils"),
    ],
)
def test_a_private_import_is_seen_in_every_form(source: str, private: str) -> None:
    assert private in {*private_imports(ast.parse(source))}


def test_public_and_own_names_are_not_taken_for_private_ones() -> None:
    public = "import os, litellm, dagster\nfrom transformers import AutoModel\nfrom traps_pipeline.models import _hook"
    own = "class A:\n    def _a(self): self._b = os._exit\n    def b(self): return self._a, self._b, self.__dict__"
    assert not [*private_imports(ast.parse(public))]
    assert not [*private_attributes(ast.parse(own), defined(ast.parse(own)))]


def test_a_private_attribute_of_an_object_or_of_a_base_class_is_seen() -> None:
    source = ast.parse("class A(B):\n    def _a(self): return super()._a, model._hooks, self._base")
    assert {*private_attributes(source, defined(source))} == {"_a", "_hooks", "_base"}


def test_every_library_of_the_list_has_an_upper_bound_and_its_reason_beside_it() -> None:
    modules = {each.partition(".")[0].split(" ")[0] for each in IMPORTS}
    libraries = {DISTRIBUTIONS.get(each, each.replace("_", "-")) for each in modules}
    libraries |= {library for library, _ in ATTRIBUTES.values()} | {"aiohttp", "transformers"}
    lines = (ROOT / "pyproject.toml").read_text(encoding="utf-8").partition("docs = [")[0].splitlines()
    for library in libraries:
        bounded = [number for number, line in enumerate(lines) if re.search(rf'"{library}>=[\d.]+,<[\d.]+"', line)]
        assert bounded, f"pyproject.toml: {library} has no upper bound, and its private names are used"
        for number in bounded:
            reasons = lines[number].partition("#")[2] or lines[number - 1].strip().startswith("#")
            assert reasons, f"pyproject.toml, line {number + 1}: a comment says why {library} is bounded"
