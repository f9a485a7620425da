"""Write the reference pages of tables, YAML fields and certificates, from what checks them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from tools.markdown import markdown_table

ROOT = Path(__file__).resolve().parents[1]
# Each file that people write, with the class that checks it.
YAML_FILES = {
    "An experiment": ("pipeline.experiment", "Experiment"),
    "study.yaml": ("storage.study", "Study"),
    "A model": ("models.registry.entries", "ModelEntry"),
    "A judge": ("models.registry.judges", "JudgeEntry"),
    "An account": ("models.registry.accounts", "Account"),
    "A correction": ("benchmark.corrections", "Correction"),
}
WORDS = {str: "text", int: "whole number", float: "number", bool: "true or false", Any: "any value", NoneType: "null"}


def certificates_page() -> str:
    """Return the page of the certificates: what each promises, does not promise and stores."""
    from traps_pipeline.scenes.certification.certificates import certificate_table

    head = (
        "# Certificates\n\nFor readers who ask why a void is unanswerable ([scenes](../scenes.md#certificates)): every "
        "certificate of a pair. Numbers in brackets depend on OpenGL."
    )
    return f"{head}\n\n{certificate_table()}\n"


def tables_page() -> str:
    """Return the page of the study's tables: rows, keys and columns."""
    from traps_pipeline.storage.tables import Table

    package = ROOT / "traps_pipeline"
    named = dict[str, Table[Any]]()
    for path in sorted([*package.rglob("*_rows.py"), package / "storage" / "benchmark_tables.py"]):
        module = import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
        for constant, table in vars(module).items():
            if isinstance(table, Table):
                where = " of a release" if "release" in path.parts else ""
                named[f"{table.name}{where}{', held out' if constant.startswith('HELD_OUT') else ''}"] = table
    head = (
        "# Tables\n\nFor everyone who reads `STUDY/tables`, exported files or a release: every table and its columns. "
        "A column in bold is part of the key; where *null* stands, a value may be missing.\n"
    )
    return "\n".join([head, *(_table(name, named[name]) for name in sorted(named))])


def _table(name: str, table: Any) -> str:
    by = (
        f" One file for each {', '.join(f'`{column}`' for column in table.partition_by)}." if table.partition_by else ""
    )
    rows = [
        (
            f"**`{column.name}`**" if column.name in table.key else f"`{column.name}`",
            f"{column.type_name}{' or *null*' * column.nullable}",
            column.doc,
        )
        for column in table.columns
    ]
    columns = markdown_table(("column", "type", "meaning"), rows)
    return f"## {name}\n\n{table.row[:1].upper()}{table.row[1:]}.{by}\n\n{columns}\n"


def yaml_page() -> str:
    """Return the page of YAML fields: type, default and meaning of each."""
    head = "# YAML fields\n\nFor everyone who writes an experiment: each field of the files that people write.\n"
    parts, waiting, seen = [head], [], set[type[BaseModel]]()
    for title, (module, name) in YAML_FILES.items():
        waiting.append((title, getattr(import_module(f"traps_pipeline.{module}"), name)))
    while waiting:
        title, model = waiting.pop(0)
        if model in seen:
            continue
        seen.add(model)
        fields = {name: field for name, field in model.model_fields.items() if name != "own"}
        waiting += [(nested.__name__, nested) for field in fields.values() for nested in _models(field.annotation)]
        doc = " ".join((model.__doc__ or "").split())
        rows = [
            (f"`{name}`", _type(field.annotation), _default(field), field.description or "")
            for name, field in fields.items()
        ]
        parts.append(f"## {title}\n\n{doc}\n\n{markdown_table(('field', 'type', 'default', 'meaning'), rows)}\n")
    return "\n".join(parts)


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the sections that a field may hold."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from _models(part)


def _type(annotation: Any) -> str:
    """Return a field's type in words."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _type(parts[0])
    if origin is Literal:
        return " or ".join(map(str, parts))
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(map(_type, parts)))
    if origin is dict:
        return f"map of {_type(parts[0])} to {_type(parts[1])}"
    if origin in (list, tuple):
        return f"list of {_type(parts[0])}"
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return f"[{annotation.__name__}](#{annotation.__name__.lower()})"
    return WORDS.get(annotation, getattr(annotation, "__name__", str(annotation)))


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if isinstance(value, BaseModel):
        return "its own defaults"
    return f"`{json.dumps(value, default=str)}`"
