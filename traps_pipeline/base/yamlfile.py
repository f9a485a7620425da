"""Read YAML and JSON Lines strictly, or raise a sentence with file and line.

Anything that two readers could read differently (a duplicate key, `yes`, `1:30`, `010`, `.inf`) is refused.
"""

import json
import math
import re
from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import accumulate
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ValidationError

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.suggestions import did_you_mean
from traps_pipeline.base.terminal import plain

Model = TypeVar("Model", bound=BaseModel)
MAX_YAML_BYTES, MAX_LINE_BYTES = 4 * 2**20, 4 * 2**20
MAX_DEPTH, MAX_NODES, MAX_ALIASES = 40, 200_000, 200
MAX_SAID = 300  # characters of a complaint
_QUOTED = re.compile(r"'([\w./@-]{1,80})'")
_TAG = "tag:yaml.org,2002:"
_STRINGS = re.compile(r'"(?:[^"\\]|\\.)*"')
_STEPS = {ord("["): 1, ord("{"): 1, ord("]"): -1, ord("}"): -1}
_NO_BRACKETS = bytes({*range(256)} - {*_STEPS})


_SAFE: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # five times as fast, where libyaml is there


class _Strict(_SAFE):
    """A YAML 1.2 loader: no dates, sexagesimals, octals, `yes`/`no` or repeated keys."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012 - the loader's own way to say it

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        keys_so_far = set[str]()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.MarkedYAMLError(None, None, "a key is a word or a number", key.start_mark)
            if key.value in keys_so_far:
                raise yaml.MarkedYAMLError(None, None, f"{key.value!r} stands there twice", key.start_mark)
            keys_so_far.add(key.value)
        return super().construct_mapping(node, deep)


for _kind, _pattern, _first in (
    ("merge", r"<<", ["<"]),
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|false|True|False", list("tfTF")),
    ("int", r"[-+]?(0|[1-9][0-9]{0,17})", list("-+0123456789")),
    ("float", r"[-+]?(0|[1-9][0-9]{0,17})(\.[0-9]{0,30})?([eE][-+]?[0-9]{1,3})?", list("-+0123456789")),
):
    _Strict.add_implicit_resolver(f"{_TAG}{_kind}", re.compile(f"^(?:{_pattern})$"), _first)


def _float(loader: _Strict, node: yaml.ScalarNode) -> float:
    value = float(loader.construct_scalar(node))
    if not math.isfinite(value):
        raise yaml.MarkedYAMLError(None, None, f"{node.value[:40]} is no finite number", node.start_mark)
    return value


_Strict.add_constructor(f"{_TAG}float", _float)


def _check_events(content: str) -> None:
    """Raise MarkedYAMLError for a tag, and for too much depth, nodes or aliases."""
    nodes = aliases = 0
    anchors = list[bool]()  # for each collection around an event: whether it has an anchor
    for event in yaml.parse(content, Loader=_SAFE):
        if isinstance(event, yaml.CollectionEndEvent):
            anchors.pop()
        if not isinstance(event, yaml.NodeEvent):
            continue
        nodes += 1
        if isinstance(event, yaml.AliasEvent):
            aliases += 1
            if aliases > MAX_ALIASES or any(anchors):
                raise yaml.MarkedYAMLError(None, None, "too many aliases, or one inside an anchor", event.start_mark)
        elif (tag := getattr(event, "tag", None)) is not None:
            tag = str(tag).replace(_TAG, "!!")
            raise yaml.MarkedYAMLError(None, None, f"remove the tag {tag}: no value has one", event.start_mark)
        if isinstance(event, yaml.CollectionStartEvent):
            anchors.append(event.anchor is not None)
        if len(anchors) >= MAX_DEPTH or nodes > MAX_NODES:
            raise yaml.MarkedYAMLError(None, None, "nested too deeply, or too large", event.start_mark)


def read_yaml(path: Path) -> Any:
    """Return parsed YAML. Raises TrapsError with file, line and complaint."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise TrapsError(f"{path}: cannot be read ({error.strerror})") from error
    if len(content) > MAX_YAML_BYTES:
        raise TrapsError(f"{path}: not valid YAML (larger than {MAX_YAML_BYTES} bytes)")
    try:
        text = content.decode("utf-8")
        _check_events(text)
        value = yaml.load(text, _Strict)  # noqa: S506 - a safe loader, made stricter
        json.dumps(value, ensure_ascii=False).encode()  # halves of surrogate pairs
        return value
    except (yaml.YAMLError, ValueError, TypeError, RecursionError, OverflowError) as error:
        raise TrapsError(f"{path}: not valid YAML ({_complaint(error)}); correct the file") from error


def read_mapping(path: Path) -> dict[str, Any]:
    """Return parsed YAML that must be a mapping. Raises TrapsError."""
    data = read_yaml(path)
    if not isinstance(data, dict):
        raise TrapsError(f"{path}: must be a mapping of names, not {data!r:.60}; correct the file")
    return data


@contextmanager
def name_file_in_errors(path: Path) -> Iterator[None]:
    """Add the file to errors of the block that do not name it, with the line of the first word that they quote."""
    try:
        yield
    except TrapsError as error:
        text = str(error).removeprefix(f"{path}: ")
        if text.startswith(f"{path}:"):
            raise
        word = _QUOTED.search(text)
        raise TrapsError(f"{location_of(path, [], word[1] if word else '')}: {text}") from error


def location_of(path: Path, keys: Sequence[int | str], word: str = "") -> str:
    """Return `file:line` of the value below these keys, as far as they are there, or only the file.

    word: the value of a scalar, or the name or `id` of a mapping, somewhere in the file; the keys begin there.
    """
    try:
        nodes = {keys: (value, line) for keys, value, line in _nodes(yaml.compose(path.read_text("utf-8"), _SAFE))}
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        return str(path)
    named = (place for place, (value, _) in nodes.items() if word in (value, *place[-1:]))
    if (place := next(named, None) if word else () if nodes else None) is None:
        return str(path)
    place = place[:-1] if place[-1:] == ("id",) else place
    for key in map(str, keys):
        place = (*place, key) if (*place, key) in nodes else place
    return f"{path}:{nodes[place][1]}"


def _nodes(node: yaml.Node | None, *keys: str, line: int = 0) -> Iterator[tuple[tuple[str, ...], str, int]]:
    """Yield keys, value (of a scalar) and line of a node and of all below it."""
    if node is not None:
        yield keys, node.value if isinstance(node, yaml.ScalarNode) else "", line or node.start_mark.line + 1
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            yield from _nodes(value, *keys, str(key.value), line=key.start_mark.line + 1)
    elif isinstance(node, yaml.SequenceNode):
        for number, value in enumerate(node.value):
            yield from _nodes(value, *keys, str(number))


def _complaint(error: Exception) -> str:
    """Return a parser's complaint on one line."""
    mark = getattr(error, "problem_mark", None)
    location = f"line {mark.line + 1}: " if mark is not None else ""
    problem = getattr(error, "problem", None) or str(error)
    return location + plain(" ".join(problem.split()))[:MAX_SAID]


def read_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield a JSON Lines file's numbered non-empty lines, checked. Raises TrapsError."""
    for number, line in read_unchecked_lines(path):
        check_line(line, f"{path}:{number}")
        yield number, line


def read_unchecked_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield numbered non-empty lines; a reader passes those it uses to `check_line`. Raises TrapsError."""
    try:
        text = path.read_text(encoding="utf-8-sig")  # some editors and shells put a byte-order mark first
    except (OSError, UnicodeDecodeError) as error:
        raise TrapsError(f"{path}: cannot be read as lines of text ({plain(error)[:MAX_SAID]}); restore it") from error
    for number, line in enumerate(text.split("\n"), start=1):  # not splitlines: JSON may hold U+2028 as it is
        if line.strip():
            yield number, line


def check_line(line: str, where: str) -> None:
    """Raise TrapsError for ambiguous or unbounded JSON; ignore invalid JSON."""
    try:
        if len(line) > MAX_LINE_BYTES or _depth(line) > MAX_DEPTH:
            raise _Odd("too large, or nested too deeply")
        json.loads(line, object_pairs_hook=_require_unique, parse_constant=_finite, parse_float=_finite)
        if re.search(r"\\u[dD][89a-fA-F]", line):
            json.dumps(json.loads(line), ensure_ascii=False).encode()
    except UnicodeEncodeError:
        raise TrapsError(f"{where}: half of a surrogate pair stands in it; correct that line") from None
    except _Odd as error:
        raise TrapsError(f"{where}: {plain(error)[:MAX_SAID]}; correct that line") from None
    except ValueError as error:
        if "digits" in str(error):
            raise TrapsError(f"{where}: a number of thousands of digits; correct that line") from None


class _Odd(Exception):
    """A value that a line must not contain."""


def _require_unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    fields = dict(pairs)
    if len(fields) < len(pairs):
        names = [name for name, _ in pairs]
        raise _Odd(f"{next(name for name in names if names.count(name) > 1)!r} stands there twice")
    return fields


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise _Odd(f"{text[:40]} is no finite number")
    return value


def _depth(line: str) -> int:
    """Return the nesting depth of brackets outside strings (must be fast)."""
    unquoted = _STRINGS.sub("", line) if "\\" in line else "".join(line.split('"')[::2])
    brackets = unquoted.encode().translate(None, _NO_BRACKETS)
    return max(accumulate(map(_STEPS.__getitem__, brackets)), default=0)


def parse_yaml_model(
    model: type[Model],
    data: Any,
    path: Path,
    where: str = "",
    context: Mapping[str, Any] | None = None,
    *,
    entry: str = "",
    also: Sequence[str] = (),
) -> Model:
    """Validate parsed YAML. Raises TrapsError naming file, line, entry and field.

    entry: the name or `id` of the mapping in the file, if it is not the whole; also: names of fields that are taken
    off before.
    """
    try:
        instance = model.model_validate(data, context=context)
    except ValidationError as error:
        place = location_of(path, error.errors()[0]["loc"], entry)
        raise TrapsError(f"{place}{where and ': ' + where}: {faults_of(error, model, also)}") from error
    for field in _converted_values(data, instance):
        place = location_of(path, field.partition(":")[0].split("."), entry)
        raise TrapsError(f"{place}{where and ': ' + where}: {field}")
    return instance


def _converted_values(data: Any, validated: Any, name: str = "") -> Iterator[str]:
    """Yield values that a model converted to another type, and non-finite numbers."""
    if isinstance(validated, float) and not math.isfinite(validated):
        yield f"{name}: {validated} is no finite number"
    number = isinstance(validated, int | float) and not isinstance(validated, bool)
    if (number and isinstance(data, bool | str)) or (isinstance(validated, bool) and not isinstance(data, bool)):
        yield f"{name}: {data!r:.60} is no {'number' if number else 'true or false'}"
    fields = {}
    if isinstance(data, Mapping) and isinstance(validated, BaseModel):
        aliases = {info.alias or field: field for field, info in type(validated).model_fields.items()}
        fields = {key: (data[key], getattr(validated, str(aliases.get(key, key)), None)) for key in data}
    elif isinstance(data, Mapping) and isinstance(validated, Mapping):
        fields = {key: (data[key], validated[key]) for key in data if key in validated}
    elif isinstance(data, list | tuple) and isinstance(validated, list | tuple):
        fields = dict(enumerate(zip(data, validated, strict=False)))
    for key, (raw, value) in fields.items():
        yield from _converted_values(raw, value, f"{name}.{key}" if name else str(key))


def faults_of(error: ValidationError, model: type[BaseModel] | None = None, also: Sequence[str] = ()) -> str:
    """Return a validation error as `field: complaint`, with the nearest field of the model or of `also`."""
    parts = list[str]()
    for details in error.errors():
        place, kind, value = details["loc"], details["type"], details.get("input")
        place = place[1:] if place[:1] == ("own",) else place  # what a file has under other names
        if kind == "value_error":
            message = details["msg"].removeprefix("Value error, ")
        elif kind == "extra_forbidden":
            field_names = [] if model is None else [*_fields_at(model, place[:-1]), *also]
            message = f"there is no such key{did_you_mean(str(place[-1]), field_names)}"
        else:
            message = _COMPLAINTS.get(
                kind.removesuffix("_type").removesuffix("_parsing"), "must be of another kind, {given}"
            )
            given = "nothing stands there" if value in (None, {}) and kind != "missing" else f"not {value!r:.60}"
            message = message.format(given=given, **details.get("ctx", {}))
        field = ".".join(str(step) for step in place if step != "[key]")  # pydantic's word for a name itself
        parts.append(f"{field}: {message}" if field else message)
    return plain("; ".join(dict.fromkeys(parts)))[:MAX_SAID]


# By kind of pydantic's error, whose own sentences name Python's types.
_COMPLAINTS = {
    "missing": "is missing; add it",
    "json_invalid": "Invalid JSON: {error}",
    **dict.fromkeys(("dict", "mapping", "model"), "must be a mapping, a line `key: value` for each, {given}"),
    **dict.fromkeys(("list", "tuple"), "must be a list, as [a, b], {given}"),
    "string": "must be a text, {given}; write it in quotes",
    "bool": "must be true or false, {given}",
    "float": "must be a number, {given}",
    **dict.fromkeys(("int", "int_from_float"), "must be a whole number, {given}"),
    "greater_than": "must be above {gt}, {given}",
    "greater_than_equal": "must be at least {ge}, {given}",
    "less_than": "must be below {lt}, {given}",
    "less_than_equal": "must be at most {le}, {given}",
    "too_short": "must have {min_length} or more; add some, or leave the key out",
    "too_long": "must have {max_length} at most, {given}",
    "string_too_short": "must have {min_length} characters or more, {given}",
    "string_too_long": "must have {max_length} characters at most, {given}",
    "string_pattern_mismatch": "must be of the form {pattern}, {given}",
    **dict.fromkeys(("literal_error", "enum"), "must be one of {expected}, {given}"),
    **dict.fromkeys(("date", "date_from_datetime"), "must be a date, as 2026-11-21, {given}"),
}


def _fields_at(model: type[BaseModel], place: Sequence[int | str]) -> list[str]:
    """Return the field names of a model, or of its nested model at `place`, if any."""
    for step in place:
        field = model.model_fields.get(str(step))
        if field is None:  # a number in a list, a name in a mapping or of a union's member
            continue
        inner = [
            type_ for type_ in _types_in(field.annotation) if isinstance(type_, type) and issubclass(type_, BaseModel)
        ]
        if len(inner) != 1:
            return []
        model = inner[0]
    return [info.alias or name for name, info in model.model_fields.items()]


def _types_in(annotation: Any) -> Iterator[Any]:
    yield annotation
    for argument in get_args(annotation):
        yield from _types_in(argument)
