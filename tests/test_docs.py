"""What code and pages cite exists: pages, their sections, links, modules; and the paper has one name everywhere."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
import yaml

from tests.conftest import ROOT
from traps_pipeline.pipeline.experiment import Experiment
from traps_pipeline.scoring.published import published_overall

FOLDERS = ("traps_pipeline", "tests", "bench", "docs", "assets", "scene_specs", "tools", ".ci")
FILES = [path for place in (ROOT.glob("*"), *((ROOT / name).rglob("*") for name in FOLDERS)) for path in place]
ENDINGS = (".py", ".md", ".yaml", ".toml", ".j2", ".txt", ".cff", "Makefile", ".ci/run")
TEXTS = [path for path in FILES if str(path).endswith(ENDINGS) and path != Path(__file__)]
KNOWN = [*map(str, FILES)]
NUMBER = r"\d+(?:\.\d+)*"
# docs/spec.md 4.2, docs/spec.md 7 and 8, docs/models.md, "Ledger"
SECTION = re.compile(rf'([\w./-]+\.md)`?,?\s[ #]*(?:sections? )?("[^"\n]+"|{NUMBER}(?:(?:, | and ){NUMBER})*)')
PATH = re.compile(rf"(?<![\w./-])(?:{'|'.join(FOLDERS[:-1])})/[\w./-]*\.(?:md|py|yaml|csv|txt|png)\b")
MODULE = re.compile(r"(?<![\w./<>-])[\w/]+\.py\b")
NAMED = re.compile(r"`(\w+)`\s(?:of|in)\s`([\w./]+\.py)`")  # `draw_again` of `tools/redraw.py`
YAML = re.compile(r"^```yaml\n(.*?)^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[[^]\n]*\]\((?!\w+:)([^)#\s]*)#?([^)\s]*)\)")
PAPER_IN = (
    "README.md", "docs/spec.md", "assets/published/README.md", "traps_pipeline/report/templates/report.html.j2",
    "assets/prompts/README.md",
)  # fmt: skip


@cache
def sections(page: Path) -> set[str]:
    """Numbers, titles and anchors of a page's headings, and the words in bold that begin its paragraphs."""
    text = page.read_text() if page.is_file() else ""
    titles = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    anchors = ["#" + re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles]
    numbers = [found[0] for title in titles if (found := re.match(NUMBER, title))]
    return {*titles, *anchors, *numbers, *re.findall(r"^\*\*(.+?)\.?\*\*", text, re.MULTILINE)}


def defines(module: str, name: str) -> bool:
    """Whether a module, named by the end of its path, defines a function, a class, a constant or a field."""
    texts = [path.read_text() for path in FILES if str(path).endswith(f"/{module}")]
    return any(re.search(rf"^ *(?:def |class )?{name}\b *[(:=\[]", text, re.MULTILINE) for text in texts)


def wrong(file: Path, text: str) -> Iterator[str]:
    """Every citation in a file's text whose page, section, module or name in a module does not exist, with its line."""
    found = [(at, any(f"/{path}".endswith(f"/{at[0]}") for path in KNOWN)) for at in PATH.finditer(text)]
    for at in SECTION.finditer(text):
        parts = [at[2].strip('"')] if at[2].startswith('"') else re.findall(NUMBER, at[2])
        found.append((at, {*parts} <= sections(ROOT / at[1])))
    if file.suffix == ".md":
        found += [(at, any(f"/{path}".endswith(f"/{at[0]}") for path in KNOWN)) for at in MODULE.finditer(text)]
        found += [(at, defines(at[2], at[1])) for at in NAMED.finditer(text)]
        for at in LINK.finditer(text):
            target = file.parent / at[1] if at[1] else file
            found.append((at, target.exists() and (not at[2] or f"#{at[2]}" in sections(target))))
    for at in (at for at, exists in found if not exists):
        yield f"{file.relative_to(ROOT)}:{text.count(chr(10), 0, at.start()) + 1}: there is no {at[0]}"


def test_what_is_cited_exists() -> None:
    assert len(TEXTS) > 300
    found = [one for path in TEXTS for one in wrong(path, path.read_text())]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("page", "cited"),
    [
        *(("bench/x.py", cited) for cited in ("docs/spec.md 7 and 99", 'docs/models.md, "Purse"', "docs/x.md")),
        *(("docs/x.md", cited) for cited in ("x.md section 5", "[x](x.md)", "[x](spec.md#x)", "models/x.py")),
        ("docs/x.md", "`close` of `tools/redraw.py`"),
    ],
)
def test_a_citation_of_what_is_not_there_is_named_with_its_line(page: str, cited: str) -> None:
    assert list(wrong(ROOT / page, f"one\n{cited}")) == [f"{page}:2: there is no {cited}"]


def test_the_experiments_in_pages_are_valid() -> None:
    blocks = [block for path in TEXTS if path.suffix == ".md" for block in YAML.findall(path.read_text())]
    parts = [part for part in map(yaml.safe_load, blocks) if isinstance(part, dict)]  # lists: entries of the registry
    assert len(parts) >= 6
    for part in parts:
        Experiment.model_validate({"name": "page", "models": ["oracle"], **part})


def test_the_paper_has_one_name_everywhere() -> None:
    paper = yaml.safe_load((ROOT / "CITATION.cff").read_text())["preferred-citation"]
    authors = ", ".join(f"{one['given-names']} {one['family-names']}" for one in paper["authors"])
    for name in PAPER_IN:
        text = " ".join((ROOT / name).read_text().replace("\n> ", " ").split())
        assert [part for part in (paper["title"], authors, "COLM 2026", paper["url"]) if part not in text] == [], name


def test_the_verbatim_prompts_carry_the_licence_of_the_papers_release() -> None:
    listed = (ROOT / "assets/prompts/README.md").read_text()
    rows = [row for row in listed.splitlines() if row.startswith("|") and ".txt" in row]
    whose = {name: "verbatim" in row for row in rows for name in re.findall(r"\w+\.txt", row)}
    assert set(whose) == {path.name for path in (ROOT / "assets/prompts").glob("*.txt")}
    # They carry that licence, too.
    adapted = ["json_answer_suffix.txt", "json_abstain_suffix.txt", "probabilities_suffix.txt"]
    assert [name for name, verbatim in whose.items() if not verbatim] == [
        "judge_confabulation.txt",
        "judge_premise_suffix.txt",
        "priced_suffix.txt",
        "logprobs_suffix.txt",
        *adapted,
    ]
    for name in ("assets/prompts/README.md", "LICENSE-DATA", "README.md", "docs/limits.md"):
        text = " ".join((ROOT / name).read_text().split())
        assert "CC BY-NC 4.0" in text or "non-commercial" in text, name


def test_the_finding_in_the_readme_is_what_the_paper_printed() -> None:
    overall = published_overall().pivot(index="model", columns="regime")
    readme = " ".join((ROOT / "README.md").read_text().split())
    plain, guided = (overall["abs_rec"][regime].mul(100).round() for regime in ("standard", "guided"))
    assert len(overall) == 16
    for shares in (plain, guided):
        assert f"{shares.min():.0f} to {shares.max():.0f} %" in readme
    changed = (overall["acc"]["guided"] - overall["acc"]["standard"]).abs().mul(100).round().max()
    assert changed == 2 and "two points" in readme
    assert (ROOT / "docs" / "moving_pair.gif").stat().st_size < 1_500_000
