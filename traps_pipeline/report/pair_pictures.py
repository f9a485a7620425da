"""Draw pictures of pairs: six pairs, two events, a scenario's arms, an example."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.report.arms_sheet import arms_sheets
from traps_pipeline.report.contact_sheet import pairs_figure, six_pairs
from traps_pipeline.report.worked_example import Example, example_figure, worked_example
from traps_pipeline.report.writing import NotRun
from traps_pipeline.storage.benchmark_tables import ARMS, ITEMS
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.video.encode import DamagedClip

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

NO_ITEMS = "this study has no items yet"


@dataclass(frozen=True)
class Picture:
    """A card of the report made of clips: one or several figures, by file name.

    make: raises NotRun and DamagedClip. inputs: returns what they show of the stages `reads`, as JSON; raises
    DamagedClip.
    """

    name: str
    title: str
    make: Callable[[], Mapping[str, Figure]]
    reads: tuple[str, ...]
    inputs: Callable[[], Any]

    def figures(self) -> Mapping[str, Figure]:
        """Return figures by file name. Raises NotRun, or TrapsError for a damaged clip."""
        return _require_clips(self.make)

    def shown(self, said: str) -> Any:
        """Return what the picture shows and what is said below, as JSON. Raises TrapsError for a damaged clip."""
        return [_require_clips(self.inputs), said]


Found = TypeVar("Found")


def _require_clips(find: Callable[[], Found]) -> Found:
    try:
        return find()
    except DamagedClip as error:
        raise TrapsError(str(error)) from error


class PairPictures:
    """The pictures of a study."""

    def __init__(self, workspace: Workspace) -> None:
        self.workspace = workspace

    @cached_property
    def items(self) -> pd.DataFrame:
        """ITEMS rows of the pairs."""
        return self.workspace.tables.read_all(ITEMS, dataset=DATASETS)

    @cached_property
    def arms(self) -> pd.DataFrame:
        """The study's ARMS rows."""
        return self.workspace.tables.read_all(ARMS)

    def all(self) -> list[Picture]:
        """Return every picture of pairs that the report can show."""
        visual = self.items.loc[self.items["dataset"].isin(["occlusion", "chaotic"])] if len(self.items) else self.items
        pair_items = six_pairs(self.items) if len(self.items) else self.items
        example = worked_example(self.workspace)
        inputs = [_as_json(example.pair), example.model, example.words] if example else []
        return [
            Picture("worked_example", "Worked example: a pair, the answers, the panel’s reading, the verdicts",
                    lambda: {"worked_example": self._example(example)},
                    ("items", "responses", "votes", "verdicts"), lambda: inputs),
            Picture("six_pairs", "Six pairs: control above, void below", lambda: {"six_pairs": self._six(pair_items)},
                    ("items",), lambda: _as_json(pair_items)),
            Picture("arms", "One scenario of two events, and one with its arms", self._arms, ("items", "arms"),
                    lambda: [_as_json(self.arms), _as_json(visual) if len(self.arms) else ""]),
        ]  # fmt: skip

    def _example(self, example: Example | None) -> Figure:
        if example is None:
            raise NotRun("no pair has both answers judged under standard")
        return example_figure(example, self.workspace.bring(example.pair["clip"]))

    def _six(self, rows: pd.DataFrame) -> Figure:
        if not len(rows):
            raise NotRun("no pair has items of both sides")
        return pairs_figure(rows, self.workspace.bring(rows["clip"]))

    def _arms(self) -> Mapping[str, Figure]:
        clips = [*self.items["clip"], *self.arms["clip"].dropna()] if len(self.arms) else []
        sheets = arms_sheets(self.items, self.arms, self.workspace.bring(clips)) if clips else {}
        if not sheets:
            raise NotRun("no arm and no two events were filmed in this study")
        return sheets


def _as_json(rows: pd.DataFrame) -> str:
    """Return rows as JSON without the version, which changes in uncorrected rows, too."""
    return str(rows.drop(columns=["benchmark_version"], errors="ignore").to_json(orient="records"))
