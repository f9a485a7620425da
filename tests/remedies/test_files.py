"""What errors about any file say to do lets it be written or read."""

from __future__ import annotations

import contextlib
import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.remedies.remedied import carries_out, remedied
from traps_pipeline.base.files import require_in_place, try_lock, write_text
from traps_pipeline.base.yamlfile import read_lines, read_mapping, read_yaml


def written(path: Path, text: str = "x") -> Callable[[], str]:
    def call() -> str:
        write_text(path, text)
        return path.read_text()

    return call


@contextlib.contextmanager
def limited(kind: int, soft: int) -> Iterator[Callable[[], None]]:
    """A limit of this process; what raises it again, as `ulimit` does."""
    before = resource.getrlimit(kind)
    resource.setrlimit(kind, (soft, before[1]))
    try:
        yield lambda: resource.setrlimit(kind, before)
    finally:
        resource.setrlimit(kind, before)


@contextlib.contextmanager
def another_user(*folders: Path) -> Iterator[None]:
    """The rights of a user who is not root, whom no right is refused."""
    if os.geteuid() != 0:
        yield
        return
    for folder in folders:
        for each in (folder, *folder.parents):
            if each.stat().st_uid == 0 and not each.stat().st_mode & 0o001:
                each.chmod(each.stat().st_mode | 0o011)
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


@carries_out("base/files.py | {}: cannot be written ({}); {} and run the same command again")
def test_a_full_disk_is_written_to_once_some_space_is_freed(tiny_disk: Path) -> None:
    filler = tiny_disk / "filler"
    filler.write_bytes(b"0" * 60_000)
    text = "x" * 30_000
    call = written(tiny_disk / "a.txt", text)
    assert remedied(call, "base/files.py | free some space", filler.unlink) == text


def test_a_file_beyond_the_limit_is_written_once_that_is_raised(tmp_path: Path) -> None:
    with limited(resource.RLIMIT_FSIZE, 1000) as raise_it:
        call = written(tmp_path / "a.txt", "x" * 2000)
        assert len(remedied(call, "raise the limit of a file's size (`ulimit -f`)", raise_it)) == 2000


def test_a_file_is_written_once_this_shell_may_open_more(tmp_path: Path) -> None:
    held = os.open("/", os.O_RDONLY)
    with limited(resource.RLIMIT_NOFILE, held) as raise_it:  # descriptors below `held` are taken
        remedied(written(tmp_path / "a.txt"), "let this shell open more files (`ulimit -n 4096`)", raise_it)
    os.close(held)


def test_a_disk_that_is_mounted_for_writing_is_written_to(tiny_disk: Path) -> None:
    def mount(how: str) -> None:
        subprocess.run(["mount", "-o", f"remount,{how}", str(tiny_disk)], check=True)

    mount("ro")
    remedied(written(tiny_disk / "a.txt"), "choose another folder, or mount it for writing", lambda: mount("rw"))


@pytest.mark.parametrize("chosen", ["writable", "another"])
def test_a_folder_of_somebody_else_is_written_to_once_this_user_may(tmp_path: Path, chosen: str) -> None:
    folder = tmp_path / "closed"
    folder.mkdir()
    folder.chmod(0o555)
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    with another_user(tmp_path):

        def allow() -> None:
            with contextlib.ExitStack() as stack:
                if os.getuid() == 0:
                    os.seteuid(0)
                    stack.callback(os.seteuid, 65534)
                folder.chmod(0o777)

        another = written(tmp_path / "open" / "a.txt")
        done = {"remedy": allow} if chosen == "writable" else {"again": another}
        remedied(written(folder / "a.txt"), "make its folder writable for this user, or choose another folder", **done)


def test_a_name_that_is_too_long_fits_in_a_folder_with_a_shorter_path(tmp_path: Path) -> None:
    deep = Path(str(tmp_path) + "/" + "/".join(["d" * 200] * 25))
    remedied(written(deep / "a.txt"), "choose a folder with a shorter path", again=written(tmp_path / "a.txt"))


@pytest.mark.parametrize(
    ("prepare", "sentence"),
    [
        (lambda at: (at / "f").write_text("file"), "a file lies where its folder must be: move that away"),
        (lambda at: (at / "f" / "a.txt").mkdir(parents=True), "a folder lies in its place: move that away"),
    ],
)
def test_what_lies_in_the_way_is_moved_away(tmp_path: Path, prepare: Callable[[Path], object], sentence: str) -> None:
    prepare(tmp_path)
    in_the_way = tmp_path / "f" if (tmp_path / "f").is_file() else tmp_path / "f" / "a.txt"
    remedied(written(tmp_path / "f" / "a.txt"), sentence, lambda: in_the_way.rename(tmp_path / "away"))


def test_a_file_among_the_folders_of_a_path_is_moved_away(tmp_path: Path) -> None:
    (tmp_path / "f").write_text("file")
    call = written(tmp_path / "f" / "g" / "a.txt")
    remedied(
        call,
        "one of the folders of its path is a file: move that file away, or choose another folder",
        lambda: (tmp_path / "f").rename(tmp_path / "away"),
    )


def test_where_the_folder_is_gone_the_right_one_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    remedied(
        written(Path("a.txt")),
        "its folder is gone: make it again, or name the right one",
        again=written(tmp_path / "a.txt"),
    )
    monkeypatch.chdir(tmp_path)


def test_whatever_else_is_wrong_with_a_file_is_seen_to(tmp_path: Path) -> None:
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    remedied(written(loop / "deeper" / "a.txt"), "see to the file or its disk", loop.unlink)


WRITE = """
import sys, pathlib
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_bytes

try:
    write_bytes(pathlib.Path(sys.argv[1]), b"x", durable=True)
except TrapsError as error:
    sys.exit(str(error))
"""


@pytest.mark.skipif(shutil.which("strace") is None, reason="strace is not installed (make test installs it)")
@pytest.mark.parametrize("fault", ["fsync:error=EDQUOT", "fsync:error=EIO", "rename:error=ENFILE"])
@carries_out(
    "free some space, or raise the quota",
    "the disk fails: look at it, or choose a folder on another one",
    "end programs that hold many files open",
)
def test_what_the_system_refused_is_written_once_it_no_longer_does(tmp_path: Path, fault: str) -> None:
    said = {
        "EDQUOT": "or raise the quota",
        "EIO": "the disk fails: look at it",
        "ENFILE": "end programs that hold many",
    }
    write = [sys.executable, "-c", WRITE, str(tmp_path / "folder" / "a.txt")]
    strace = [
        "strace",
        "-f",
        "-qq",
        "-o",
        "/dev/null",
        "-e",
        f"trace={fault.partition(':')[0]}",
        "-e",
        f"inject={fault}",
    ]
    (tmp_path / "folder").mkdir()
    refused = subprocess.run([*strace, *write], capture_output=True, text=True, cwd=ROOT, check=False)
    assert refused.returncode == 1 and said[fault.partition("=")[2]] in refused.stderr, refused.stderr
    assert list((tmp_path / "folder").iterdir()) == []
    subprocess.run(write, cwd=ROOT, check=True)


def test_a_run_whose_lock_file_was_removed_is_run_again(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    held = try_lock(path)
    assert held is not None
    path.unlink()

    def again() -> None:
        new = try_lock(path)
        assert new is not None
        require_in_place(new, path)
        os.close(new)

    remedied(
        lambda: require_in_place(held, path),
        "nothing more is sent. Leave lock files alone (they hold nothing when no run goes on), and run the same",
        again=again,
    )
    os.close(held)


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (b"name: [", "not valid YAML ({}); correct the file"),
        (b"name: !!binary x", "not valid YAML ({}); correct the file"),
        (b"name: !!bool a", "remove the tag {}: no value has one"),
        (b"- name", "must be a mapping of names, not {}; correct the file"),
    ],
)
def test_a_yaml_file_is_read_once_it_is_corrected(tmp_path: Path, wrong: bytes, sentence: str) -> None:
    path = tmp_path / "a.yaml"
    path.write_bytes(wrong)
    assert remedied(lambda: read_mapping(path), sentence, lambda: path.write_text("name: a")) == {"name": "a"}
    assert read_yaml(path) == {"name": "a"}


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (r'{"a": "\ud800"}', "half of a surrogate pair stands in it; correct that line"),
        ('{"a": 1, "a": 2}', "base/yamlfile.py | {}: {}; correct that line"),
        ('{"a": NaN}', "base/yamlfile.py | {}: {}; correct that line"),
        ('{"a": ' + "9" * 5000 + "}", "a number of thousands of digits; correct that line"),
    ],
)
def test_a_line_is_read_once_it_is_corrected(tmp_path: Path, wrong: str, sentence: str) -> None:
    path = tmp_path / "a.jsonl"
    path.write_text(f'{{"a": 1}}\n{wrong}\n')
    right = '{"a": 1}\n{"a": 2}\n'
    lines = remedied(lambda: list(read_lines(path)), sentence, lambda: path.write_text(right))
    assert lines == [(1, '{"a": 1}'), (2, '{"a": 2}')]


def test_lines_are_read_once_the_file_is_restored(tmp_path: Path) -> None:
    path, kept = tmp_path / "a.jsonl", tmp_path / "kept.jsonl"
    kept.write_text("{}\n")
    path.write_bytes(b"\xff\xfe")
    lines = remedied(
        lambda: list(read_lines(path)),
        "base/yamlfile.py | {}: cannot be read ({}); restore it from git",
        lambda: shutil.copy(kept, path),
    )
    assert lines == [(1, "{}")]
