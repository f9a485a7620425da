"""A file is written whole or not at all, whatever ends the writing."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.build.errors import raises
from tests.conftest import ROOT
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import remedy, replace_file, replace_folder, write_bytes, write_text


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A file with former content, alone in its folder."""
    file = tmp_path / "folder" / "table.bin"
    write_text(file, "former")
    return file


def alone(file: Path) -> bool:
    return list(file.parent.iterdir()) == [file]


def test_what_the_block_wrote_takes_the_place_of_the_file_when_the_block_ends(file: Path) -> None:
    with replace_file(file) as part:
        part.write_text("next")
        assert part.parent == file.parent  # a rename between file systems is a copy
        assert file.read_text() == "former"
    assert file.read_text() == "next"
    assert alone(file)


@pytest.mark.parametrize("end", [ValueError("wrong"), KeyboardInterrupt()])
def test_an_error_or_ctrl_c_in_the_middle_leaves_the_former_content_and_nothing_else(
    file: Path, end: BaseException
) -> None:
    with pytest.raises(type(end)), replace_file(file) as part:
        part.write_text("half of what")
        raise end
    assert file.read_text() == "former"
    assert alone(file)


def test_a_kill_in_the_middle_leaves_the_former_content_and_the_next_write_goes_through(file: Path) -> None:
    code = (
        "import sys, time; from pathlib import Path; from traps_pipeline.base.files import replace_file\n"
        "with replace_file(Path(sys.argv[1])) as part, part.open('w') as stream:\n"
        "    stream.write('half of what'); stream.flush(); print('writing', flush=True); time.sleep(600)"
    )
    writer = subprocess.Popen([sys.executable, "-c", code, file], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert writer.stdout is not None
    assert writer.stdout.readline() == "writing\n"
    writer.kill()
    assert writer.wait() == -signal.SIGKILL
    writer.stdout.close()
    assert file.read_text() == "former"
    left = [path.name for path in file.parent.iterdir() if path != file]
    assert len(left) == 1 and left[0].startswith(".") and left[0].endswith(".part")
    write_text(file, "next")
    assert file.read_text() == "next"


def test_a_full_disk_leaves_the_former_content_and_is_told_with_the_remedy(tiny_disk: Path) -> None:
    file = tiny_disk / "table.bin"
    write_text(file, "former")
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with raises(TrapsError, "base.files.replace_file", "table.bin", str(full.strerror), remedy(full)):
        write_bytes(file, os.urandom(200_000))
    assert file.read_text() == "former"
    assert alone(file)


def test_a_durable_file_that_does_not_reach_the_disk_does_not_take_the_place(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(descriptor: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "fsync", broken)
    with raises(TrapsError, "base.files.replace_file", "table.bin"):
        write_bytes(file, b"next", durable=True)
    assert file.read_text() == "former"
    assert alone(file)


def test_a_missing_file_that_the_block_reads_is_not_taken_for_one_that_cannot_be_written(file: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no-such-clip\.mp4"), replace_file(file) as part:
        part.write_bytes((file.parent / "no-such-clip.mp4").read_bytes())
    assert file.read_text() == "former"
    assert alone(file)


def test_a_private_file_is_the_owners_alone_from_its_first_byte(file: Path) -> None:
    with replace_file(file, private=True) as part:
        assert part.stat().st_mode & 0o777 == 0o600 and part.stat().st_size == 0
        part.write_text("secret")
    assert file.stat().st_mode & 0o777 == 0o600


def names_in(folder: Path) -> dict[str, str]:
    return {path.relative_to(folder).as_posix(): path.read_text() for path in folder.rglob("*") if path.is_file()}


def test_a_folder_is_replaced_whole_and_keeps_hidden_entries(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    for content in ("first", "second"):
        with replace_folder(folder) as part:
            (part / content).write_text(content)
            (folder / ".git").mkdir(exist_ok=True) if folder.exists() else None
    (folder / ".git" / "config").write_text("kept")
    with pytest.raises(KeyboardInterrupt), replace_folder(folder) as part:
        (part / "third").write_text("third")
        raise KeyboardInterrupt
    with replace_folder(folder) as part:
        (part / "fourth").write_text("fourth")
    assert names_in(tmp_path) == {"out/fourth": "fourth", "out/.git/config": "kept"}


@pytest.mark.parametrize("is_new_in_place", [False, True])
def test_a_kill_between_two_renames_loses_nothing(tmp_path: Path, is_new_in_place: bool) -> None:
    folder = tmp_path / "out"
    with replace_folder(folder) as part:
        (part / "old").write_text("old")
        (part / ".git").write_text("kept")
    folder.rename(tmp_path / ".out.former.part")  # as a kill leaves them
    (folder if is_new_in_place else tmp_path / ".out.new.part").mkdir()
    with pytest.raises(ZeroDivisionError), replace_folder(folder):
        assert names_in(folder) == ({".git": "kept"} if is_new_in_place else {"old": "old", ".git": "kept"})
        raise ZeroDivisionError
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_folder_that_cannot_be_made_is_told_in_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with (
        raises(TrapsError, "base.files.replace_folder", str(tmp_path / "file" / "out")),
        replace_folder(tmp_path / "file" / "out"),
    ):
        pass
