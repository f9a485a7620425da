"""Read the table of recorded pairs that people bring: `pairs.csv` or `pairs.jsonl` (docs/recorded.md).

Times are seconds of the original file, so that they can be read off a player. A line that is wrong becomes a problem in
a sentence, and the others are read.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, field_validator, model_validator

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.yamlfile import check_line, faults_of, read_unchecked_lines
from traps_pipeline.scenes.worlds.spec import Slug, check_labels

TABLES = ("pairs.csv", "pairs.jsonl")
MAX_ROWS = 10_000
_VOIDS = ("void", "cut_s", "cover")
Text = Annotated[str, Field(min_length=1, max_length=2000)]
Seconds = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]


def _split(separator: str | None) -> BeforeValidator:
    return BeforeValidator(lambda value: [*map(str.strip, value.split(separator))] if isinstance(value, str) else value)


def _aliases(value: Any) -> Any:
    pairs = [part.partition("=") for part in value.split("|")] if isinstance(value, str) else []
    if not all(label for _, _, label in pairs):
        raise ValueError("write other=choice, with | between")
    return {other.strip(): label.strip() for other, _, label in pairs} or value


class Board(NamedTuple):
    """A board drawn over a part of the picture (px of the original as it is seen), between two times (s)."""

    from_s: Seconds
    to_s: Annotated[float, Field(gt=0)]
    x: Annotated[int, Field(ge=0)]
    y: Annotated[int, Field(ge=0)]
    width: Annotated[int, Field(ge=1)]
    height: Annotated[int, Field(ge=1)]


# One of each, or of two events one for either.
Boards = Annotated[list[Annotated[Board, _split(None)]], _split("|"), Field(max_length=2)]
Texts = Annotated[list[Text], _split("|")]


class RecordedPair(BaseModel):
    """A line of the table: a scenario, its clips, its words, and how its outcome is hidden."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    id: str = Field(pattern=Slug, max_length=80, description="as cars-0001")
    category: str = Field(pattern=r"^[\w .&()+-]+$", max_length=60, description="any, as traffic")
    control: Text = Field(description="path of a clip in the folder, whose outcome can be seen")
    void: Text | None = Field(default=None, description="path of a clip whose outcome cannot be known")
    cut_s: Seconds | None = Field(default=None, description="the void is the control up to this time")
    cover: Boards = Field(default=[], description="from_s to_s x y width height: the void's board")
    control_cover: Boards = Field(default=[], description="the same for a board that comes in the control")
    twin: Text | None = Field(default=None, description="path of a clip of another outcome, with the same void")
    twin_answer: Text | None = Field(default=None, description="its answer")
    two_events: Texts = Field(default=[], description="names of two events, each of which has a board and an answer")
    question: Text = Field(description="of both clips; {} stands for the name of one of two events")
    choices: Texts = Field(min_length=2, max_length=26, description="with | between")
    answer: Texts = Field(description="the right choice on the control")
    aliases: Annotated[dict[str, str], BeforeValidator(_aliases)] = Field(default={}, description="other=choice|..")
    ill_posed_question: Text | None = Field(default=None, description="question that the control cannot answer")
    start_s: Seconds = Field(default=0.0, description="where the clip begins in the file")
    end_s: Seconds | None = Field(default=None, description="where it ends")
    source: Text = Field(description="where the video is from")
    licence: Text = Field(description="SPDX id, or words")

    @field_validator("*")
    @classmethod
    def _printable(cls, value: Any) -> Any:
        texts = [value] if isinstance(value, str) else [*value] if isinstance(value, list | dict) else []
        if any(isinstance(text, str) and not text.isprintable() for text in texts):
            raise ValueError("holds a line break or another hidden character")
        return value

    @model_validator(mode="after")
    def _agrees(self) -> RecordedPair:
        check_labels(self.choices, self.aliases, [*self.answer, *filter(None, [self.twin_answer])])
        given = [name for name in _VOIDS if getattr(self, name) not in (None, [])]
        if len(given) != 1:
            raise ValueError(f"give one of {', '.join(_VOIDS)}, not {' and '.join(given) or 'none'}")
        if (self.twin is None) != (self.twin_answer is None) or self.twin_answer == self.answer[0]:
            raise ValueError("twin and twin_answer go together, and its answer is another one")
        if self.twin is not None and (self.void is not None or self.two_events):
            raise ValueError("twin goes with cut_s or one cover, where the two have one void")
        boards, end = [*self.cover, *self.control_cover], float("inf") if self.end_s is None else self.end_s
        if any(board.from_s >= board.to_s for board in boards):
            raise ValueError("a board is from_s to_s x y width height, with from_s before to_s")
        times = [self.cut_s, *(board.from_s for board in boards)]
        if end <= self.start_s or any(at is not None and not self.start_s <= at < end for at in times):
            raise ValueError("times lie between start_s and end_s, in seconds of the original file")
        n_events = 2 if self.two_events else 1
        if {len(self.answer), len(self.cover) or n_events, len(self.control_cover) or n_events} != {n_events}:
            raise ValueError("two_events have two answers and two boards, with | between, and a pair has one of each")
        if not self.two_events and self.ill_posed_question is None:
            raise ValueError("ill_posed_question: is missing; add it")
        if self.two_events and (given != ["cover"] or len({*self.two_events}) != 2 or "{}" not in self.question):
            raise ValueError("two_events are two names with | between, for {} in the question, and a cover for each")
        if self.two_events and max(b.x + b.width for b in boards[::2]) > min(b.x for b in boards[1::2]):
            raise ValueError("two_events stand side by side: name the left one first, with boards that do not overlap")
        return self


def read_pairs(folder: Path) -> tuple[list[RecordedPair], list[str]]:
    """Read the CSV of recorded pairs; return them and a sentence for each wrong line. Raises TrapsError without it."""
    tables = [path for name in TABLES if (path := folder / name).is_file()]
    if len(tables) != 1:
        raise TrapsError(
            f"{folder}: holds {'both' if tables else 'neither'} of {' and '.join(TABLES)}; write one of them"
        )
    pairs, problems = dict[str, RecordedPair](), list[str]()
    for number, row in _rows(tables[0]):
        if number > MAX_ROWS:
            raise TrapsError(f"{tables[0]}: has more than {MAX_ROWS:,} pairs; import it in parts")
        try:
            if isinstance(row, str):
                raise ValueError(row)
            pair = RecordedPair.model_validate(row)
            if pair.id in pairs:
                raise ValueError(f"id {pair.id!r} stands there twice")
            pairs[pair.id] = pair
        except ValueError as error:
            reason = faults_of(error, RecordedPair) if isinstance(error, ValidationError) else str(error)
            problems.append(f"{tables[0].name}:{number}: {reason}; correct that line")
    return [*pairs.values()], problems


def _rows(table: Path) -> Iterator[tuple[int, dict[str, Any] | str]]:
    """Yield line number and values of each row, or what is wrong; values left empty are left out. Raises TrapsError."""
    if table.suffix == ".jsonl":
        for number, line in read_unchecked_lines(table):
            try:
                check_line(line, "the line")
                row = json.loads(line)
            except (ValueError, TrapsError) as error:
                row = f"not JSON ({error})"
            yield number, row if isinstance(row, dict | str) else "is no JSON object"
        return
    try:
        text = io.StringIO(table.read_text(encoding="utf-8-sig"), newline="")
        for row in (reader := csv.DictReader(text, restkey="more values than names", strict=True)):
            yield reader.line_num, {name: value for name, value in row.items() if value not in ("", None)}
    except (ValueError, csv.Error, OSError) as error:  # UnicodeDecodeError is a ValueError
        raise TrapsError(f"{table}: {error}; save it as CSV in UTF-8 with the columns of docs/recorded.md") from error
