"""Cap an account's spending over all studies on one machine or shared disk.

A study's own budget knows only its own ledger, so two studies with one key could spend twice. Each may therefore name a
folder for an account. The folder's `budget.yaml` gives the cap; `spent.json` holds what each study has spent or
reserved, which every process replaces under a lock that it holds for that moment only.
"""

import fcntl
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import remedy, write_bytes
from traps_pipeline.base.yamlfile import parse_yaml_model, read_yaml
from traps_pipeline.storage.lines import NOT_WHOLE, is_whole, line_with_checksum

CAP, SPENT, LOCK = "budget.yaml", "spent.json", "spent.lock"


class Cap(BaseModel):
    """The contents of `budget.yaml` in an account's folder: dollars for all studies together, ever."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    usd: float = Field(ge=0, allow_inf_nan=False)


class AccountBudget:
    """The remaining budget of an account over all studies.

    A call's worst case is reserved before it is sent, and replaced when its cost is known. A killed process leaves the
    worst case of its calls in flight reserved for good. study: the name under which this study's dollars are kept.
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
        _ = self.spent_usd

    @property
    def spent_usd(self) -> Mapping[str, float]:
        """Dollars spent or reserved, by study. Raises TrapsError."""
        with self._lock():
            return self._read()

    def begin(self, known_usd: float) -> None:
        """Record this study's earlier spending that the account's folder lacks.

        The study spent it before it named the folder, or the file was lost. known_usd: dollars by the study's own
        ledger.
        """
        with self._lock():
            spent = self._read()
            if (missing := known_usd - spent.get(self.study, 0.0)) > 1e-6:
                self._add(spent, missing)

    def reserve(self, dollars: float) -> bool:
        """Reserve a call's worst case if the cap leaves room; return whether it does."""
        with self._lock():
            spent = self._read()
            if sum(spent.values()) + dollars > self.cap_usd + 1e-9:
                return False
            self._add(spent, dollars)
            return True

    def correct(self, dollars: float) -> None:
        """Replace a call's worst case by its cost: add the difference, usually negative."""
        if dollars:
            with self._lock():
                self._add(self._read(), dollars)

    def explain(self, worst_usd: float) -> str:
        """Return in words why an account's budget has no room for a call."""
        spent_usd = self.spent_usd
        return (
            f"the budget of the account {self.account} is reached: {len(spent_usd)} studies have spent "
            f"${sum(spent_usd.values()):.2f} of ${self.cap_usd:.2f} (calls in flight count as their worst case), the "
            f"next call may cost ${worst_usd:.4f}. Raise `usd` in {self.folder / CAP} and run the same command to go on"
        )

    @contextmanager
    def _lock(self) -> Iterator[None]:
        """Hold the account's lock for a moment."""
        try:
            with (self.folder / LOCK).open("w") as stream:
                fcntl.flock(stream, fcntl.LOCK_EX)
                yield
        except OSError as error:
            raise TrapsError(
                f"{error.filename or self.folder}: cannot be read or written ({error.strerror}); {remedy(error)} and "
                "run the same command again: nothing is sent through an account whose budget cannot be kept"
            ) from error

    def _read(self) -> dict[str, float]:
        path = self.folder / SPENT
        if not path.exists():
            return {}
        content = path.read_bytes()
        if not is_whole(content):
            raise TrapsError(
                f"{path}: is {NOT_WHOLE}, so that nobody can tell what was spent; compare the provider's bill, then "
                "remove the file: every study that names it adds its own spending again when it next runs"
            )
        return json.loads(content)["usd"]

    def _add(self, spent: Mapping[str, float], dollars: float) -> None:
        changed = {**spent, self.study: spent.get(self.study, 0.0) + dollars}
        write_bytes(self.folder / SPENT, line_with_checksum({"usd": changed}))
