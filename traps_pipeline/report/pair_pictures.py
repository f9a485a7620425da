"""Draw pictures of pairs: six pairs, and an example with its answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.report.contact_sheet import pairs_figure, six_pairs
from traps_pipeline.report.worked_example import Example, example_figure, worked_example
from traps_pipeline.report.writing import NotRun
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.video.encode import DamagedClip

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Picture:
    """A card of the report made of clips.

    make: raises NotRun and DamagedClip. inputs: what it shows of the stages `reads`, as JSON.
    """

    name: str
    title: str
    make: Callable[[], Figure]
    reads: tuple[str, ...]
    inputs: Any

    def figure(self) -> Figure:
        """Return the figure. Raises NotRun, or TrapsError for a damaged clip."""
        try:
            return self.make()
        except DamagedClip as error:
            raise TrapsError(str(error)) from error


def pair_pictures(workspace: Workspace) -> list[Picture]:
    """Return every picture of pairs that the report can show."""
    items = workspace.tables.read_all(ITEMS, dataset=DATASETS)
    six = six_pairs(items) if len(items) else items
    example = worked_example(workspace)
    return [
        Picture(
            "worked_example",
            "Worked example: a pair, the answers, the panel’s reading, the verdicts",
            lambda: _example(workspace, example),
            ("items", "responses", "votes", "verdicts"),
            [_as_json(example.pair), example.model, example.words] if example else [],
        ),
        Picture(
            "six_pairs",
            "Six pairs: control above, void below",
            lambda: _six(workspace, six),
            ("items",),
            _as_json(six),
        ),
    ]


def _example(workspace: Workspace, example: Example | None) -> Figure:
    if example is None:
        raise NotRun("no pair has both answers judged under standard")
    return example_figure(example, workspace.bring(example.pair["clip"]))


def _six(workspace: Workspace, rows: pd.DataFrame) -> Figure:
    if not len(rows):
        raise NotRun("no pair has items of both sides")
    return pairs_figure(rows, workspace.bring(rows["clip"]))


def _as_json(rows: pd.DataFrame) -> str:
    """Return rows as JSON without the version, which changes in uncorrected rows, too."""
    return str(rows.drop(columns=["benchmark_version"], errors="ignore").to_json(orient="records"))
