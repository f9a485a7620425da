"""Draw, name and guard the items of a held-out set.

Items of one scenario are recognized by their frames, and how many there are, or which share a question, tells sides. So
a held-out set asks one item of each scenario, which its key draws.
"""

from __future__ import annotations

import hmac
import json
import re
import secrets
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_text
from traps_pipeline.base.paths import OWN_SPECS, SCENE_SPECS
from traps_pipeline.benchmark.records import load_release
from traps_pipeline.protocol.datasets import TWO_EVENTS
from traps_pipeline.storage.benchmark_tables import ItemRow

KEY_BYTES = 32
MARKER = "held-out.json"  # the released items, in the study's folder and in that of a private benchmark
Row = Mapping[str, Any]
Asked = TypeVar("Asked", bound=ItemRow)


def opaque(key: bytes, item_id: str) -> str:
    """Return a held-out item's name, which only the key can map to the item."""
    return hmac.new(key, item_id.encode(), "sha256").hexdigest()[:24]


def held_out_key(path: Path, *, make: bool = False) -> bytes:
    """Return the key of a held-out set, from its file of 64 hexadecimal digits.

    A missing file is created with a random key, readable by its owner alone. Raises TrapsError.
    """
    if make and not path.exists():
        write_text(path, secrets.token_hex(KEY_BYTES) + "\n", private=True)
    try:
        text = path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise TrapsError(f"{path}: cannot be read ({error}); give the file of the held-out set's key") from error
    if not re.fullmatch(rf"[0-9a-f]{{{2 * KEY_BYTES}}}", text):
        raise TrapsError(f"{path}: is no key ({2 * KEY_BYTES} hexadecimal digits); give the one that the release made")
    # Another benchmark that has ids in common gets other names and another draw by the same key.
    return hmac.digest(bytes.fromhex(text), load_release().canary.encode(), "sha256")


def drawn_items(items: Iterable[Row], key: bytes) -> list[Row]:
    """Return one ITEMS row of each scenario, drawn by the key.

    Over the scenarios of a taxonomy, and over those of two events, in an order that only the key tells, kinds of items
    (dataset and side, or lane and clip) take turns, so that each is drawn as often as any other.
    """
    scenarios = dict[tuple[str, bool], dict[str, list[Row]]]()
    for row in sorted(items, key=lambda row: (row["dataset"], row["side"], row["item_id"])):
        group = row["taxonomy"], row["dataset"] == TWO_EVENTS
        scenarios.setdefault(group, {}).setdefault(row["scenario_id"], []).append(row)
    drawn = list[Row]()
    for rows_of in scenarios.values():
        order = sorted(rows_of, key=lambda scenario: opaque(key, f"turn of {scenario}"))
        drawn += [rows_of[scenario][turn % len(rows_of[scenario])] for turn, scenario in enumerate(order)]
    return drawn


def _markers(study: Path) -> list[Path]:
    return [study / MARKER, *([SCENE_SPECS / MARKER] if SCENE_SPECS != OWN_SPECS else [])]


def held_out_items(study: Path) -> dict[str, str]:
    """Return the item of each scenario that was released without its answer."""
    items = dict[str, str]()
    for path in _markers(study):
        if path.is_file():
            items |= {item_id.split(":")[1]: item_id for item_id in json.loads(path.read_text(encoding="utf-8"))}
    return items


def released_only(study: Path, rows: Iterable[Asked]) -> list[Asked]:
    """Return ITEMS rows without those of held-out scenarios that were not released: nobody is asked them."""
    items = held_out_items(study)
    return [row for row in rows if items.get(row.scenario_id, row.item_id) == row.item_id]


def mark_held_out(study: Path, drawn: Iterable[Row]) -> None:
    """Note which items are held out; the study's folder is `study`.

    Raises TrapsError if another item of one of these scenarios was released: both together would tell sides.
    """
    items, former = {row["scenario_id"]: row["item_id"] for row in drawn}, held_out_items(study)
    again = sorted(scenario for scenario in items if former.get(scenario, items[scenario]) != items[scenario])
    if again:
        raise TrapsError(
            f"{study}: another item of {again[0]} was released, and both together tell sides; give the key of that "
            "release, or draw other scenarios"
        )
    for path in _markers(study):
        write_text(path, json.dumps(sorted({**former, **items}.values()), indent=0) + "\n", private=True)


def require_secret_seed(benchmark: Path) -> None:
    """Raise TrapsError if a benchmark's name or canary, which are published, hold the seed that draws its records."""
    from traps_pipeline.scenes.draw.sample import load_tallies

    release = load_release(benchmark / "benchmark.yaml")
    public = f"{release.name} {release.canary.partition(':CANARY:')[0]}"
    seeds = {tally.seed for tally in load_tallies(benchmark / "released").values()}
    if seeds & {int(number) for number in re.findall(r"\d{1,19}", public)}:
        raise TrapsError(
            f"{benchmark / 'benchmark.yaml'}: its name holds the seed, by which anyone can draw the records again; "
            "draw a new benchmark with another seed, and name it by `--name`"
        )


def refuse_held_out(study: Path, output: str) -> None:
    """Raise TrapsError if items of a study are held out: the output would tell their sides."""
    for path in _markers(study):
        if path.is_file():
            raise TrapsError(
                f"{path}: items of this study are held out, and {output} would tell their sides; publish it after the "
                "evaluation, when you delete this file"
            )
