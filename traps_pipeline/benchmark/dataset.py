"""The pairs as a folder for others: clips, a table of questions, prompts, licences (`traps dataset`)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from traps_pipeline.digests import file_digest
from traps_pipeline.errors import TrapsError
from traps_pipeline.files import write_bytes
from traps_pipeline.paths import ASSETS

if TYPE_CHECKING:
    import pandas as pd

PAIRS = "pairs.csv"
_LICENCE = ASSETS.parent / "LICENSE-DATA"


def write_dataset(items: pd.DataFrame, root: Path, target: Path) -> int:
    """Write the pairs of ITEMS rows to `target`; returns the number of pairs.

    `pairs.csv` has for each pair its dataset, scenario, sub-scenario, both questions and clips, the choices and the
    answer; `clips/` the clips below root that these name, once each; `prompts/` the prompts; `LICENSE-DATA` the
    licences of all of it. Raises TrapsError for items without pairs, and for a clip that is missing or not the one that
    its item names.
    """
    sides = {side: rows.set_index("pair_id") for side, rows in items.groupby("side")}
    if {"control", "void"} - set(sides):
        raise TrapsError("no pairs to write: materialize items first")
    control, void = sides["control"], sides["void"].reindex(sides["control"].index)
    table = control[["dataset", "category", "sub_scenario", "scenario_id", "benchmark_version"]].assign(
        control_clip=control["clip"],
        control_question=control["question"],
        void_clip=void["clip"],
        void_question=void["question"],
        choices=["; ".join(labels) for labels in control["labels"]],
        ground_truth=control["ground_truth"],
    )
    digests = {str(row["clip"]): str(row["media_digest"]) for row in items.to_dict("records")}
    for clip, digest in sorted(digests.items()):
        if not (root / clip).is_file() or file_digest(root / clip) != digest:
            raise TrapsError(f"{root / clip}: is missing or not the clip of its item; materialize videos again")
        write_bytes(target / clip, (root / clip).read_bytes())
    for file in sorted((ASSETS / "prompts").iterdir()):
        write_bytes(target / "prompts" / file.name, file.read_bytes())
    write_bytes(target / _LICENCE.name, _LICENCE.read_bytes())
    write_bytes(target / PAIRS, table.sort_index().to_csv().encode())
    return len(table)
