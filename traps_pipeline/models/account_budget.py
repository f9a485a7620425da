"""Cap an account's spending over all studies on one machine or shared disk.

A study's own budget knows only its own ledger, so two studies with one key could spend twice. Each may therefore name a
folder for an account. The folder's `budget.yaml` gives the cap; `spent.jsonl` has one line per change, which every
process appends under a lock that it holds for that moment only: concurrent runs share what is left.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import is_in_place, remedy, write_bytes
from traps_pipeline.base.yamlfile import parse_yaml_model, read_yaml
from traps_pipeline.storage.lines import NOT_WHOLE, append_whole, is_whole, line_with_checksum

CAP, SPENT = "budget.yaml", "spent.jsonl"
_COMPACTED = 2**20  # bytes of lines above which a run compacts them at its start


class Cap(BaseModel):
    """`budget.yaml` of an account's folder: dollars for all studies together, ever."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    usd: float = Field(ge=0, allow_inf_nan=False)


class AccountBudget:
    """The remaining budget of an account over all studies.

    A line reserves a call's worst case before it is sent, and another adds the difference when its cost is known. A
    killed process leaves the worst case of its calls in flight reserved for good. study: the name in this study's
    lines.
    """

    def __init__(self, account: str, folder: Path, study: str) -> None:
        self.account, self.folder, self.study = account, folder, study
        path = folder / CAP
        if not path.is_file():
            raise TrapsError(
                f"{path}: no such file; write `usd: 100` (dollars that all studies together may spend through the "
                f"account {account}) into it, or remove {account} from account_budgets in study.yaml"
            )
        self.cap_usd = parse_yaml_model(Cap, read_yaml(path), path).usd
        self._spent: defaultdict[str, float] = defaultdict(float)
        self._descriptor, self._read = -1, 0
        with self._lock():
            if self._read > _COMPACTED:
                content = b"".join(line_with_checksum({"study": name, "usd": usd}) for name, usd in self._spent.items())
                write_bytes(self._path, content, durable=True)  # other processes notice the new file and read it

    @property
    def _path(self) -> Path:
        return self.folder / SPENT

    @property
    def spent_usd(self) -> Mapping[str, float]:
        """Dollars spent or reserved, by study."""
        with self._lock():
            return dict(self._spent)

    def begin(self, known_usd: float) -> None:
        """Record this study's earlier spending that the account's folder lacks.

        The study spent it before it named the folder, or the file was lost. known_usd: dollars by the study's own
        ledgers and journal.
        """
        with self._lock():
            if (missing := known_usd - self._spent[self.study]) > 1e-6:
                self._append(missing)

    def reserve(self, dollars: float) -> bool:
        """Reserve a call's worst case if the cap leaves room; return whether it does."""
        with self._lock():
            if sum(self._spent.values()) + dollars > self.cap_usd + 1e-9:
                return False
            self._append(dollars)
            return True

    def correct(self, dollars: float) -> None:
        """Replace a call's worst case by its cost: add the difference, usually negative."""
        if dollars:
            with self._lock():
                self._append(dollars)

    def explain(self, worst_usd: float) -> str:
        """Return why there is no room for a call."""
        spent_usd = self.spent_usd
        return (
            f"the budget of the account {self.account} is reached: {len(spent_usd)} studies have spent "
            f"${sum(spent_usd.values()):.2f} of ${self.cap_usd:.2f} (calls in flight count as their worst case), the "
            f"next call may cost ${worst_usd:.4f}. Raise `usd` in {self.folder / CAP} and run the same command to go on"
        )

    def close(self) -> None:
        """Close the file without removing it."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    @contextmanager
    def _lock(self) -> Iterator[None]:
        """Hold the file's lock for a moment, after reading all lines of other processes."""
        try:
            while True:
                if self._descriptor < 0:
                    self._descriptor, self._read = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644), 0
                    self._spent.clear()
                fcntl.flock(self._descriptor, fcntl.LOCK_EX)
                if is_in_place(self._descriptor, self._path):
                    break
                self.close()  # another process has compacted the lines into a new file
            try:
                self._catch_up()
                yield
            finally:
                fcntl.flock(self._descriptor, fcntl.LOCK_UN)
        except OSError as error:
            raise TrapsError(
                f"{self._path}: cannot be read or written ({error.strerror}); {remedy(error)} and run the same command "
                "again: nothing is sent through an account whose budget cannot be kept"
            ) from error

    def _catch_up(self) -> None:
        size = os.fstat(self._descriptor).st_size
        if size < self._read:
            self._read = 0
            self._spent.clear()
        content = os.pread(self._descriptor, size - self._read, self._read)
        if torn_length := len(content) - (
            content.rfind(b"\n") + 1
        ):  # torn line of a dead process: its call was never sent
            size, content = size - torn_length, content[:-torn_length]
            os.ftruncate(self._descriptor, size)
        for line in content.splitlines(keepends=True):
            if not is_whole(line):
                raise TrapsError(
                    f"{self._path}: a line is {NOT_WHOLE}, so that nobody can tell what was spent; compare the "
                    "provider's bill, then remove the file: every study that names it adds its own spending again when "
                    "it next runs"
                )
            change = json.loads(line)
            self._spent[change["study"]] += change["usd"]
        self._read = size

    def _append(self, dollars: float) -> None:
        line = line_with_checksum({"study": self.study, "usd": dollars})
        append_whole(self._descriptor, line)
        self._spent[self.study] += dollars
        self._read += len(line)
