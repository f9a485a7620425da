"""Draw the diagrams of the docs as SVG: the pipeline and the anatomy of a pair.

    python tools/diagrams.py

Writes docs/pipeline.svg and docs/pair.svg; each run gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1] / "docs"
INK, SOFT, PAPER = "#1b1f2a", "#5b6472", "#ffffff"
BLUE, GREEN, ORANGE, GREY = "#dbe8f7", "#dcefdf", "#fbe6cf", "#eceef2"
BOX_HEIGHT, LINE = 48, 17  # px


def box(x: int, y: int, width: int, title: str, note: str, fill: str, height: int = BOX_HEIGHT) -> str:
    """Return a rounded box with a bold title and a soft note in its middle."""
    middle = x + width / 2
    top = y + height / 2 - (4 if note else -5)
    texts = text(middle, top, title, bold=True) + (text(middle, top + LINE, note, SOFT, 12) if note else "")
    return f'<rect x="{x}" y="{y}" width="{width}" height="{height}" rx="7" fill="{fill}" stroke="{SOFT}"/>{texts}'


def text(x: float, y: float, words: str, colour: str = INK, size: int = 14, bold: bool = False) -> str:
    """Return a line of text that is centred at x."""
    weight = "bold" if bold else "normal"
    return (
        f'<text x="{x:g}" y="{y:g}" text-anchor="middle" font-size="{size}" font-weight="{weight}" '
        f'fill="{colour}">{escape(words)}</text>'
    )


def arrow(*points: tuple[int, int]) -> str:
    """Return a line through the points with a head at the last one."""
    path = " ".join(f"{x},{y}" for x, y in points)
    return f'<polyline points="{path}" fill="none" stroke="{INK}" stroke-width="1.5" marker-end="url(#head)"/>'


def drawing(width: int, height: int, title: str, parts: Sequence[str]) -> str:
    """Return the SVG of parts on a white ground, with its title for screen readers."""
    head = (
        '<defs><marker id="head" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" '
        f'orient="auto"><path d="M0,0 L10,5 L0,10 z" fill="{INK}"/></marker></defs>'
    )
    body = "\n".join(parts)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        f'role="img" font-family="sans-serif"><title>{escape(title)}</title>{head}\n'
        f'<rect width="{width}" height="{height}" fill="{PAPER}"/>\n{body}\n</svg>\n'
    )


def pipeline() -> str:
    """Return the stages from records to reports: scenes above, answers in the middle, results below."""
    width, step = 150, 190
    columns = [20 + step * at for at in range(5)]
    rows = [60, 170, 280]
    stages = (
        (0, 0, "records", "and corrections", GREY),
        (1, 0, "scene_specs", "certified", BLUE),
        (2, 0, "videos", "one per side", BLUE),
        (3, 0, "items", "one per question", BLUE),
        (0, 1, "models, prompts", "YAML and text", GREY),
        (1, 1, "responses", "asked once", ORANGE),
        (2, 1, "votes", "of the panel", ORANGE),
        (3, 1, "verdicts", "majority", GREEN),
        (4, 1, "metrics", "PECS, intervals", GREEN),
        (1, 2, "judges", "YAML and prompts", GREY),
        (3, 2, "leaderboard", "tables, figures", GREEN),
        (4, 2, "report, site", "for people", GREEN),
    )
    parts = [text(485, 30, "From records to reports", size=17, bold=True)]
    parts += [box(columns[at], rows[row], width, title, note, fill) for at, row, title, note, fill in stages]
    middle = BOX_HEIGHT // 2
    pairs = [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 1), (3, 1), (3, 2)]
    parts += [
        arrow((columns[at] + width, rows[row] + middle), (columns[at + 1], rows[row] + middle)) for at, row in pairs
    ]
    turn, entry = columns[3] + width // 2, columns[1] + width // 2
    parts.append(arrow((turn, rows[0] + BOX_HEIGHT), (turn, 139), (entry, 139), (entry, rows[1])))
    judged = columns[2] + width // 2
    parts.append(
        arrow((columns[1] + width, rows[2] + middle), (judged, rows[2] + middle), (judged, rows[1] + BOX_HEIGHT))
    )
    scored, ranked = columns[4] + width // 2, columns[3] + width // 2
    parts.append(arrow((scored, rows[1] + BOX_HEIGHT), (scored, 249), (ranked, 249), (ranked, rows[2])))
    legend = (("you edit it", GREY), ("free: no call", BLUE), ("may cost money", ORANGE), ("computed", GREEN))
    for at, (words, fill) in enumerate(legend):
        x = 150 + 185 * at
        parts.append(f'<rect x="{x}" y="356" width="14" height="14" fill="{fill}" stroke="{SOFT}"/>')
        parts.append(text(x + 75, 368, words, SOFT, 12))
    return drawing(970, 390, "The stages from the records to the reports", parts)


def pair() -> str:
    """Return one scenario with its control, its three kinds of void, and the twin that proves a void."""
    parts = [
        text(430, 30, "Anatomy of a pair", size=17, bold=True),
        box(330, 55, 200, "scenario", "a scene with fixed parameters", GREY),
        box(30, 165, 230, "control", "the outcome is seen: answer", GREEN),
        box(315, 165, 230, "void", "the outcome is unknowable: abstain", ORANGE),
        box(600, 165, 230, "twin", "another answer, the same void clip", BLUE),
        arrow((330, 79), (145, 79), (145, 165)),
        arrow((430, 103), (430, 165)),
        arrow((530, 79), (715, 79), (715, 165)),
        arrow((600, 189), (545, 189)),
        text(572, 181, "proves", SOFT, 12),
        arrow((260, 189), (315, 189)),
        text(287, 181, "one edit", SOFT, 12),
        box(60, 285, 230, "occlusion", "an occluder hides what decides", ORANGE),
        box(315, 285, 230, "chaotic", "the clip ends before the outcome", ORANGE),
        box(570, 285, 230, "ill-posed", "the question asks the unseen", ORANGE),
        arrow((430, 213), (430, 285)),
        arrow((430, 249), (175, 249), (175, 285)),
        arrow((430, 249), (685, 249), (685, 285)),
    ]
    return drawing(860, 360, "A scenario with its control, its void, the three kinds of void, and the twin", parts)


def main() -> None:
    """Write both diagrams."""
    for name, svg in (("pipeline", pipeline()), ("pair", pair())):
        (DOCS / f"{name}.svg").write_text(svg, encoding="utf-8")
        print(f"docs/{name}.svg: {len(svg)} bytes")


if __name__ == "__main__":
    main()
