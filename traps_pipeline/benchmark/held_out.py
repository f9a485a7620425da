"""Draw, name and guard the items of a held-out set.

Items of one scenario are recognized by their frames, and how many there are, or which share a question, tells sides. So
a held-out set asks one item of each scenario, which its key draws.
"""

import hmac
import json
import re
import secrets
from collections.abc import Iterable, Mapping
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

from traps_pipeline.base.digests import digest, file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_text
from traps_pipeline.base.paths import OWN_SPECS, SCENE_SPECS, user_state
from traps_pipeline.benchmark.records import load_release
from traps_pipeline.protocol.datasets import TWO_EVENTS
from traps_pipeline.storage.benchmark_tables import ItemRow

KEY_BYTES = 32
MARKER = "held-out.json"  # the released items
PUBLISHED = "published.txt"  # what of a private benchmark was published with its sides
MIN_SEED, MIN_DIGITS = 2**48, 6  # of a seed that nobody guesses; different digits, and different steps between them
Row = Mapping[str, Any]
Asked = TypeVar("Asked", bound=ItemRow)


def opaque_name(key: bytes, item_id: str) -> str:
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
        order = sorted(rows_of, key=lambda scenario: opaque_name(key, f"turn of {scenario}"))
        drawn += [rows_of[scenario][turn % len(rows_of[scenario])] for turn, scenario in enumerate(order)]
    return drawn


def _markers(study: Path) -> list[Path]:
    # The user's folder is the one that copies of a study and of a private benchmark share.
    return [study / MARKER, *([] if SCENE_SPECS == OWN_SPECS else [SCENE_SPECS / MARKER, _of_user(MARKER)])]


def _of_user(name: str) -> Path:
    return user_state() / f"{digest(load_release().canary)[:24]}.{name}"


def held_out_items(study: Path) -> dict[str, str]:
    """Return by scenario the id of the item that was released without its answer."""
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

    Raises TrapsError if another item of one of these scenarios was released, or all of them: together they tell sides.
    """
    if SCENE_SPECS != OWN_SPECS and (note := _of_user(PUBLISHED)).is_file():
        raise TrapsError(
            f"{note}: {note.read_text()} of this benchmark was published, which tells sides; "
            "draw another benchmark, or delete this file if nobody has seen what was published"
        )
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
    """Raise TrapsError if a benchmark's seed, which draws its records, can be guessed or is in its name or canary."""
    from traps_pipeline.scenes.draw.sample import load_tallies

    release = load_release(benchmark / "benchmark.yaml")
    public = re.sub(r"\W", "", f"{release.name} {release.canary.partition(':CANARY:')[0]}").lower()
    for seed in {tally.seed for tally in load_tallies(benchmark / "released").values()}:
        steps = {(int(right) - int(left)) % 10 for left, right in pairwise(str(seed))}
        is_named = str(seed) in public or f"{seed:x}" in public
        if is_named or seed < MIN_SEED or min(len(steps), len({*str(seed)})) < MIN_DIGITS:
            raise TrapsError(
                f"{benchmark}: its seed can be guessed or stands in its name, so anyone can draw the records again; "
                "draw a new benchmark with a seed of 60 random bits, and name it by `--name`"
            )


def begin_publication(study: Path, output: str) -> None:
    """Note that an output that tells sides is published; raise TrapsError if items are held out."""
    for path in _markers(study):
        if path.is_file():
            raise TrapsError(
                f"{path}: items of this study are held out, and {output} would tell their sides; publish it after the "
                "evaluation, when you delete this file"
            )
    if SCENE_SPECS != OWN_SPECS:
        with suppress(TrapsError):  # a home that cannot be written stops no open publication
            write_text(_of_user(PUBLISHED), output)


def count_scoring(key: Path, answers: Path, scores: int) -> int:
    """Note a file's number of scores beside the key by which it was scored; return how many there are of all files."""
    note = key.with_name(f"{key.name}.scored")
    counts = dict(line.split() for line in note.read_text().splitlines()) if note.is_file() else {}
    counts[file_digest(answers)] = str(scores)
    write_text(note, "".join(f"{line}\n" for line in sorted(map(" ".join, counts.items()))), private=True)
    return sum(map(int, counts.values()))
