"""An archive is read as it was packed, or is named as damaged; nothing else is raised."""

from __future__ import annotations

import io
import random
import zipfile
from collections import Counter
from pathlib import Path

import pytest

from traps_pipeline.base.archives import BadArchive, reading_archive, unzip_bytes, zip_bytes

MEMBERS = {"notes.json": b'{"a": [1, 2]}', "page": bytes(random.Random(0).choices(b"<td> 01", k=300)), "empty": b""}


@pytest.mark.parametrize("level", [0, 1])
def test_equal_members_give_equal_bytes_and_come_back_in_their_order(level: int) -> None:
    data = zip_bytes(MEMBERS, level=level)
    assert data == zip_bytes(MEMBERS, level=level)
    assert [*unzip_bytes(data).items()] == [*MEMBERS.items()]


@pytest.mark.parametrize("level", [0, 1])
def test_a_flip_of_any_bit_is_damage_or_changes_no_content(level: int) -> None:
    data, seen = zip_bytes(MEMBERS, level=level), Counter[str]()
    for bit in range(8 * len(data)):
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        try:
            seen["read"] += 1
            members = unzip_bytes(bytes(flipped))
        except BadArchive:
            seen["damaged"] += 1
            continue
        assert {*members.values()} <= {*MEMBERS.values()}  # a name may have changed, of which no CRC is kept
    assert seen["damaged"] > 0.5 * seen["read"]


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA, zipfile.ZIP_DEFLATED])
def test_damage_within_a_member_of_any_method_is_damage(method: int) -> None:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("page", MEMBERS["page"], method)
    data = bytearray(stream.getvalue())
    data[36:80] = bytes(44)
    with pytest.raises(BadArchive):
        unzip_bytes(bytes(data))


def test_a_file_that_cannot_be_opened_is_no_damage(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), reading_archive():
        zipfile.ZipFile(tmp_path / "missing.zip")
