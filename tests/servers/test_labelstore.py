"""Labels of several people in one database: nothing confirmed is lost, and nothing is labelled that was not shown."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.build.errors import raises
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.people.human_label_rows import LABELS_FILE
from traps_pipeline.people.labels import label_lines
from traps_pipeline.servers.labelstore import DATABASE, LabelStore, NotWaiting

YES = {"abstained": True}


def kept(folder: Path) -> list[tuple[int, str, str]]:
    return [(line.seq, line.who, line.unit) for line in label_lines(folder)]


def test_only_what_waits_is_labelled_and_two_stores_append_to_one_file(tmp_path: Path) -> None:
    one, other = LabelStore(tmp_path), LabelStore(tmp_path)
    with pytest.raises(NotWaiting):
        one.record("jd", "abstention", "u1", YES)
    for store, who in ((one, "jd"), (other, "ab"), (one, "cy")):
        store.show(who, "abstention", "u1", "plinko-0001")
        store.record(who, "abstention", "u1", YES)
    with raises(NotWaiting, "servers.labelstore.LabelStore.record"):
        other.record("jd", "abstention", "u1", YES)
    assert one.show("jd", "abstention", "u1", "plinko-0001", again=True)  # shown again, it may be labelled again
    assert one.show("jd", "abstention", "u1", "plinko-0001")  # as long as it waits
    other.record("jd", "abstention", "u1", {"abstained": False})
    assert kept(tmp_path) == [(1, "jd", "u1"), (2, "ab", "u1"), (3, "cy", "u1"), (4, "jd", "u1")]
    assert label_lines(tmp_path)[-1].label == {"abstained": False}
    assert [(each.unit, each.waits) for each in one.shown("jd")] == [("u1", False)]


def test_a_unit_that_was_labelled_in_another_window_is_not_asked_again(tmp_path: Path) -> None:
    one, other = LabelStore(tmp_path), LabelStore(tmp_path)
    assert one.show("jd", "abstention", "u1", "plinko-0001")
    one.record("jd", "abstention", "u1", YES)
    assert not other.show("jd", "abstention", "u1", "plinko-0001")  # read as open before it was labelled
    with raises(NotWaiting, "servers.labelstore.LabelStore.record"):
        other.record("jd", "abstention", "u1", {"abstained": False})
    assert other.show("ab", "abstention", "u1", "plinko-0001")  # another person
    assert kept(tmp_path) == [(1, "jd", "u1")]


def test_handles_are_of_one_person_one_task_and_one_unit_and_stay(tmp_path: Path) -> None:
    store = LabelStore(tmp_path)
    handles = {store.handle(who, task, unit) for who in ("jd", "ab") for task in ("a", "b") for unit in ("u1", "u2")}
    assert len(handles) == 8
    assert LabelStore(tmp_path).handle("jd", "a", "u1") == store.handle("jd", "a", "u1")
    assert LabelStore(tmp_path / "other").handle("jd", "a", "u1") not in handles  # nobody can compute it elsewhere


def test_what_a_crash_leaves_is_made_whole_again(tmp_path: Path) -> None:
    store = LabelStore(tmp_path)
    for unit in ("u1", "u2", "u3"):
        store.show("jd", "abstention", unit, "plinko-0001")
        store.record("jd", "abstention", unit, YES)
    whole = (tmp_path / LABELS_FILE).read_bytes()
    last = whole.rfind(b"\n", 0, -1) + 1
    for torn in (whole[:last], whole[: last + 30], b""):  # killed before, while and long before it was appended
        (tmp_path / LABELS_FILE).write_bytes(torn)
        LabelStore(tmp_path)
        assert (tmp_path / LABELS_FILE).read_bytes() == whole
    for name in (DATABASE, f"{DATABASE}-wal", f"{DATABASE}-shm"):
        (tmp_path / name).unlink(missing_ok=True)
    again = LabelStore(tmp_path)  # the database is made from the file
    assert again.labelled("jd", "abstention") == ["u1", "u2", "u3"]
    again.show("jd", "abstention", "u4", "plinko-0001")
    again.record("jd", "abstention", "u4", YES)
    assert kept(tmp_path)[-1] == (4, "jd", "u4")
    (tmp_path / LABELS_FILE).write_bytes(whole + b"nonsense\n")
    with raises(TrapsError, "servers.labelstore._last_seq"):
        LabelStore(tmp_path)
    (tmp_path / DATABASE).write_bytes(b"nonsense" * 1000)
    with raises(TrapsError, "servers.labelstore.LabelStore._database"):
        LabelStore(tmp_path)
