"""What errors about what is published and submitted say to do lets the same command succeed."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.conftest import Checkout
from tests.remedies.remedied import command, remedied
from traps_pipeline.release.checksums import CHECKSUMS
from traps_pipeline.release.content import content_of
from traps_pipeline.release.folder import Options, write_release
from traps_pipeline.release.results import Attribution, write_results
from traps_pipeline.release.submission import pack_submission, read_submission
from traps_pipeline.release.verification import released_items, verify
from traps_pipeline.scoring.score_rows import LEADERBOARD
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def workspace(small: Checkout) -> Workspace:
    return Workspace.open(small.workspace)


@pytest.fixture(scope="module")
def release(workspace: Workspace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("release") / "small"
    write_release(content_of(workspace), folder, Options())
    return folder


def test_a_release_is_written_to_another_folder_or_once_what_is_not_of_it_is_moved(
    workspace: Workspace, tmp_path: Path
) -> None:
    content, folder = content_of(workspace), tmp_path / "taken"
    letter = folder / "letter.txt"

    def write(to: Path = folder) -> object:
        return write_release(content, to, Options())

    folder.mkdir()
    letter.write_text("mine")
    remedied(write, "release.folder._require_own", again=lambda: write(tmp_path / "new"))
    remedied(write, "release.folder._require_own", lambda: shutil.rmtree(folder))
    assert (folder / CHECKSUMS).is_file()
    letter.write_text("mine")
    remedied(write, "release.folder", lambda: letter.rename(tmp_path / "letter.txt"))


def test_results_are_of_a_repository_and_of_models_that_were_run(
    workspace: Workspace, small: Checkout, tmp_path: Path
) -> None:
    remedied(
        lambda: write_results(workspace, tmp_path / "out", "traps", Attribution()),
        "release.results.write_results",
        again=lambda: write_results(workspace, tmp_path / "out", "me/traps", Attribution()),
    )
    root = tmp_path / "study"
    shutil.copytree(small.workspace, root, ignore=shutil.ignore_patterns("clips", "dagster", "reports"))
    board = root / "tables" / "leaderboard"
    aside = board.rename(tmp_path / "aside")
    remedied(
        lambda: write_results(Workspace.open(root), tmp_path / "out", "me/traps", Attribution()),
        "release.results.write_results",
        lambda: aside.rename(board),
    )
    assert len(workspace.tables.read_all(LEADERBOARD))


def test_a_submission_is_packed_under_a_name_read_and_held_against_its_release(
    workspace: Workspace, small: Checkout, release: Path, tmp_path: Path
) -> None:
    path = tmp_path / "small.zip"
    remedied(
        lambda: pack_submission(workspace, path, "Small Study"),
        "release.submission.pack_submission",
        again=lambda: pack_submission(workspace, path, "small-study-1.0"),
    )
    submission = remedied(
        lambda: read_submission(tmp_path / "none.zip"),
        "release.submission.read_submission",
        again=lambda: read_submission(path),
    )
    alone, held = verify(submission).unchecked, verify(submission, released_items(release)).unchecked
    (told,) = {*alone} - {*held}
    assert "--release" in told
    remedied(
        lambda: command("publish", "verify", path, "--key", tmp_path / "key.pub"),
        "cli.publish_commands.verify",
        again=lambda: command("publish", "verify", path),
    )
    root = tmp_path / "study"
    shutil.copytree(small.workspace, root, ignore=shutil.ignore_patterns("clips", "dagster", "reports"))
    votes = root / "tables" / "votes"
    aside = votes.rename(tmp_path / "aside")
    remedied(
        lambda: pack_submission(Workspace.open(root), path, "small"),
        "release.submission.pack_submission",
        lambda: aside.rename(votes),
    )
