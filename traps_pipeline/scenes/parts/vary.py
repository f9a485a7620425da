"""Declare fields of a family's `Params`, each with the range it is drawn from.

    @dataclass(frozen=True)
    class Params:
        direction: int = one_of(-1, 1)
        ball_colour: str = PLAY_COLOURS()
        wall_colour: str = PLAY_COLOURS()
        rough: bool = hidden(False, True)
        speed_m_s: float = between(0.50, 0.66)

    PLAY_COLOURS = apart("red", "green", "blue")  # before the class: colours that differ from each other

`draw_params(Params, rng)` draws the fields in their order; a field may depend on those before it only. So a hidden
element that depends on nothing is as likely whatever is seen. `twins(p)` changes the hidden element.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, make_dataclass, replace
from functools import cache
from typing import Any, TypeVar, get_type_hints

import numpy as np
from pydantic import TypeAdapter, ValidationError

from traps_pipeline.scenes.physics.kit import READER_KEY, distinct_colours, uniform

Drawn = dict[str, Any]  # name -> value: what is drawn so far
Draw = Callable[[np.random.Generator, Drawn], Any]
Count = int | str | Callable[[Mapping[str, Any]], int]
Params = TypeVar("Params")

_HOW, _COUNT, _HIDDEN = "how", "count", "hidden"  # keys of a field's metadata
_RANGE, _VALUES = "range", "values"  # what is drawn: bounds of a number, or all values
_LONGER = "longer"  # the values, where a draw asks for longer rows; key of what is drawn so far if it does


# --- one field --------------------------------------------------------------------------------------------------------


def drawn_by(draw: Draw, **metadata: Any) -> Any:
    """Return a field that `draw(rng, so_far)` draws, where no other function does.

    `so_far` holds the fields above by name. `draw` may put further values into it for fields below: those are not
    stored with the parameters. metadata: for `check`, the bounds (`range`) or the possible values (`values`); `longer`,
    those of longer rows, or true if `draw` itself heeds `is_longer(so_far)`; `about`, in words how it draws.
    """
    return field(metadata={_HOW: draw, **metadata})


def between(low: float, high: float) -> Any:
    """Return a field: a float between two bounds, rounded to 0.0001."""
    return drawn_by(lambda rng, so_far: uniform(rng, low, high), range=(low, high))


def several_between(count: Count, low: float, high: float) -> Any:
    """Return a field: a tuple of floats between two bounds. count: their number, or the drawn field that holds it."""
    return drawn_by(
        lambda rng, so_far: tuple(uniform(rng, low, high) for _ in range(_number(count, so_far))), range=(low, high)
    )


def one_of(*values: Any, longer: tuple[Any, ...] = ()) -> Any:
    """Declare a parameter that is drawn from given values, each equally likely.

    longer: the values instead, where a draw asks for longer rows.
    """

    def draw(rng: np.random.Generator, so_far: Drawn) -> Any:
        pool = longer if longer and is_longer(so_far) else values
        return pool[int(rng.integers(len(pool)))]

    return drawn_by(draw, values=values, longer=longer)


def chance(share: float) -> Any:
    """Return a boolean field that is true with this probability."""
    return drawn_by(lambda rng, so_far: bool(rng.random() < share), about=f"true in {share:.0%} of draws")


def facing(low: float, high: float) -> Any:
    """Return a field: a camera's azimuth, turned towards where things come from. Needs a field `direction` above it."""
    about = f"90 - direction * ({low} to {high})"
    return drawn_by(lambda rng, so_far: 90 - so_far["direction"] * uniform(rng, low, high), about=about)


def in_front(low: float, high: float) -> Any:
    """Return a field: a camera's azimuth (degrees) off the front, for any direction."""
    return drawn_by(lambda rng, so_far: 90 + uniform(rng, low, high), about=f"90 + ({low} to {high})")


# --- fields that are drawn together -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Group:
    """Fields that are drawn together, where the first stands. A call gives one field.

    draw(rng, so_far, count): as many values as the group's fields take, in the order of the fields.
    """

    draw: Callable[[np.random.Generator, Drawn, int], Sequence[Any]]
    values: tuple[Any, ...] | None = None  # all that it draws from, where that can be said
    about: str | None = None  # how it draws, in words

    def __call__(self, count: Count | None = None) -> Any:
        """Return a field with a value of the group, or a tuple of `count` of them."""
        return field(metadata={_HOW: self, _COUNT: count, _VALUES: self.values})


def apart(*pool: str, fits: Callable[..., bool] | None = None) -> Group:
    """Return distinct colours of a pool, drawn again until `fits(*colours)`."""

    def draw(rng: np.random.Generator, so_far: Drawn, count: int) -> Sequence[str]:
        while True:
            colours = distinct_colours(rng, count, pool)
            if fits is None or fits(*colours):
                return colours

    return Group(draw, pool)


def shuffled(*values: Any, without: str | None = None) -> Group:
    """Return a group of different values in random order, without that of a field."""

    def draw(rng: np.random.Generator, so_far: Drawn, count: int) -> Sequence[Any]:
        pool = [value for value in values if without is None or value != so_far[without]]
        return [pool[int(i)] for i in rng.permutation(len(pool))[:count]]

    return Group(draw, values)


def together(draw: Callable[[np.random.Generator, Drawn], Sequence[Any]]) -> Group:
    """Return a group of fields whose values `draw(rng, so_far)` gives in order."""
    return Group(lambda rng, so_far, count: draw(rng, so_far), about=draw.__doc__)


# --- the hidden element -----------------------------------------------------------------------------------------------


def hidden(*values: Any) -> Any:
    """Declare the parameter of the hidden element, drawn from given values apart from all others."""
    return _hidden(lambda so_far: values)


def hidden_index(of: str) -> Any:
    """Return the field of the hidden element: an index of the tuple in field `of`."""
    return _hidden(lambda so_far: range(len(so_far[of])))


def _hidden(values: Callable[[Mapping[str, Any]], Sequence[Any]]) -> Any:
    def draw(rng: np.random.Generator, so_far: Drawn) -> Any:
        choices = values(so_far)
        return choices[int(rng.integers(len(choices)))]

    return field(metadata={_HOW: draw, _HIDDEN: values})


def hidden_field(params: type) -> str | None:
    """Return the hidden element's name, None if none. Raises TypeError if several."""
    names = [member.name for member in fields(params) if _HIDDEN in member.metadata]
    if len(names) > 1:
        raise TypeError(f"{params.__module__}: several hidden elements {names}; a scene has one")
    return names[0] if names else None


def twins(p: Any) -> list[Any]:
    """Return the scene with every other value of its hidden element. Raises TypeError."""
    name = hidden_field(type(p))
    if name is None:
        raise TypeError(f"{type(p).__module__}: no field of Params is `hidden(...)`, so there are no twins")
    values = {member.name: member for member in fields(p)}[name].metadata[_HIDDEN](vars(p))
    return [replace(p, **{name: value}) for value in values if value != getattr(p, name)]


def with_field(params: type, name: str, kind: Any) -> type:
    """Return the class with a last field, None by default, that is not drawn."""
    new_field = field(
        default=None, metadata={READER_KEY: lambda value: None if value is None else kind.from_record(value)}
    )
    new_class = make_dataclass(params.__name__, [(name, kind | None, new_field)], bases=(params,), frozen=True)
    new_class.__module__, new_class.__doc__ = params.__module__, params.__doc__
    return new_class


# --- values from a file -----------------------------------------------------------------------------------------------


def check(p: Any) -> None:
    """Raise ValueError naming the first parameter of a wrong type or far out of range.

    A number may lie outside of its range by the width of the range, as a correction may need.
    """
    types = _types(type(p))
    for member in fields(p):
        value = getattr(p, member.name)
        try:
            types[member.name].validate_python(value, strict=True)
        except ValidationError as error:
            raise ValueError(f"parameter {member.name} is {_short_repr(value)}: {error.errors()[0]['msg']}") from None
        for element in _members(value):
            if isinstance(element, float) and not np.isfinite(element):
                raise ValueError(f"parameter {member.name} is {_short_repr(value)}; it must be finite")
            _check_member(p, member, element)


@cache
def _types(params: type) -> Mapping[str, TypeAdapter[Any]]:
    return {name: TypeAdapter(kind) for name, kind in get_type_hints(params).items()}


def _check_member(p: Any, each: Field[Any], value: Any) -> None:
    if bounds := each.metadata.get(_RANGE):
        low, high = bounds
        if not low - (high - low) <= value <= high + (high - low):
            raise ValueError(f"parameter {each.name} is {_short_repr(value)}; it is drawn from {low} to {high}")
    hidden_values = each.metadata.get(_HIDDEN)
    values = tuple(hidden_values(vars(p))) if hidden_values else each.metadata.get(_VALUES)
    difficulty = getattr(p, "difficulty", None)
    if difficulty is not None and difficulty.longer and isinstance(each.metadata.get(_LONGER), tuple):
        values = each.metadata[_LONGER] or values
    if values is not None and value not in values:
        raise ValueError(f"parameter {each.name} is {_short_repr(value)}; it is one of {', '.join(map(str, values))}")


def _members(value: Any) -> list[Any]:
    """Return the values in nested tuples, or the value itself."""
    return [member for item in value for member in _members(item)] if isinstance(value, tuple) else [value]


def _short_repr(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:60]}..."


# --- all fields -------------------------------------------------------------------------------------------------------


def is_longer(so_far: Mapping[str, Any]) -> bool:
    """Return whether the draw asks for longer rows."""
    return _LONGER in so_far


def can_be_longer(params: type) -> bool:
    """Return whether some field has longer ranges."""
    return any(member.metadata.get(_LONGER) for member in fields(params))


def draw_params(params: type[Params], rng: np.random.Generator, longer: bool = False) -> Params:
    """Draw a scenario's parameters; defaults stay. Raises TypeError without a range.

    longer: draw from the longer ranges.
    """
    so_far: Drawn = {_LONGER: True} if longer else {}
    members = fields(params)  # type: ignore[arg-type]
    for member in members:
        if member.name in so_far or member.default is not MISSING:
            continue
        draw = member.metadata.get(_HOW)
        if draw is None:
            raise TypeError(
                f"{params.__module__}: Params.{member.name} has no range; write it as `= between(low, high)`"
            )
        if isinstance(draw, Group):
            so_far |= _group_values(draw, members, rng, so_far)
        else:
            so_far[member.name] = draw(rng, so_far)
    return params(**{member.name: so_far[member.name] for member in members if member.name in so_far})


def _group_values(group: Group, members: Sequence[Field[Any]], rng: np.random.Generator, so_far: Drawn) -> Drawn:
    counts = {member.name: member.metadata[_COUNT] for member in members if member.metadata.get(_HOW) is group}
    numbers = {name: 1 if count is None else _number(count, so_far) for name, count in counts.items()}
    values = list(group.draw(rng, so_far, sum(numbers.values())))
    field_values: Drawn = {}
    for name, number in numbers.items():
        member_values, values = values[:number], values[number:]
        field_values[name] = member_values[0] if counts[name] is None else tuple(member_values)
    return field_values


def _number(count: Count, so_far: Mapping[str, Any]) -> int:
    if callable(count):
        return count(so_far)
    return so_far[count] if isinstance(count, str) else count
