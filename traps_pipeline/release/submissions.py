"""Verify submissions, and rank those with the same items and panel together."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_bytes, write_text
from traps_pipeline.base.wording import count_noun
from traps_pipeline.models.registry.judges import id_of_judges
from traps_pipeline.release.released_rows import SUBMITTED
from traps_pipeline.release.submission import Submission, table_bytes
from traps_pipeline.release.verification import Verification, released_items, verify_file
from traps_pipeline.report.leaderboard_page import leaderboards, legend
from traps_pipeline.report.writing import environment, table_html
from traps_pipeline.scoring.scores import score
from traps_pipeline.storage.benchmark_tables import ITEMS

PAGE, TABLE = "index.html", "leaderboard.parquet"
TITLE = "TRAPSBench: submissions"


@dataclass(frozen=True)
class AcceptedSubmission:
    """A submission without problems, and its verification."""

    submission: Submission
    verified: Verification

    @property
    def name(self) -> str:
        """The name under which the submission ranks."""
        return self.submission.about.name

    @property
    def group(self) -> tuple[str, str]:
        """The items' digest and the panel, which submissions ranked together share."""
        items = self.submission.read_table(ITEMS)
        description = self.submission.about
        return digest(sorted(items["item_hash"]))[:16], id_of_judges(description.panel, description.judges)


@dataclass(frozen=True)
class RefusedSubmission:
    """A file that is not ranked, with the reason."""

    name: str
    problems: Sequence[str]


@dataclass(frozen=True)
class RankedGroup:
    """LEADERBOARD and TWO_WAY rows ranked together, named model@submission if names repeat."""

    items: str
    panel: str
    versions: str
    n_items: int
    board: pd.DataFrame
    two_way: pd.DataFrame
    submissions: dict[str, str]

    @property
    def title(self) -> str:
        """The common properties of its entries, in words."""
        return f"Benchmark {self.versions}, {count_noun(self.n_items, 'item')} ({self.items[:8]}), panel {self.panel}"


@dataclass
class Board:
    """The submissions that a leaderboard page ranks."""

    groups: list[RankedGroup] = field(default_factory=list)
    accepted: list[AcceptedSubmission] = field(default_factory=list)
    refused: list[RefusedSubmission] = field(default_factory=list)


def gather(paths: Iterable[Path], release: Path | None = None, say: Callable[[str], None] = lambda line: None) -> Board:
    """Verify and rank submissions; one that is refused, for whatever is in it, stops no other.

    Of submissions of one name the first keeps it. Raises TrapsError if none is valid, and for an altered release.
    """
    board, released = Board(), None if release is None else released_items(release)
    for path in paths:
        try:
            submission, verification = verify_file(path, released)
            problems = verification.problems
            if not problems and submission.about.name in {entry.name for entry in board.accepted}:
                raise TrapsError(
                    f"{path}: another submission is called {submission.about.name!r}; pack it with another --name"
                )
            if not problems:
                board.accepted.append(AcceptedSubmission(submission, verification))
        except TrapsError as error:
            problems = [str(error)]
        if problems:
            board.refused.append(RefusedSubmission(path.name, problems))
        say(f"{path}: {'refused' if problems else 'verified'}")
    if not board.accepted:
        reason = "; ".join(f"{entry.name}: {entry.problems[0]}" for entry in board.refused[:3])
        raise TrapsError(f"no submission holds, so there is nothing to rank ({reason})")
    groups: dict[tuple[str, str], list[AcceptedSubmission]] = {}
    for entry in board.accepted:
        groups.setdefault(entry.group, []).append(entry)
    board.groups = [_group(key, members) for key, members in sorted(groups.items())]
    return board


def _group(key: tuple[str, str], members: Sequence[AcceptedSubmission]) -> RankedGroup:
    """Score members' verdicts together, to pair differences over the same scenarios."""
    owners = Counter(model for member in members for model in _verdicts(member)["model"].unique())
    parts, submissions = list[pd.DataFrame](), dict[str, str]()
    for member in members:
        verdicts = _verdicts(member)
        # A model that is itself called `model@submission` gets another suffix, so that no two rows share a name.
        names = {m: m if owners[m] == 1 and "@" not in m else f"{m}@{member.name}" for m in verdicts["model"].unique()}
        submissions |= dict.fromkeys(names.values(), member.name)
        parts.append(verdicts.assign(model=[names[model] for model in verdicts["model"]]))
    verdicts = pd.concat(parts, ignore_index=True)
    versions = " + ".join(sorted(verdicts["benchmark_version"].unique()))
    items = len(members[0].submission.read_table(ITEMS))
    scored = score(verdicts)
    return RankedGroup(*key, versions, items, scored.board, scored.two_way, submissions)


def _verdicts(one: AcceptedSubmission) -> pd.DataFrame:
    verdicts = one.verified.verdicts
    assert verdicts is not None  # a submission without verdicts has a problem, and is not accepted
    return verdicts


def write_board(board: Board, folder: Path) -> None:
    """Write the page, and all its rows as Parquet."""
    entries: list[dict[str, Any]] = []
    for group in board.groups:
        tables = [(table.title, table_html(table)) for table in leaderboards(group.board, group.two_way)]
        entries.append({"title": group.title, "tables": tables})
    page = environment().get_template("submissions.html.j2")
    every = (
        pd.concat(rows, ignore_index=True) for rows in zip(*((g.board, g.two_way) for g in board.groups), strict=True)
    )
    terms = legend(*every)
    html = page.render(title=TITLE, groups=entries, accepted=board.accepted, refused=board.refused, legend=terms)
    write_bytes(folder / TABLE, _parquet(board))
    write_text(folder / PAGE, html)


def _parquet(board: Board) -> bytes:
    frames = [
        group.board.assign(
            submission=[group.submissions[model] for model in group.board["model"]],
            group=f"{group.items}|{group.panel}",
        )
        for group in board.groups
    ]
    return table_bytes(SUBMITTED, pd.concat(frames, ignore_index=True))
