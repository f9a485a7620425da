"""Whatever bytes a file holds, it is read, or refused in one sentence that names it: never a traceback.

`TRAPS_CAMPAIGN=10000` tries that many files in place of the few that the test run affords.
"""

from __future__ import annotations

import os
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from tests.campaign.readers import Reader, readers
from traps_pipeline.base.errors import TrapsError

pytestmark = pytest.mark.slow
TRIES = int(os.environ.get("TRAPS_CAMPAIGN", "1200"))
MAX_SAID = 400  # characters, the file's own name aside
# What people and programs write where something else belongs.
ODD = (
    b"null", b"~", b"true", b"yes", b"NaN", b".inf", b"-1", b"1e999", b"9" * 5000, b"18446744073709551616", b"1:30",
    b"0o17", b"2026-11-21", b"[]", b"{}", b'""', b"[" * 60, b"{a: " * 60, b"\xff\xfe", b"\x00", b"&a [*a]",
    b'"', b'"\\ud800"',
    b"!!python/object/apply:os.system [ls]", b"../../etc/passwd", "\u202e\u200b\u2028".encode(), b"\r\n", b"\t", b",",
)  # fmt: skip
READERS: dict[str, Reader] = {}


@pytest.fixture(scope="module", autouse=True)
def whole(tmp_path_factory: pytest.TempPathFactory) -> None:
    READERS.update(readers(tmp_path_factory.mktemp("whole")))


Change = Callable[[bytes], bytes]


@st.composite
def changes(draw: st.DrawFn) -> Change:
    """One change of a file's bytes, at a place that is drawn."""
    where, much, odd = draw(st.floats(0, 1)), draw(st.integers(1, 40)), draw(st.sampled_from(ODD))
    kind = draw(st.sampled_from(("flip", "cut", "drop", "insert", "line twice", "value", "shuffle")))
    bit = draw(st.integers(0, 7))

    def change(content: bytes) -> bytes:
        at = min(int(where * len(content)), max(0, len(content) - 1))
        lines = content.splitlines(keepends=True) or [b""]
        n = min(int(where * len(lines)), len(lines) - 1)
        if kind == "flip" and content:
            return content[:at] + bytes([content[at] ^ 1 << bit]) + content[at + 1 :]
        if kind == "cut":
            return content[:at]
        if kind == "drop":
            return content[:at] + content[at + much :]
        if kind == "insert":
            return content[:at] + odd + content[at:]
        if kind == "line twice":
            return b"".join([*lines[: n + 1], *lines[n:]])
        if kind == "shuffle":
            return b"".join([*lines[n:], *lines[:n]])
        head, colon, tail = lines[n].partition(b":")
        end = b"\n" if tail.endswith(b"\n") else b""
        return b"".join([*lines[:n], head, colon, b" ", odd, end, *lines[n + 1 :]])

    return change


def complaint(reader: Reader, folder: Path, content: bytes) -> str | None:
    """What reading a file's content says; None if it is read."""
    path = folder / reader.file
    shutil.rmtree(folder, ignore_errors=True)
    path.parent.mkdir(parents=True)
    path.write_bytes(content)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            reader.read(folder)
    except (TrapsError, *reader.may_raise) as error:
        return str(error)
    return None


def test_every_whole_file_is_read(tmp_path: Path) -> None:
    said = {name: complaint(reader, tmp_path / name, reader.whole) for name, reader in READERS.items()}
    assert {name: said for name, said in said.items() if said} == {}


@settings(
    max_examples=TRIES,
    deadline=None,
    database=None,
    derandomize=True,
    phases=(Phase.generate, Phase.shrink),
    suppress_health_check=list(HealthCheck),
)
@given(data=st.data(), altered=st.lists(changes(), min_size=1, max_size=4))
def test_altered_files_are_read_or_refused_in_a_sentence_that_names_them(
    data: st.DataObject, altered: list[Change], tmp_path_factory: pytest.TempPathFactory
) -> None:
    name = data.draw(st.sampled_from(sorted(READERS)))
    reader, content = READERS[name], READERS[name].whole
    for change in altered:
        content = change(content)
    folder = tmp_path_factory.getbasetemp() / "fuzzed"
    said = complaint(reader, folder, content)
    if said is not None:
        first = said.split("\n")[0]
        assert Path(reader.file).name in first or first.startswith(f"{folder}: "), said
        first = first.replace(str(folder), "")
        assert len(first) <= MAX_SAID, said
        assert "\x1b" not in said, said
