"""The remedies that the package's errors name, read from its sources; those that tests carry out, read from tests."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

from tests.conftest import ROOT

PACKAGE = ROOT / "traps_pipeline"
VERBS = [
    "accept",
    "add",
    "allow",
    "change",
    "check",
    "choose",
    "clone",
    "close",
    "commit",
    "compare",
    "convert",
    "copy",
    "correct",
    "create",
    "declare",
    "delete",
    "discard",
    "download",
    "draw",
    "edit",
    "end",
    "evaluate",
    "export",
    "extract",
    "fill",
    "film",
    "fix",
    "free",
    "give",
    "import",
    "install",
    "keep",
    "leave",
    "let",
    "list",
    "log",
    "look",
    "lower",
    "make",
    "materialize",
    "mend",
    "mount",
    "move",
    "name",
    "open",
    "pass",
    "pick",
    "put",
    "raise",
    "rename",
    "remove",
    "render",
    "repair",
    "restore",
    "retry",
    "run",
    "save",
    "say",
    "see",
    "send",
    "set",
    "shorten",
    "show",
    "start",
    "stop",
    "take",
    "tell",
    "try",
    "turn",
    "unset",
    "update",
    "use",
    "wait",
    "write",
]
_VERB = rf"(?:{'|'.join(VERBS)})\b(?= |$)"
IN_AN_ERROR = re.compile(rf"(?:[;:.,(] |\bor |\band |\bthen |^){_VERB}(?! (?:is|has)\b)", re.IGNORECASE)
ELSEWHERE = re.compile(rf"(?:[;:] {_VERB}|\. {_VERB.replace('(?:', '(?i:', 1)}|, or {_VERB})")
# What is not said by an error: a help text, a heading, what a column means, a statement for a database.
KEYWORDS = {"help", "description", "title", "doc", "dash", "question", "promises"}
CALLS = {"add", "noun", "print", "note", "report", "execute", "query", "Column", "Arm", "stage", "Annotated", "Field"}
# What stands there is the remedy itself, for an error that is made of it.
WHOLE = {"_REMEDIES", "_REMEDIES.get", "require_own", "_require_whole", "refused"}


@dataclass(frozen=True, order=True)
class Sentence:
    """A sentence of the package that ends in a remedy; `{}` stands for what is only known when it is said."""

    file: str
    text: str
    line: int

    @property
    def where(self) -> str:
        """The file and line as an editor opens it, and the sentence."""
        return f"traps_pipeline/{self.file}:{self.line}: {self.text}"


def text_of(node: ast.AST) -> str | None:
    """The text of an expression that makes one, with `{}` for its values; None of one that does not."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else None
    if isinstance(node, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        left, right = text_of(node.left), text_of(node.right)
        return None if left is None and right is None else (left or "{}") + (right or "{}")
    return None


def called(node: ast.AST) -> str:
    """What is called, or assigned to; empty for anything else."""
    if isinstance(node, ast.Call):
        return ast.unparse(node.func)
    if isinstance(node, ast.Assign | ast.AnnAssign):
        target = node.targets[0] if isinstance(node, ast.Assign) else node.target
        return ast.unparse(target)
    return ""


def texts(node: ast.AST, within: tuple[ast.AST, ...] = ()) -> Iterator[tuple[ast.expr, str, tuple[ast.AST, ...]]]:
    """Each whole text in a tree, and those in its values; with the nodes around it, outermost first."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant):
            continue  # a docstring
        if isinstance(child, ast.expr) and (text := text_of(child)) is not None:
            yield child, text, within
            for value in ast.walk(child):
                if isinstance(value, ast.FormattedValue):
                    yield from texts(value, (*within, value))
        else:
            yield from texts(child, (*within, child))


def is_remedy(text: str, within: tuple[ast.AST, ...]) -> bool:
    """Whether a text of the package tells what to do against an error."""
    names = {name for node in within for name in (called(node), called(node).rpartition(".")[2])}
    if names & WHOLE:
        return IN_AN_ERROR.search(text) is not None
    if any(isinstance(node, ast.Raise) or _to_stderr(node) for node in within):
        return IN_AN_ERROR.search(text) is not None
    keywords = {node.arg for node in within if isinstance(node, ast.keyword)}
    return not (names & CALLS or keywords & KEYWORDS) and ELSEWHERE.search(text) is not None


def _to_stderr(node: ast.AST) -> bool:
    return called(node) == "print" and isinstance(node, ast.Call) and any(word.arg == "file" for word in node.keywords)


@cache
def remedies() -> tuple[Sentence, ...]:
    """Each sentence of the package with a remedy, once a file, where it stands first."""
    found: dict[tuple[str, str], Sentence] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        file = path.relative_to(PACKAGE).as_posix()
        for node, text, within in texts(ast.parse(path.read_text())):
            if len(text) > 11 and is_remedy(text, within):
                found.setdefault((file, text.strip()), Sentence(file, text.strip(), node.lineno))
    return tuple(sorted(found.values()))


@dataclass(frozen=True)
class CarriedOut:
    """A part of a sentence, and the test that carries it out."""

    text: str
    where: str

    def finds(self) -> list[Sentence]:
        """The sentences that have this part. `FILE.py | part` is about one of that file alone."""
        file, bar, part = self.text.rpartition(" | ")
        part = part if bar else self.text
        found = [one for one in remedies() if part in one.text and (not bar or one.file == file)]
        return [one for one in found if one.text == part] or found


def _given(test: ast.AST, name: str) -> Iterator[ast.expr]:
    """The values that `parametrize` gives to an argument of a test."""
    for mark in getattr(test, "decorator_list", ()):
        if not (isinstance(mark, ast.Call) and called(mark).endswith("parametrize")):
            continue
        names, cases = ast.literal_eval(mark.args[0]), mark.args[1]
        several = not isinstance(names, str)
        assert isinstance(cases, ast.List | ast.Tuple), "the cases stand in the decorator"
        for case in cases.elts if name in names else ():
            values = (
                case.args
                if isinstance(case, ast.Call) and called(case).endswith("param")
                else getattr(case, "elts", [])
            )
            yield values[list(names).index(name)] if several else case


def _said_in(test: ast.AST) -> Iterator[tuple[str, int]]:
    """The sentences that a test, or a function outside of tests, carries out, with their lines."""
    for node in ast.walk(test):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name):
            continue
        second = {"remedied": node.args[1:2], "refused": node.args[1:2]}
        for argument in (second | {"carries_out": node.args}).get(node.func.id, []):
            for value in _given(test, argument.id) if isinstance(argument, ast.Name) else [argument]:
                if (text := text_of(value)) is not None:
                    yield text, value.lineno


@cache
def carried_out() -> tuple[CarriedOut, ...]:
    """What the tests say that they carry out: the second argument of `remedied` and `refused`, all arguments of
    `carries_out`."""
    found = []
    for path in sorted((ROOT / "tests").rglob("*.py")):
        if "remed" not in (source := path.read_text()) or path.name in ("sentences.py", "remedied.py"):
            continue
        for part in ast.parse(source).body:
            found += [CarriedOut(text, f"{path.relative_to(ROOT)}:{line}") for text, line in _said_in(part)]
    return tuple(found)


@cache
def by_sentence() -> dict[Sentence, list[CarriedOut]]:
    """The tests that carry a sentence out."""
    found = defaultdict(list)
    for one in carried_out():
        for sentence in one.finds():
            found[sentence].append(one)
    return dict(found)
