"""Pages on mechanism and local models: every table has what it can and cannot show, and printed entries are real."""

from __future__ import annotations

import re

import pytest
import yaml

from tests.conftest import ROOT
from traps_pipeline.models.registry.entries import ModelEntry, load_accounts
from traps_pipeline.pipeline.graph import the_graph
from traps_pipeline.pipeline.stages.mechanism_stages import GROUP
from traps_pipeline.report.catalogue import TABLE_REPORTS
from traps_pipeline.report.published_results import PublishedResults

PAGE = (ROOT / "docs" / "mechanism.md").read_text()
SECTION = PAGE.split("## What each table can and cannot show")[1].split("\n## ")[0]


def of_mechanism() -> list[str]:
    """The names of all tables that read a stage of the mechanism group."""
    inside = {stage.name for stage in the_graph().stages if stage.group == GROUP}
    reports = [report for report in TABLE_REPORTS if set(report.reads) & inside]
    return [table.name for report in reports for table in report.make(PublishedResults())]


def test_every_table_of_mechanism_is_named_with_what_it_can_and_cannot_show() -> None:
    names = of_mechanism()
    assert {"probe_confabulated", "patching", "cosines", "steering_dose"} <= set(names)
    rows = [line.strip("|").split("|") for line in SECTION.splitlines() if line.startswith("| ")]
    told = [cells for cells in rows if re.search("`|figure", cells[0])]
    assert not set(names) - {name for cells in told for name in re.findall("`([a-z_]+)`", cells[0])}
    assert all(len(cells) == 3 and all(cell.strip() for cell in cells) for cells in rows)


@pytest.mark.parametrize("number", [0, 1])
def test_the_local_entry_and_the_served_one_are_entries_of_the_registry(number: int) -> None:
    page = (ROOT / "docs" / "local.md").read_text().split("## The same model behind a server")[1]
    entries = yaml.safe_load(page.split("```yaml\n")[1].split("```")[0])
    entry = ModelEntry.model_validate(entries[number], context={"accounts": load_accounts()})
    assert entry.backend == ("local", "api")[number]
