"""Report which steps this machine can run, and what to install (`traps doctor`)."""

from __future__ import annotations

import os
import sqlite3
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import PART, check_disk
from traps_pipeline.base.keys import optional_key
from traps_pipeline.base.network import check_network
from traps_pipeline.base.wording import count_noun
from traps_pipeline.scenes.picture.trial import encode_clip, render_frame
from traps_pipeline.storage.place import Place, scratch_of

if TYPE_CHECKING:
    from traps_pipeline.mechanism.adapter_checks import Subject
    from traps_pipeline.storage.workspace import Workspace

MIN_FREE_GB = 1.0
SHIPPED_MODEL = "pocket"  # a local model whose weights are in the package
STATES = ("*.safetensors", "*.parquet")  # files of an extraction
LEDGER_KEYS = ("request_key", "vote_key", "label_key")  # columns of tables
FOLDERS = ("tables", "clips", "media", "trajectories", "states", "directions", "reports")
MAX_FILES = 5  # damaged files named per kind
UNFINISHED_AFTER_S = 24 * 3600.0  # longer than the writing of any file


@dataclass(frozen=True)
class Finding:
    """The result of one check of the machine by `traps doctor`."""

    ok: bool
    what: str
    detail: str


def examine(place: Place) -> Iterator[Finding]:
    """Yield one finding for each requirement of the demo."""
    for topic, look in (
        ("python", lambda: sys.version.split()[0]),
        ("checkout", _checkout),
        ("rendering", render_frame),
        ("encoding", encode_clip),
        ("disk", lambda: check_disk(scratch_of(place) if isinstance(place, str) else place, MIN_FREE_GB)),
        ("clip cache", _clip_cache),
        ("workspace", lambda: _workspace(place)),
        ("keys", _keys),
        ("packages", _plugins),
        ("network", check_network),
    ):
        yield _finding(topic, look)


def examine_local(models: Sequence[str] = ()) -> Iterator[Finding]:
    """Yield findings on devices, NF4 and weights, and on the named models (by default the shipped one)."""
    from traps_pipeline.checks import local_machine
    from traps_pipeline.mechanism.adapter_checks import Subject, brightening_clip
    from traps_pipeline.models.local.adapter import load_local_model
    from traps_pipeline.models.registry.entries import LOCAL, get_model, local_models

    entries = [get_model(model) for model in models or (SHIPPED_MODEL,)]
    for entry in entries:
        if entry.backend != LOCAL:
            raise TrapsError(
                f"{entry.id}: runs elsewhere, so nobody looks into it; name one of {', '.join(local_models())}"
            )
    yield _finding("devices", local_machine.describe_devices)
    yield _finding("nf4", local_machine.describe_nf4)
    yield _finding("checkpoints", local_machine.describe_checkpoints)
    for entry in entries:
        yield from _adapter_findings(
            entry.id, lambda entry=entry: Subject(load_local_model(entry, inside=True), *brightening_clip())
        )


def _adapter_findings(name: str, load: Callable[[], Subject]) -> Iterator[Finding]:
    """Yield one finding per check of a model; a single one if it cannot be loaded."""
    from traps_pipeline.mechanism.adapter_checks import CHECKS

    try:
        subject = load()
    except Exception as error:  # noqa: BLE001 - whatever the library raises becomes a finding
        yield Finding(False, name, f"{type(error).__name__}: {error}")
        return
    for check in CHECKS:
        yield _finding(f"{name}, {check.name}", partial(check.found, subject))


def examine_files(place: Place) -> Iterator[Finding]:
    """Read every self-checking file of a study in full; yield one finding per kind."""
    from traps_pipeline.mechanism.hidden_states import damage
    from traps_pipeline.storage.parquet import bytes_damage
    from traps_pipeline.storage.workspace import Workspace

    workspace = Workspace.open(place)
    store, missing = workspace.store, list[str]()
    folders = FOLDERS if workspace.is_shared else ()
    # Those of other hosts are fetched, and compared with their digests.
    for path in (path for folder in folders for path in store.below(workspace.root / folder)):
        try:
            store.here(path)
        except TrapsError as error:
            missing.append(str(error))
    for folder in FOLDERS:
        workspace.bring_folder(workspace.root / folder)
    if workspace.is_shared:
        yield Finding(not missing, "store", "; ".join(missing[:MAX_FILES]) or "every object is what was written")
    for topic, files, damage_of in (
        ("tables", sorted((workspace.root / "tables").rglob("*.parquet")), bytes_damage),
        ("clips", sorted((workspace.root / "clips").rglob("*.mp4")), _clip_damage),
        ("media", sorted((workspace.root / "media").glob("*/*.json")), _media_damage),
        ("states", sorted(file for kind in STATES for file in (workspace.root / "states").rglob(kind)), damage),
        ("history", sorted(workspace.dagster_home.rglob("*.db")), _history_damage),
    ):
        yield _finding(topic, partial(_read_all, files, damage_of))
    message = [*dict.fromkeys((*workspace.answers.damage(), *workspace.votes.damage(), *_lost_rows(workspace)))]
    yield Finding(not message, "ledger", "; ".join(message[:MAX_FILES]) or "all rows are what was written")
    yield Finding(True, "unfinished", _remove_unfinished(workspace.root))


def _read_all(files: Sequence[Path], damage_of: Callable[[Path], str]) -> str:
    """Read files and return their number. Raises TrapsError that names damaged ones, OSError for an unreadable one."""
    if messages := [message for path in files if (message := damage_of(path))]:
        rest = f"; and {len(messages) - MAX_FILES} more" if len(messages) > MAX_FILES else ""
        raise TrapsError("; ".join(messages[:MAX_FILES]) + rest)
    return f"{count_noun(len(files), 'file')} read, as written"


def examine_unused(place: Place, *, is_removed: bool) -> Finding:
    """Return a finding on old unreferenced objects, removed or not. Raises TrapsError if the study is not shared."""
    from traps_pipeline.storage.store import GRACE_DAYS
    from traps_pipeline.storage.workspace import Workspace

    workspace = Workspace.open(place)
    if not workspace.is_shared:
        raise TrapsError(
            f"{place}: a study in a folder has no objects that nobody names; give the address of one in an object "
            "store with --workspace s3://BUCKET/STUDY"
        )
    unused_objects = workspace.store.unused(is_removed=is_removed)
    volume = f"{count_noun(len(unused_objects), 'object')} ({sum(item.size for item in unused_objects) / 1e6:.1f} MB)"
    if unused_objects:
        names = ", ".join(item.name for item in unused_objects[:MAX_FILES])
        volume += f", the oldest of {unused_objects[0].at:%Y-%m-%d}: {names}"
        volume += ", .." * (len(unused_objects) > MAX_FILES)
    effect = "removed" if is_removed else "would be removed by `traps doctor --unused remove`"
    return Finding(
        True, "unused", f"{effect}, since nobody names them and they are older than {GRACE_DAYS:.0f} days: {volume}"
    )


def _lost_rows(workspace: Workspace) -> Iterator[str]:
    """Yield which tables hold answers and votes that the ledger lacks, with the money paid for them."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        known = workspace.answers.keys() | workspace.votes.keys()
        for path in sorted((workspace.root / "tables").rglob("*.parquet")):
            with suppress(pa.ArrowException, OSError):  # named as damaged by `bytes_damage`
                columns = {*pq.read_schema(path).names} & {*LEDGER_KEYS, "cost_usd"}
                for key in columns & {*LEDGER_KEYS}:
                    rows = pq.ParquetFile(path).read(columns=[*columns]).to_pylist()
                    lost = {row[key]: row.get("cost_usd") or 0.0 for row in rows if row[key] not in known}
                    lost.pop(None, None)
                    if lost:
                        yield (
                            f"{path}: the ledger lacks {count_noun(len(lost), 'row')} that it was made from "
                            f"(${sum(lost.values()):.4f}); put a whole copy of the ledger in its place, or run "
                            "`traps run` again, which asks only what is missing where a table is made again"
                        )
    except TrapsError as error:
        yield str(error)


def _clip_damage(path: Path) -> str:
    from traps_pipeline.scenes.worlds.clip_notes import DamagedClip, read_clip

    try:
        read_clip(path)
    except DamagedClip as error:
        return str(error)
    return ""


def _media_damage(note: Path) -> str:
    from traps_pipeline.storage.media import payload, read_note
    from traps_pipeline.video.encode import DamagedClip

    try:
        media = read_note(note)
        if media.path is not None:
            payload(media)
    except (DamagedClip, ValueError) as error:
        return str(error)
    return ""


def _history_damage(path: Path) -> str:
    """Return why a history is damaged; the next command puts it aside, losing nothing."""
    # SQLite keeps notes beside a file of this kind, which a user who may only read cannot let it write.
    mode = "mode=ro" if os.access(path.parent, os.W_OK) else "immutable=1"
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?{mode}", uri=True)) as connection:
            (result,) = connection.execute("pragma quick_check(1)").fetchone()
    except sqlite3.DatabaseError as error:
        result = str(error)
    return "" if result == "ok" else f"{path}: {result}; what counts stands in the tables"


def _remove_unfinished(root: Path) -> str:
    """Remove killed runs' unfinished files, but no young ones a run may be writing."""
    old = [path for path in root.rglob(f".*{PART}") if time.time() - path.stat().st_mtime > UNFINISHED_AFTER_S]
    if not old:
        return "no killed run left a file"
    size, effect = sum(path.stat().st_size for path in old), "removed"
    for path in old:
        try:
            path.unlink(missing_ok=True)
        except OSError:
            effect = "left, which only the study's owner can remove"
    return f"{count_noun(len(old), 'file')} of killed runs {effect} ({size / 1e6:.1f} MB)"


def _finding(topic: str, look: Callable[[], str]) -> Finding:
    try:
        return Finding(True, topic, look())
    except Exception as error:  # noqa: BLE001 - every failure of an examination becomes a finding
        return Finding(False, topic, f"{error}")


def _checkout() -> str:
    from traps_pipeline.base.paths import require_root
    from traps_pipeline.benchmark.corrections import read_corrections
    from traps_pipeline.benchmark.records import load_release, load_released
    from traps_pipeline.models.registry.entries import load_models

    root, release = require_root(), load_release()
    counts = ", ".join(
        (
            count_noun(len(load_released()), "scenario"),
            count_noun(len(read_corrections()), "correction"),
            count_noun(len(load_models()), "model"),
        )
    )
    return f"{root}: {release.name} {release.version}, {counts}"


def _clip_cache() -> str:
    from traps_pipeline.scenes.worlds.clip_cache import VARIABLE, ClipCache

    clip_cache = ClipCache.of_user()
    return "off" if clip_cache is None else f"{clip_cache.describe()}; {VARIABLE} sets its GB, or off"


def _workspace(place: Place) -> str:
    from traps_pipeline.storage.workspace import Workspace

    if not Workspace.is_there(place):
        return f"{place} not made yet (`traps init` or `traps run demo` makes it)"
    study = Workspace.open(place).study
    return f"{place}: benchmark {study.benchmark}, panel {study.panel}, budget ${study.budget_usd:,.2f}"


def _plugins() -> str:
    """Return what installed packages add. Raises TrapsError for what cannot be loaded."""
    from traps_pipeline.base.plugins import KINDS, plugins
    from traps_pipeline.scenes.family_registry import get_family

    added = [plugin for group in KINDS for plugin in plugins(group).values()]
    for plugin in added:
        get_family(plugin.name) if plugin.group == "families" else plugin.load()
    return ", ".join(f"{KINDS[plugin.group]} {plugin.name} ({plugin.package})" for plugin in added) or "add no part"


def _keys() -> str:
    """Return missing keys and who needs them. Raises TrapsError for an unusable key."""
    from traps_pipeline.models.registry.entries import load_accounts, load_models, missing_keys
    from traps_pipeline.models.registry.judges import load_judges

    entries = [*load_models().values(), *load_judges().values()]
    for key in sorted({account.key for account in load_accounts().values() if account.key}):
        optional_key(key)  # raises if its value is no key
    missing = [f"{name} ({', '.join(entry_ids)})" for name, entry_ids in missing_keys(entries).items()]
    return f"the demo needs none; to ask other models and judges, set {'; '.join(missing)}" if missing else "all set"
