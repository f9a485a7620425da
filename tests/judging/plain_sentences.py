"""The 200 plain sentences of `data/plain_sentences.yaml`, as the rule judge reads them.

`python -m tests.judging.plain_sentences` prints the confusion table of docs/judging.md and every sentence that is
misread.
"""

from __future__ import annotations

import asyncio
import json
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

from traps_pipeline.base.terminal import text_table
from traps_pipeline.base.yamlfile import read_yaml
from traps_pipeline.judging.panel import parse_vote, render
from traps_pipeline.judging.rules import RuleJudge
from traps_pipeline.models.judges import Task
from traps_pipeline.models.request import Request

FILE = Path(__file__).parent / "data" / "plain_sentences.yaml"
KINDS = ("answer", "hedge", "blind", "declines", "premise", "neither")
Half = Literal["looked at", "held out"]


@dataclass(frozen=True)
class Sentence:
    """An answer with its right reading. value: what it commits to (`any`: something outside all labels); None where it
    abstains."""

    item: dict[str, Any]
    kind: str
    value: str | None
    text: str
    half: Half

    def vote(self, task: Task, ground_truth: str) -> bool | None:
        """The rule judge's decision, by the same code path as any vote."""
        user = render(task, self.item["question"], self.text, ground_truth)
        asked = Request("rule-1", "rule", {}, "system", user, {"task": task})
        outcome = asyncio.run(RuleJudge().ask(asked))
        row = {"outcome": outcome.kind, "text": outcome.text}
        return parse_vote(task, row, self.item | {"ground_truth": ground_truth}).decision

    @property
    def reading(self) -> str:
        """How the rule judge reads it: `abstains`, `commits`, or `wrong value` where it commits to another label."""
        if self.vote("abstention", ""):
            return "abstains"
        labels = self.item["labels"] if self.value != "any" else []
        found = [label for label in labels if self.vote("correctness", label)]
        return "commits" if self.value is None or found == ([self.value] if labels else []) else "wrong value"

    @property
    def right(self) -> str:
        """How it should be read."""
        return "abstains" if self.value is None else "commits"


@cache
def sentences() -> tuple[Sentence, ...]:
    """All sentences in the order of the file."""
    data = read_yaml(FILE)
    items = {
        name: {**question, "aliases": json.dumps(question["aliases"])} for name, question in data["questions"].items()
    }
    halves: tuple[Half, Half] = ("looked at", "held out")
    rows = enumerate(data["sentences"])
    return tuple(Sentence(items[q], kind, value, text, halves[k % 2]) for k, (q, kind, value, text) in rows)


def share_right(half: Half) -> float:
    """The share of a half that is read as it should be."""
    mine = [sentence for sentence in sentences() if sentence.half == half]
    return sum(sentence.reading == sentence.right for sentence in mine) / len(mine)


def confusion(rows: Iterable[Sentence]) -> Iterator[tuple[str, ...]]:
    """For each kind, the number of its sentences by reading."""
    counts = Counter((sentence.kind, sentence.reading) for sentence in rows)
    for kind in KINDS:
        yield kind, *(str(counts[kind, reading]) for reading in ("commits", "abstains", "wrong value"))


def main() -> None:
    """Print both halves."""
    for half in ("looked at", "held out"):
        mine = [sentence for sentence in sentences() if sentence.half == half]
        print(f"{half}: {100 * share_right(half):.0f} % of {len(mine)} right")
        print(text_table(("kind", "commits", "abstains", "wrong value"), [*confusion(mine)]))
        for sentence in mine:
            if sentence.reading != sentence.right:
                print(f"  {sentence.reading}, should be {sentence.right} ({sentence.value}): {sentence.text!r}")


if __name__ == "__main__":
    main()
