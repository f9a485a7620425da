"""What errors about any file say to do lets it be written or read."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.remedies.remedied import remedied
from traps_pipeline.base.files import write_text
from traps_pipeline.base.paths import RELEASED
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.scenes.worlds.spec import load_trajectory


def written(path: Path, text: str = "x") -> Callable[[], str]:
    def call() -> str:
        write_text(path, text)
        return path.read_text()

    return call


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


def test_a_full_disk_is_written_to_once_some_space_is_freed(tiny_disk: Path) -> None:
    filler = tiny_disk / "filler"
    filler.write_bytes(b"0" * 60_000)
    text = "x" * 30_000
    call = written(tiny_disk / "a.txt", text)
    assert remedied(call, "base.files.replace_file", filler.unlink) == text


def test_a_folder_of_somebody_else_is_written_to_once_this_user_may(tmp_path: Path) -> None:
    folder = tmp_path / "closed"
    folder.mkdir()
    folder.chmod(0o555)
    with another_user(tmp_path):

        def allow() -> None:
            with contextlib.ExitStack() as stack:
                if os.getuid() == 0:
                    os.seteuid(0)
                    stack.callback(os.seteuid, 65534)
                folder.chmod(0o777)

        remedied(written(folder / "a.txt"), "base.files.replace_file", allow)


@pytest.mark.parametrize("in_the_way", ["f", "f/a.txt"])
def test_what_lies_in_the_way_is_moved_away(tmp_path: Path, in_the_way: str) -> None:
    path = tmp_path / in_the_way
    if path.name == "f":
        path.write_text("a file where a folder is to be")
    else:
        path.mkdir(parents=True)
    remedied(written(tmp_path / "f" / "a.txt"), "base.files.replace_file", lambda: path.rename(tmp_path / "away"))


def test_a_trajectory_of_another_scene_is_read_once_it_is_restored(tmp_path: Path) -> None:
    of_one, of_another = (RELEASED / "trajectories" / f"plinko-000{n}.npz" for n in (1, 2))
    path, sha256 = (
        Path(shutil.copy(of_another, tmp_path / "plinko-0001.npz")),
        load_released()["plinko-0001"].trajectory_sha256,
    )
    remedied(
        lambda: load_trajectory(path, sha256),
        "scenes.worlds.spec.load_trajectory",
        lambda: shutil.copy(of_one, path),
        error=ValueError,
    )
