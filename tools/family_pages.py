"""Write a page for each scene family: words, parameters, certificates, and a picture of a released pair."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator, Sequence
from dataclasses import MISSING, Field, fields
from statistics import median
from typing import Any

import numpy as np

from tools.markdown import escaped, markdown_table, prose
from tools.pair_picture import pair_picture
from traps_pipeline.base.paths import SCENE_SPECS
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.scenes.certification.certificates import certificates_for, stored_evidence
from traps_pipeline.scenes.family_registry import families
from traps_pipeline.scenes.parts.vary import Group
from traps_pipeline.scenes.physics.kit import Family
from traps_pipeline.scenes.worlds.spec import SceneSpec

FOLDERS = sorted(path.parent for path in SCENE_SPECS.rglob("released/draws.json"))  # the benchmark, and extensions
UNITS = {"_rad_s": "rad/s", "_m_s": "m/s", "_n_m": "N/m", "_deg": "degrees", "_m": "m", "_s": "s"}
MANY = 8  # more values than these are not listed
# Evidence of which the lowest, or the highest, is the worst; of other numbers neither is.
LOW = (
    "margin_m least_visible_px order_frames referents_px referents_moving_s cause_moving_s entropy_bits accepted read_s"
)
HIGH = "ablation_px twin_px top_share unresolved closed_px closed_change_px"
WORST = dict.fromkeys(LOW.split(), min) | dict.fromkeys(HIGH.split(), max)
PAGE = """# {name}

Category `{category}` ({taxonomy}), {count} released scenarios, answers of type `{answer}`.
[All families](../families.md)

{about}

![{name}: control, void and twin]({name}.jpg)

`{first}`: {question}

## Questions

{questions}

Asides, which control and void answer:

{asides}

## Parameters

*Released*: the values in released records. *Meaning*: the comment in the code.

{parameters}

Parts of the [look](../scenes.md) that vary: {looks}.

## Certificates

Each released scenario earns these [certificates](../scenes.md#certificates). Evidence: the worst (or from lowest to
highest), and the median, over {count} records.

{certificates}
"""


def family_pages() -> dict[str, str | bytes]:
    """Return each page and picture by its path on the site: an index, and two files for a family."""
    records = [(folder, spec) for folder in FOLDERS for spec in load_released(folder).values()]
    pages, rows = dict[str, str | bytes](), list[tuple[str, ...]]()
    for family in families():
        released = [(folder, spec) for folder, spec in records if spec.family == family.name]
        pages[f"families/{family.name}.md"] = _page(family, [spec for _, spec in released])
        pages[f"families/{family.name}.jpg"] = pair_picture(*released[0])
        scene, link = _source(family)[0].splitlines()[0], f"[{family.name}](families/{family.name}.md)"
        rows.append((link, family.category, escaped(scene), family.answer_type, str(len(released))))
    head = "# Families\n\nFor everyone who reads results by family: what each scene shows, and what varies in it.\n\n"
    headings = ("family", "category", "scene", "answer", "released")
    return pages | {"families.md": f"{head}{markdown_table(headings, rows)}\n"}


def _page(family: Family, specs: Sequence[SceneSpec]) -> str:
    def bullets(texts: Sequence[str]) -> str:
        return "\n".join(f"- {escaped(text)}" for text in texts)

    return PAGE.format(
        **{"name": family.name, "category": family.category, "taxonomy": family.taxonomy, "answer": family.answer_type},
        **{"count": len(specs), "first": specs[0].scenario_id, "question": escaped(specs[0].question)},
        **{"about": prose(_source(family)[0]), "looks": ", ".join(family.looks) or "none"},
        **{"questions": bullets(family.questions), "asides": bullets(_asides(family))},
        parameters=markdown_table(("parameter", "unit", "drawn from", "released", "meaning"), [*_rows(family, specs)]),
        certificates=markdown_table(("certificate", "evidence", "promises"), [*_certificates(specs)]),
    )


def _source(family: Family) -> tuple[str, str]:
    """Return the docstring and the text of a family's file."""
    module = inspect.getmodule(family.params)
    assert module is not None, "a family's Params stand in its file"
    return inspect.getdoc(module) or "", inspect.getsource(module)


def _asides(family: Family) -> list[str]:
    """Return the templates of the asides: the questions in `asides=[...]` and in functions that are named there."""
    tree = ast.parse(_source(family)[1])
    (asides,) = [node.value for node in ast.walk(tree) if isinstance(node, ast.keyword) and node.arg == "asides"]
    names = {node.id for node in ast.walk(asides) if isinstance(node, ast.Name)}
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name in names]
    nodes = [node for part in (asides, *functions) for node in ast.walk(part)]
    parts = {id(value) for node in nodes if isinstance(node, ast.JoinedStr) for value in node.values}
    return [text for node in nodes if id(node) not in parts and (text := _template(node)).endswith("?")]


def _template(node: ast.AST) -> str:
    """Return a text as a template: the last name of each expression in braces."""
    if isinstance(node, ast.FormattedValue):
        return f"{{{re.findall('[A-Za-z_]{2,}', ast.unparse(node.value))[-1].lower()}}}"
    return str(node.value) if isinstance(node, ast.Constant) else "".join(map(_template, getattr(node, "values", ())))


def _rows(family: Family, specs: Sequence[SceneSpec]) -> Iterator[tuple[str, ...]]:
    """Yield each parameter: name, unit, what it is drawn from, what is released, the comment beside it."""
    text = _source(family)[1]
    (params,) = [node for node in ast.parse(text).body if isinstance(node, ast.ClassDef) and node.name == "Params"]
    nodes = {ast.unparse(node.target): node for node in params.body if isinstance(node, ast.AnnAssign)}
    worlds = [family.params_from(spec.params) for spec in specs]
    for member in fields(family.params):
        if member.default is not MISSING:
            continue  # look and difficulty, which every family has
        node = nodes[member.name]
        lines = text.splitlines()[node.lineno - 1 : node.end_lineno]
        comment = next((line.partition("  # ")[2] for line in lines if "  # " in line), "")
        unit = next((unit for suffix, unit in UNITS.items() if member.name.endswith(suffix)), "")
        released = sorted(
            {value for world in worlds for value in np.array(getattr(world, member.name)).ravel().tolist()}
        )
        is_list = len(released) <= MANY and not isinstance(released[0], float)
        span = _either(released) if is_list else f"{released[0]:g} to {released[-1]:g}"
        yield f"`{member.name}`", unit, _drawn(member, node, worlds), span, escaped(comment)


def _drawn(member: Field[Any], node: ast.AnnAssign, worlds: Sequence[Any]) -> str:
    """Return what a parameter is drawn from: a range, values, or in words how."""
    kept, how = member.metadata, member.metadata["how"]
    if "range" in kept:
        return "{:g} to {:g}".format(*kept["range"])
    if "hidden" in kept:
        values = dict.fromkeys(value for world in worlds for value in kept["hidden"](vars(world)))
        return f"{_either([*values])} (the hidden element)"
    if kept.get("values"):
        return _either(kept["values"]) + (f"; {_either(kept['longer'])} in longer rows" if kept.get("longer") else "")
    if about := kept.get("about") or (how.about if isinstance(how, Group) else how.__doc__):
        return escaped(about.splitlines()[0])
    functions = [part.body for part in ast.walk(node) if isinstance(part, ast.Lambda)]
    return f"`{ast.unparse(functions[0] if functions else node.value or node)}`"


def _either(values: Sequence[Any]) -> str:
    """Return values in a sentence: 'red, green or blue'."""
    *others, last = [escaped(str(value)) for value in values]
    return f"{', '.join(others)} or {last}" if others else last


def _certificates(specs: Sequence[SceneSpec]) -> Iterator[tuple[str, ...]]:
    """Yield name, promise and evidence of each certificate."""
    evidence = [stored_evidence(spec) for spec in specs]
    for certificate in certificates_for(specs[0].void_kind):
        numbers = list[str]()
        for name in [number.name for number in certificate.numbers]:
            values = [one[name] for one in evidence if type(one.get(name)) in (int, float)]
            if values:
                ends = [WORST[name](values)] if name in WORST else [min(values), max(values)]
                span = " to ".join(f"{end:g}" for end in dict.fromkeys(ends))
                numbers.append(
                    f"`{name}` {span} (median {median(values):g})".replace(" ", "&nbsp;").replace("&nbsp;(", " (")
                )
        yield f"`{certificate.name}`", "<br>".join(numbers), escaped(certificate.promises)
