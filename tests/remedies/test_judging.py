"""What errors about labels, votes and people's files say to do lets the same command succeed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.judging.conftest import judge_at
from tests.providers.server import Provider
from tests.remedies.remedied import remedied
from traps_pipeline.judging.robustness import check_panel, load_attacks
from traps_pipeline.models.registry.judges import JudgeEntry
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

__all__ = ["judge_at"]  # the fixture


@pytest.mark.slow  # asks a server
def test_the_judges_that_failed_alone_are_asked_again(
    provider: Provider, judge_at: Callable[[str], JudgeEntry], tmp_path: Path
) -> None:
    workspace = Workspace.create(tmp_path, Study(budget_usd=10))
    panel = [judge_at("judge-one")]
    provider.configure(fault_by_model={"judge-one": "bad_request"})
    attacks = load_attacks()
    few = attacks.model_copy(update={"attacks": attacks.attacks[:2]})

    def call() -> object:
        return check_panel(workspace, "one", panel, few)

    remedied(call, "judging.robustness", lambda: provider.configure(fault_by_model={}))
