"""Append review decisions to the corrections; reviewers may write concurrently.

The append-only file is the only store. A decision is checked by folding it over all earlier ones, written at once and
synced to disk before it is confirmed; so a kill loses no confirmed decision, and concurrent reviewers append one after
the other.
"""

import fcntl
import json
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import date
from pathlib import Path
from typing import Any

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import sync_folder
from traps_pipeline.base.paths import CORRECTIONS, require_own_corrections
from traps_pipeline.benchmark.corrections import (
    Correction,
    LaneScenario,
    Scenario,
    apply_corrections,
    apply_to_lanes,
    corrected_scenarios,
    corrected_two_events,
    of_pairs,
    read_corrections,
)
from traps_pipeline.benchmark.records import load_released, two_events_lines

FILE = "review.jsonl"
Sign = Callable[..., Correction]


class DecidedMeanwhile(TrapsError):
    """Raised where another reviewer has decided about a scenario since this one looked at it."""


def decisions_on(scenario_id: str, folder: Path = CORRECTIONS) -> list[Correction]:
    """Return a scenario's decisions, in order. Raises TrapsError if unreadable."""
    return [correction for _, correction in read_corrections(folder) if correction.scenario_id == scenario_id]


def is_reviewed(decisions: Sequence[Correction]) -> bool:
    """Return whether a scenario has decisions, the last of them not `restore`."""
    return bool(decisions) and decisions[-1].action != "restore"


def save_decision(correction: Correction, n_seen: int, folder: Path = CORRECTIONS) -> None:
    """Append a reviewer's decision to the corrections.

    n_seen: the number of decisions about the scenario that the reviewer knew of. Raises DecidedMeanwhile if there are
    more by now, and TrapsError if the decision does not fit the record; nothing is written then.
    """
    with _open_for_append(folder) as append:
        _require_known(correction.scenario_id, n_seen, folder)
        append([correction])


def undo_decision(scenario_id: str, n_seen: int, *, who: str, why: str, folder: Path = CORRECTIONS) -> None:
    """Append decisions that cancel the last one about a scenario.

    Raises DecidedMeanwhile as `save_decision` does, and TrapsError if there is no decision to take back.
    """
    with _open_for_append(folder) as append:
        decisions = _require_known(scenario_id, n_seen, folder)
        if not is_reviewed(decisions):
            raise TrapsError(f"{scenario_id}: no decision stands that could be taken back")
        of_others = [(at, other) for at, other in read_corrections(folder) if other.scenario_id != scenario_id]
        before = [*of_others, *(("before", correction) for correction in decisions[:-1])]
        records, lanes = load_released(), two_events_lines()
        previous = apply_to_lanes(lanes, before).get(scenario_id)
        previous = previous or apply_corrections(records, of_pairs(before)).get(scenario_id)

        def sign(action: str, **changes: Any) -> Correction:
            signature = {"who": who, "when": date.today(), "why": why}
            return Correction.model_validate({"scenario_id": scenario_id, "action": action, **changes, **signature})

        was_reviewed, is_released = is_reviewed(decisions[:-1]), scenario_id in {*records, *lanes}
        append(_bring_back(is_released, previous, was_reviewed=was_reviewed, sign=sign))


def _bring_back(
    is_released: bool, previous: Scenario | LaneScenario | None, *, was_reviewed: bool, sign: Sign
) -> list[Correction]:
    """Return decisions that restore a scenario's state, reviewed only if it was."""
    params = getattr(previous, "params", None)
    if not is_released:
        if previous is None:
            return [sign("discard")]  # undo an addition
        return [sign("correct", **previous.words, params=dict(params or {}))]
    decisions = [sign("restore")]
    if previous is None:
        return [*decisions, sign("discard")]
    changes = dict(previous.words) | ({} if params is None else {"params": dict(params)})
    if changes:
        return [*decisions, sign("correct", **changes)]
    return [*decisions, sign("keep")] if was_reviewed else decisions


def _require_known(scenario_id: str, n_seen: int, folder: Path) -> list[Correction]:
    decisions = decisions_on(scenario_id, folder)
    if len(decisions) != n_seen:
        raise DecidedMeanwhile(
            f"{scenario_id}: {decisions[-1].who if decisions else 'somebody'} decided meanwhile; look at the pair again"
        )
    return decisions


@contextmanager
def _open_for_append(folder: Path) -> Iterator[Callable[[Sequence[Correction]], None]]:
    """Yield a function that appends decisions, while no other process does.

    Raises TrapsError if a later file would overrule them, and if the folder belongs to an installed wheel.
    """
    require_own_corrections(folder).mkdir(parents=True, exist_ok=True)
    later_files = sorted(path.name for path in folder.glob("*.jsonl") if path.name > FILE)
    if later_files:
        raise TrapsError(
            f"{folder / later_files[0]}: is read after {FILE}, to which reviews are appended, and would overrule them; "
            f"rename it to a name that comes before {FILE}"
        )
    path = folder / FILE
    is_new = not path.exists()
    with path.open("a+b") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        _cut_torn_line(stream)

        def append(corrections: Sequence[Correction]) -> None:
            location = f"{path} (new)"
            decisions = [*read_corrections(folder), *((location, correction) for correction in corrections)]
            apply_corrections(load_released(), of_pairs(decisions))
            apply_to_lanes(two_events_lines(), decisions)
            lines = [correction.model_dump(mode="json", exclude_none=True) for correction in corrections]
            stream.write("".join(json.dumps(line, ensure_ascii=False) + "\n" for line in lines).encode())
            stream.flush()
            os.fsync(stream.fileno())
            if is_new:
                sync_folder(folder)
            corrected_scenarios.cache_clear()
            corrected_two_events.cache_clear()

        yield append


def _cut_torn_line(stream: Any) -> None:
    """Remove the remains of an unconfirmed line after a power cut."""
    stream.seek(0)
    content = stream.read()
    end = content.rfind(b"\n") + 1
    if end != len(content):
        stream.truncate(end)
