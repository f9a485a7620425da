"""The pages of scene families: each has its picture and ranges, and those are the ones of the class."""

from __future__ import annotations

import io
import re
from dataclasses import MISSING, fields

import numpy as np
import pytest
from PIL import Image

from tests.build.packages import install_soft_bodies
from tools.family_pages import family_pages
from traps_pipeline.scenes.family_registry import families

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str | bytes]:
    install_soft_bodies(tmp_path_factory.mktemp("soft_bodies"))
    return family_pages()


def cells(page: str, parameter: str) -> list[str]:
    """The row of a parameter."""
    (line,) = re.findall(rf"^\| `{parameter}` \|.*$", page.partition("## Certificates")[0], re.MULTILINE)
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_every_family_has_a_page_with_all_that_varies_and_a_picture_of_three_worlds(pages: dict) -> None:
    for family in families():
        page = pages[f"families/{family.name}.md"]
        assert f"](families/{family.name}.md)" in pages["families.md"] and f"({family.name}.jpg)" in page
        names = [member.name for member in fields(family.params) if member.default is MISSING]
        assert [name for name in names if not cells(page, name)[2]] == [], family.name
        asides = page.partition("Asides")[2].partition("## ")[0]
        assert len(re.findall("^- .+[?]$", asides, re.MULTILINE)) >= 1, family.name
        picture = np.asarray(Image.open(io.BytesIO(pages[f"families/{family.name}.jpg"])).convert("L")).astype(int)
        control, void, twin = (picture[24:, at : at + 320] for at in (0, 326, 652))
        for one, other in ((control, void), (control, twin), (void, twin)):
            assert (abs(one - other) > 40).sum() > 50, family.name


def test_what_a_page_says_of_a_parameter_is_what_its_class_draws(pages: dict) -> None:
    rope = pages["families/soft_rope.md"]
    assert isinstance(rope, str)
    assert cells(rope, "peg_m")[1:3] == ["m", "0.46 to 0.54"]  # between(0.46, 0.54)
    assert cells(rope, "toss_m_s")[1:3] == ["m/s", "2.4 to 2.7"]
    assert cells(rope, "peg_in_middle")[2] == "False or True (the hidden element)"
    assert cells(rope, "board_colour")[2] == "wood, grey or white"
    assert cells(rope, "azimuth_deg")[1:3] == ["degrees", "90 + (-16 to 16)"]  # in_front(-16, 16)
    assert cells(rope, "off_m")[4] == "how far from the middle the peg is otherwise"
    assert cells(pages["families/chain.md"], "row")[2] == "3 or 4; 5 or 6 in longer rows"  # one_of(..., longer=...)
    assert cells(pages["families/plinko.md"], "square_pegs")[2] == "true in 35% of draws"  # chance(0.35)


def test_evidence_is_the_worst_and_the_median_of_released_records(pages: dict) -> None:
    """Of `topple` two scenarios are released, with margins of 0.0817 and 0.1002 m or what their records say."""
    # Two scenarios of `topple` are released, with margins of 0.1331 and 0.17455 m.
    assert "2 released scenarios" in pages["families/topple.md"]
    assert "`margin_m`&nbsp;0.1331 (median&nbsp;0.153825)" in pages["families/topple.md"]
