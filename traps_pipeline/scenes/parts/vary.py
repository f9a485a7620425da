"""What varies in a family: a field of its `Params` and the range that the field is drawn from are one line.

    @dataclass(frozen=True)
    class Params:
        direction: int = one_of(-1, 1)
        ball_colour: str = PLAY()
        wall_colour: str = PLAY()
        rough: bool = hidden(False, True)
        speed_m_s: float = between(0.50, 0.66)

    PLAY = apart("red", "green", "blue")  # before the class: colours that differ from each other

`drawn(Params, rng)` draws the fields in the order in which they stand; a field may depend on those before it only. So a
hidden element that depends on nothing is as likely whatever is seen. `twins(p)` changes the hidden element.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, replace
from functools import cache
from typing import Any, TypeVar, get_type_hints

import numpy as np
from pydantic import TypeAdapter, ValidationError

from traps_pipeline.scenes.physics.kit import distinct_colours, uniform

Drawn = dict[str, Any]  # name -> value: what is drawn so far
Draw = Callable[[np.random.Generator, Drawn], Any]
Count = int | str | Callable[[Mapping[str, Any]], int]
Params = TypeVar("Params")

_HOW, _COUNT, _HIDDEN = "how", "count", "hidden"  # keys of a field's metadata
_RANGE, _VALUES = "range", "values"  # what is drawn: bounds of a number, or all values


# --- one field --------------------------------------------------------------------------------------------------------


def drawn_by(draw: Draw, **what: Any) -> Any:
    """Return a field that `draw(rng, so_far)` draws, for what no other function here says.

    `so_far` holds the fields above by name. `draw` may put further values into it for fields below: those are not
    stored with the parameters. what: for `check`, the bounds (`range`) or the possible values (`values`).
    """
    return field(metadata={_HOW: draw, **what})


def between(low: float, high: float) -> Any:
    """Return a float between two bounds, rounded to 0.0001."""
    return drawn_by(lambda rng, so_far: uniform(rng, low, high), range=(low, high))


def several_between(count: Count, low: float, high: float) -> Any:
    """Return a tuple of floats between two bounds. count: how many, or the name of the drawn value that says how
    many.
    """
    return drawn_by(
        lambda rng, so_far: tuple(uniform(rng, low, high) for _ in range(_number(count, so_far))), range=(low, high)
    )


def one_of(*values: Any) -> Any:
    """Return one of these values, each as often. Names of colours, -1 and 1, counts: `one_of(4, 5, 6)`."""
    return drawn_by(lambda rng, so_far: values[int(rng.integers(len(values)))], values=values)


def chance(share: float) -> Any:
    """Return a boolean field that is true in this share of the draws."""
    return drawn_by(lambda rng, so_far: bool(rng.random() < share))


def facing(low: float, high: float) -> Any:
    """Return azimuth (degrees) of a camera in front of the scene that stands by so many degrees, between two bounds,
    towards the side that things come from. Needs a field `direction` above it."""
    return drawn_by(lambda rng, so_far: 90 - so_far["direction"] * uniform(rng, low, high))


def in_front(low: float, high: float) -> Any:
    """Return azimuth (degrees) of a camera in front of the scene, turned by so many degrees whatever the direction."""
    return drawn_by(lambda rng, so_far: 90 + uniform(rng, low, high))


# --- fields that are drawn together -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Group:
    """Fields that are drawn together, at the place of the first of them. Calling the group gives one of its fields.

    draw(rng, so_far, count): as many values as the group's fields take, in the order of the fields.
    """

    draw: Callable[[np.random.Generator, Drawn, int], Sequence[Any]]
    values: tuple[Any, ...] | None = None  # all that it draws from, where that can be said

    def __call__(self, count: Count | None = None) -> Any:
        """Return a field with one value of the group, or with a tuple of `count` of them: a number, the name of the
        drawn value that says how many, or a function of the fields above."""
        return field(metadata={_HOW: self, _COUNT: count, _VALUES: self.values})


def apart(*pool: str, fits: Callable[..., bool] | None = None) -> Group:
    """Return colours of a pool that are not easily taken for each other; drawn again until `fits(*colours)`."""

    def draw(rng: np.random.Generator, so_far: Drawn, count: int) -> Sequence[str]:
        while True:
            colours = distinct_colours(rng, count, pool)
            if fits is None or fits(*colours):
                return colours

    return Group(draw, pool)


def shuffled(*values: Any, without: str | None = None) -> Group:
    """Return a group that draws different ones of these values, in random order; not the one that the field named
    `without` has."""

    def draw(rng: np.random.Generator, so_far: Drawn, count: int) -> Sequence[Any]:
        pool = [value for value in values if without is None or value != so_far[without]]
        return [pool[int(i)] for i in rng.permutation(len(pool))[:count]]

    return Group(draw, values)


def together(draw: Callable[[np.random.Generator, Drawn], Sequence[Any]]) -> Group:
    """Return fields whose values `draw(rng, so_far)` gives all at once, in the order of the fields."""
    return Group(lambda rng, so_far, count: draw(rng, so_far))


# --- the hidden element -----------------------------------------------------------------------------------------------


def hidden(*values: Any) -> Any:
    """Return the hidden element: one of these values, each as often, whatever else is drawn. Twins have the others."""
    return _hidden(lambda so_far: values)


def hidden_index(of: str) -> Any:
    """Return the hidden element as a place in the tuple that the field `of` has (which lane, which sector)."""
    return _hidden(lambda so_far: range(len(so_far[of])))


def _hidden(values: Callable[[Mapping[str, Any]], Sequence[Any]]) -> Any:
    def draw(rng: np.random.Generator, so_far: Drawn) -> Any:
        choices = values(so_far)
        return choices[int(rng.integers(len(choices)))]

    return field(metadata={_HOW: draw, _HIDDEN: values})


def hidden_field(params: type) -> str | None:
    """Name of the field that is the hidden element; None if there is none. Raises TypeError if there are several."""
    names = [each.name for each in fields(params) if _HIDDEN in each.metadata]
    if len(names) > 1:
        raise TypeError(f"{params.__module__}: several hidden elements {names}; a scene has one")
    return names[0] if names else None


def twins(p: Any) -> list[Any]:
    """Return the same scene with every other value of its hidden element. Raises TypeError if it has none."""
    name = hidden_field(type(p))
    if name is None:
        raise TypeError(f"{type(p).__module__}: no field of Params is `hidden(...)`, so there are no twins")
    values = {each.name: each for each in fields(p)}[name].metadata[_HIDDEN](vars(p))
    return [replace(p, **{name: value}) for value in values if value != getattr(p, name)]


# --- values from a file -----------------------------------------------------------------------------------------------


def check(p: Any) -> None:
    """Raise ValueError naming the first parameter whose value is not of its type or is far from all that is drawn. A
    number may lie outside of its range by the width of the range: a correction may move what a draw would not."""
    types = _types(type(p))
    for each in fields(p):
        value = getattr(p, each.name)
        try:
            types[each.name].validate_python(value, strict=True)
        except ValidationError as error:
            raise ValueError(f"parameter {each.name} is {_shown(value)}: {error.errors()[0]['msg']}") from None
        for one in _members(value):
            if isinstance(one, float) and not np.isfinite(one):
                raise ValueError(f"parameter {each.name} is {_shown(value)}; it must be finite")
            _check_member(p, each, one)


@cache
def _types(params: type) -> Mapping[str, TypeAdapter[Any]]:
    return {name: TypeAdapter(kind) for name, kind in get_type_hints(params).items()}


def _check_member(p: Any, each: Field[Any], value: Any) -> None:
    if bounds := each.metadata.get(_RANGE):
        low, high = bounds
        if not low - (high - low) <= value <= high + (high - low):
            raise ValueError(f"parameter {each.name} is {_shown(value)}; it is drawn from {low} to {high}")
    hides = each.metadata.get(_HIDDEN)
    values = tuple(hides(vars(p))) if hides else each.metadata.get(_VALUES)
    if values is not None and value not in values:
        raise ValueError(f"parameter {each.name} is {_shown(value)}; it is one of {', '.join(map(str, values))}")


def _members(value: Any) -> list[Any]:
    """Return the values in a tuple of tuples, or the value itself."""
    return [one for each in value for one in _members(each)] if isinstance(value, tuple) else [value]


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:60]}..."


# --- all fields -------------------------------------------------------------------------------------------------------


def drawn(params: type[Params], rng: np.random.Generator) -> Params:
    """Return parameters of one scenario; a field that has a default keeps it. Raises TypeError naming a field that has
    neither a range nor a default."""
    so_far: Drawn = {}
    members = fields(params)  # type: ignore[arg-type]
    for each in members:
        if each.name in so_far or each.default is not MISSING:
            continue
        how = each.metadata.get(_HOW)
        if how is None:
            raise TypeError(f"{params.__module__}: Params.{each.name} has no range; write it as `= between(low, high)`")
        if isinstance(how, Group):
            so_far |= _of_group(how, members, rng, so_far)
        else:
            so_far[each.name] = how(rng, so_far)
    return params(**{each.name: so_far[each.name] for each in members if each.name in so_far})


def _of_group(group: Group, members: Sequence[Field[Any]], rng: np.random.Generator, so_far: Drawn) -> Drawn:
    """Return values of all fields of a group."""
    counts = {each.name: each.metadata[_COUNT] for each in members if each.metadata.get(_HOW) is group}
    numbers = {name: 1 if count is None else _number(count, so_far) for name, count in counts.items()}
    values = list(group.draw(rng, so_far, sum(numbers.values())))
    values_drawn: Drawn = {}
    for name, number in numbers.items():
        chosen, values = values[:number], values[number:]
        values_drawn[name] = chosen[0] if counts[name] is None else tuple(chosen)
    return values_drawn


def _number(count: Count, so_far: Mapping[str, Any]) -> int:
    if callable(count):
        return count(so_far)
    return so_far[count] if isinstance(count, str) else count
