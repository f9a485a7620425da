"""A study on a cluster of this machine: PostgreSQL, an S3 server or a shared folder, Ray with a head and two nodes."""

from __future__ import annotations

import pytest

from tests import objectstore
from tests.conftest import Checkout
from tests.postgres import LACKING, programs

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("in_folder", [False, True])
def test_a_run_that_is_killed_on_a_node_changes_nothing_in_the_study(small: Checkout, in_folder: bool) -> None:
    """Tables are those of one process, calls are made once, a second run asks nothing, nodes keep to their folders."""
    for name in ("ray", "dagster_ray", "dagster_postgres"):
        pytest.importorskip(name, reason="the extra `cluster` is not installed (`make cluster-setup`)")
    if programs() is None:
        pytest.skip(LACKING)
    if not objectstore.is_installed():
        pytest.skip(objectstore.LACKING)
    from bench.cluster_kills import SMALL, kill_each

    assert kill_each(["run"], size=SMALL, clips=small.workspace / "clips", in_folder=in_folder) == []
