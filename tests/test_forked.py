"""A forked command is in the state of one whose interpreter was started for it."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from tests.conftest import ROOT, Checkout
from tests.forked import FORKS

pytestmark = pytest.mark.slow
# What a process has from whoever started it, and which of our modules it has before it imports any.
STATE = """
import json, os, signal, sys, threading
handlers = {name: str(signal.getsignal(getattr(signal, name))) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGPIPE")}
mine = sorted(name for name in sys.modules if name.split(".")[0] in ("traps_pipeline", "tests", "bench"))
print(json.dumps([os.getcwd(), sys.argv, sys.path, dict(os.environ), os.getsid(0) == os.getpid(), handlers, mine,
                  threading.active_count(), sys.stdin.isatty(), sys.flags.dont_write_bytecode], sort_keys=True))
print("told", file=sys.stderr)
sys.exit(3)
"""


def test_it_sees_what_a_started_one_sees(tmp_path: Path) -> None:
    checkout = Checkout(tmp_path, tmp_path / "study")
    (tmp_path / "stated.py").write_text(STATE)
    for what in (("-c", STATE, "a", "b"), ("-m", "stated", "a", "b")):
        forked, full = (
            FORKS.run(what, checkout.root, checkout.environment | more) for more in ({}, {"LC_MESSAGES": "C"})
        )  # in another locale it is started in full
        assert forked[0] == full[0] == 3 and forked[2] == full[2] == "told\n"
        assert forked[1] == full[1].replace('"LC_MESSAGES": "C", ', "")


def test_its_end_is_told_whatever_ended_it_and_the_next_one_is_forked(tmp_path: Path) -> None:
    def end(code: str) -> tuple[int, str, str]:
        return FORKS.run(("-c", code), tmp_path, os.environ)

    assert end(f"import os; os.kill(os.getpid(), {int(signal.SIGKILL)})") == (-signal.SIGKILL, "", "")
    code, out, err = end("print('before'); 1 / 0")
    assert (code, out) == (1, "before\n") and "ZeroDivisionError" in err
    assert end("import atexit; atexit.register(print, 'at its end')") == (0, "at its end\n", "")


def test_a_command_is_of_the_checkout_that_it_is_run_in(small: Checkout) -> None:
    code = "import traps_pipeline.base.paths as p, pandas; print(p.ROOT)"
    assert small.python("-c", code).out.strip() == str(ROOT)
