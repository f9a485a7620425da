"""Every regular expression of the package takes time in proportion to the text that it meets.

The expressions are found in the package's source, and each gets hostile texts made from its own structure. The comment
`# own text: REASON` beside an expression excuses it.
"""

from __future__ import annotations

import ast
import builtins
import importlib
import re
import signal
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from re import _compiler, _constants, _parser  # type: ignore[attr-defined]  # the standard library's own reader
from typing import Any

import pytest

import traps_pipeline
from traps_pipeline.base.redaction import redact
from traps_pipeline.base.terminal import escape_invisible, plain
from traps_pipeline.judging.panel import parse_vote
from traps_pipeline.judging.rules import read_statement
from traps_pipeline.models.reading.interpret import read_answer
from traps_pipeline.models.reading.judged_answers import is_correct

PACKAGE = Path(traps_pipeline.__file__).parent
FUNCTIONS = ("compile", "search", "match", "fullmatch", "split", "findall", "finditer", "sub", "subn")
REPEATS = (_constants.MAX_REPEAT, _constants.MIN_REPEAT, _constants.POSSESSIVE_REPEAT)
CHARACTERS = "a-_ \n.,:;=&/0A9\"'\\`*{[(<|%!é“"
SIZES, LIMIT_S = (64, 1024, 8192), 1.0
MANY = 64  # repetitions; fewer are bounded work at each place
MARK = re.compile(r"# own text: \w")


@dataclass(frozen=True)
class Expression:
    """An expression of the package, where it stands, and how it is applied."""

    place: str
    pattern: str
    flags: int
    method: str


class _Word(str):
    """A local value of an expression's pattern; its parts are words as well."""

    def __getattr__(self, name: str) -> _Word:
        return self

    def __getitem__(self, key: Any) -> _Word:  # type: ignore[override]
        return self


class _Namespace(defaultdict[str, Any]):
    """A module's names; an unknown one, which is local to a function, is a word."""

    def __missing__(self, name: str) -> Any:
        if hasattr(builtins, name):
            raise KeyError(name)
        return _Word("word")


def _methods(trees: dict[Path, ast.Module]) -> dict[str, set[str]]:
    """Return the methods that are taken of each name, in the whole package."""
    methods = dict[str, set[str]]()
    for tree in trees.values():
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.attr in FUNCTIONS:
                methods.setdefault(node.value.id, set()).add(node.attr)
    return methods


def _names(tree: ast.Module) -> dict[ast.Call, str]:
    """Return the name that each call's value gets, if it is assigned to one."""
    pairs = list[tuple[ast.expr, ast.expr]]()
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign):
            target, value = node.targets[0], node.value
            both = (target.elts, value.elts) if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple) else None
            pairs += zip(*both, strict=True) if both else [(target, value)]
    return {value: target.id for target, value in pairs if isinstance(target, ast.Name) and isinstance(value, ast.Call)}


@cache
def expressions() -> tuple[Expression, ...]:
    trees = {path: ast.parse(path.read_text("utf-8")) for path in sorted(PACKAGE.rglob("*.py"))}
    methods, found = _methods(trees), list[Expression]()
    for path, tree in trees.items():
        if "import re\n" not in (source := path.read_text("utf-8")):
            continue
        module = importlib.import_module(".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts))
        lines, names, namespace = source.splitlines(), _names(tree), _Namespace(None, vars(module))
        for node in ast.walk(tree):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
                continue
            if not (isinstance(node.func.value, ast.Name) and node.func.value.id == "re"):
                continue
            if node.func.attr not in FUNCTIONS or any(map(MARK.search, lines[node.lineno - 2 : node.end_lineno])):
                continue
            place = f"{path.relative_to(PACKAGE)}:{node.lineno}"
            assert not isinstance(node.args[0], ast.Name) or node.args[0].id in vars(module), f"{place}: not to be read"
            value = eval(compile(ast.Expression(node.args[0]), place, "eval"), {}, namespace)
            value = value.decode("latin-1") if isinstance(value, bytes) else value  # a byte is as good as a character
            known_flags = [*node.args[1:], *(keyword.value for keyword in node.keywords)]
            flags = sum(
                int(eval(compile(ast.Expression(one), place, "eval"), {"re": re}))
                for one in known_flags
                if isinstance(one, ast.Attribute | ast.BinOp) and ast.unparse(one).startswith("re.")
            )
            used = methods.get(names.get(node, ""), {"search"}) if node.func.attr == "compile" else {node.func.attr}
            found += [Expression(place, value, flags, method) for method in sorted(used - {"compile"})]
    return tuple(found)


# --- hostile texts ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Tree:
    """Example texts for the parts of a parsed expression."""

    state: Any
    flags: int

    def characters(self, node: Any) -> list[str]:
        """Return some of the characters that a node of one character accepts."""
        part = _compiler.compile(_parser.SubPattern(self.state, [node]), self.flags)
        return [character for character in CHARACTERS if part.fullmatch(character)]

    def examples(self, items: Any) -> list[str]:
        """Return one text for each alternative of a sequence of nodes, at least one."""
        texts = [""]
        for node in items:
            parts = self.example(node)
            texts = [text + part for text in texts[:3] for part in parts[:3]] + [texts[0] + part for part in parts[3:]]
        return texts

    def example(self, node: Any) -> list[str]:
        kind, value = node
        if kind is _constants.LITERAL:
            return [chr(value)]
        if kind in (_constants.IN, _constants.ANY, _constants.NOT_LITERAL, _constants.CATEGORY):
            return self.characters(node)[:1] or [""]
        if kind is _constants.BRANCH:
            return [text for branch in value[1] for text in self.examples(branch)[:2]]
        if kind is _constants.SUBPATTERN:
            return self.examples(value[3])
        if kind is _constants.ATOMIC_GROUP:
            return self.examples(value)
        if kind in REPEATS:
            return [text * max(1, min(value[0], MANY)) for text in self.examples(value[2])]
        return [""]

    def repeats(self, items: Any, before: list[str]) -> Iterator[tuple[list[str], list[str], list[str]]]:
        """Yield for each repeat the texts before it, what it repeats, and what follows."""
        items = list(items)
        for place, node in enumerate(items):
            kind, value = node
            start = [text + part for text in before[:4] for part in self.examples(items[:place])[:6]]
            if kind in REPEATS:
                if value[1] is _constants.MAXREPEAT or value[1] > MANY:
                    inner = value[2]
                    units = self.examples(inner)
                    if len(inner) == 1 and inner[0][0] not in (_constants.SUBPATTERN, _constants.BRANCH):
                        some = self.characters(inner[0])
                        units = [*some[:6], *(f"{some[0]}{other}" for other in some[1:6])]
                    yield start, units, self.examples(items[place + 1 :])[:2]
                yield from self.repeats(value[2], start)
            for part in _parts(node):
                yield from self.repeats(part, start)


def _parts(node: Any) -> list[Any]:
    kind, value = node
    if kind is _constants.SUBPATTERN:
        return [value[3]]
    if kind is _constants.BRANCH:
        return list(value[1])
    if kind in (_constants.ASSERT, _constants.ASSERT_NOT):
        return [value[1]]
    return [value] if kind is _constants.ATOMIC_GROUP else []


def hostile_texts(expression: Expression) -> set[tuple[str, str, str]]:
    """Return texts in three parts: a beginning, what is repeated, and an end that fits, or does not."""
    parsed = _parser.parse(expression.pattern, expression.flags)
    tree = Tree(parsed.state, parsed.state.flags | expression.flags)
    texts = set[tuple[str, str, str]]()
    for starts, units, ends in tree.repeats(parsed, [""]):
        for start in dict.fromkeys(starts[:8]):
            for unit in dict.fromkeys(units):
                texts |= {(start, unit, end) for end in ("", "\x00", *ends[:1])}
                texts |= {("", start + unit, ""), ("", start, unit)}
        texts |= {("", unit, "\x00") for unit in units}
    return {text for text in texts if text[1]}


# --- time -------------------------------------------------------------------------------------------------------------


def cpu_seconds(work: Callable[[], object]) -> float:
    """Return the CPU seconds of a call, which is cut off soon after LIMIT_S."""

    def stop(*_: object) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, LIMIT_S)
    start = time.process_time()
    try:
        work()
    except TimeoutError:
        pass
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)
    return time.process_time() - start


def growth(work: Callable[[str], object], text: Callable[[int], str], sizes: tuple[int, ...], floor_s: float) -> str:
    """Return the CPU seconds where they grow twice as fast as the size, in the best of three; else nothing.

    floor_s: what a linear reader never takes, so that a loaded machine's disturbances count for nothing.
    """
    last, last_s = sizes[0], 0.0
    for size in sizes:
        read = partial(work, text(size))
        seconds, allowed_s = cpu_seconds(read), max(floor_s, 2 * size / last * last_s)
        if seconds > LIMIT_S:
            return f"over {LIMIT_S} s for {size:,} characters"
        if seconds > allowed_s:
            seconds = min(seconds, cpu_seconds(read), cpu_seconds(read))
            if seconds > allowed_s:
                return f"{seconds:.2f} s for {size:,} characters, {last_s:.3f} s for {last:,}"
        last, last_s = size, seconds
    return ""


def slow_text(expression: Expression) -> str:
    """Return a text that the expression takes too long over, and the seconds; empty if there is none."""
    compiled = re.compile(expression.pattern, expression.flags)
    apply: dict[str, Callable[[str], object]] = {
        "sub": partial(compiled.sub, ""),
        "subn": partial(compiled.sub, ""),
        "finditer": lambda text: list(compiled.finditer(text)),
    }
    for start, unit, end in sorted(hostile_texts(expression)):
        text = partial(lambda start, unit, end, size: start + unit * (size // len(unit)) + end, start, unit, end)
        if slow := growth(apply.get(expression.method) or getattr(compiled, expression.method), text, SIZES, 0.02):
            return f"{expression.place} .{expression.method}: {start[:40]!r} + {unit[:40]!r} * n + {end!r}: {slow}"
    return ""


@pytest.mark.parametrize("file", sorted({one.place.partition(":")[0] for one in expressions()}))
def test_no_expression_takes_longer_over_a_text_than_its_length_allows(file: str) -> None:
    assert not [slow for one in expressions() if one.place.startswith(f"{file}:") if (slow := slow_text(one))]


@pytest.mark.parametrize(
    ("pattern", "method"),
    [
        (r"\b[\w-]*(?:api[-_]?key|secret)", "sub"),
        (r"(?<=[.!?])\s+|\s*\n\s*", "split"),
        (r"\\+[nrt]", "search"),
        (r"(a+)+$", "match"),
        (r"key=(?=\S*\d)\w{6}", "sub"),
    ],
)
def test_an_expression_that_is_not_linear_is_found_by_its_own_structure(pattern: str, method: str) -> None:
    assert slow_text(Expression("here", pattern, re.IGNORECASE, method))


# --- what is no expression --------------------------------------------------------------------------------------------

ITEM = {"ground_truth": "left", "answer_type": "direction", "labels": ["left", "right"], "aliases": '{"red": "left"}'}
MARKS = ("<think>", "</think>")


def _read(outcome: str, regime: str, start: str = "") -> Callable[[str], object]:
    return lambda text: read_answer({"outcome": outcome, "text": start + text}, None, regime, thinking=MARKS)


READERS: dict[str, Callable[[str], object]] = {
    "redact": redact,
    "visible": escape_invisible,
    "plain": plain,
    "truncated": _read("truncated", "standard"),
    "truncated object": _read("truncated", "json", '{"reason": "x", '),
    "object": _read("answer", "json"),
    "rules": lambda text: read_statement(text, "Does it go left or right?"),
    "vote": lambda text: parse_vote("correctness", {"outcome": "answer", "text": text}, ITEM, None, text),
    "label": lambda text: is_correct(
        text, "left", "direction", ["left", "right"], {"red": "left", "to the left": "left"}
    ),
    "number": lambda text: is_correct(text, "3", "numeric", ["1", "3"], {}),
}
UNITS = (
    "\n",
    "\\",
    "\x1b",
    "☀\u200d",
    '"a": 1, ',
    '{"',
    "</think>",
    "&key=",
    "sk-hostile-0123456789 ",
    "answer: a ",
    "1 to ",
)
UNITS += ("left or ", "not left ")


@pytest.mark.parametrize("reader", READERS)
def test_reading_a_providers_text_takes_time_in_proportion_to_its_length(
    reader: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOSTILE_KEY", "sk-hostile-0123456789")
    texts = {unit: partial(lambda unit, size: unit * (size // len(unit)), unit) for unit in UNITS}
    assert not {
        unit: slow for unit, text in texts.items() if (slow := growth(READERS[reader], text, (8192, 131072), 0.4))
    }
