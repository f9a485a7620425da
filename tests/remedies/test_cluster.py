"""What errors of a study that several hosts make say to do lets the same call succeed."""

from __future__ import annotations

import asyncio
import os
import secrets
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from tests.build.errors import raises
from tests.objectstore import S3
from tests.postgres import Postgres
from tests.remedies.remedied import remedied
from traps_cluster.bucket import Bucket
from traps_cluster.ray_runs import require_cluster
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.money.spending import open_budget
from traps_pipeline.models.registry.entries import get_model
from traps_pipeline.pipeline.run import dagster_history
from traps_pipeline.storage.place import parse_place
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import DATABASE, RAY, Workspace

PACKAGES = ("ray", "dagster_ray", "dagster_postgres")  # of the extra, which `make test` does not install


@pytest.fixture
def address(s3: S3, postgres: Postgres, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Where a study of a test's own may lie, with what this host exports for it."""
    monkeypatch.setenv(DATABASE, postgres.address())
    monkeypatch.setenv("TRAPS_SCRATCH", str(tmp_path / "scratch"))
    return f"s3://lab/{secrets.token_hex(4)}"


# --- files in an object store -----------------------------------------------------------------------------------------


def test_a_bucket_that_is_made_and_a_key_that_is_exported_are_used(
    s3: S3, address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    s3.empty()
    content = b"frames"
    remedied(lambda: Bucket(address).put("a", content), "traps_cluster.bucket", s3.make_bucket)
    assert Bucket(address).get("a") == content
    monkeypatch.setenv("AWS_ENDPOINT", "http://127.0.0.1:1")
    found = remedied(
        lambda: Bucket(address).get("a"),
        "traps_cluster.bucket",
        lambda: monkeypatch.setenv("AWS_ENDPOINT", s3.environment["AWS_ENDPOINT"]),
    )
    assert found == content


@pytest.mark.parametrize(
    ("address", "exported", "variable"),
    [
        ("gs://lab/study", {"GOOGLE_APPLICATION_CREDENTIALS": "/no/such/key.json"}, "GOOGLE_APPLICATION_CREDENTIALS"),
        ("gs://lab/study", {"GOOGLE_APPLICATION_CREDENTIALS": __file__}, "GOOGLE_APPLICATION_CREDENTIALS"),
        ("az://lab/study", {}, "AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY"),
        (
            "az://lab/study",
            {"AZURE_STORAGE_ACCOUNT_NAME": "lab", "AZURE_STORAGE_ACCOUNT_KEY": "no-base64!"},
            "AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY",
        ),
    ],
)
def test_a_store_of_google_or_azure_without_its_key_is_refused_with_the_variables_that_it_reads(
    address: str, exported: Mapping[str, str], variable: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("obstore", reason="obstore is not installed; `pip install -e '.[dev]'` brings it")
    for name in [name for name in os.environ if name.startswith(("GOOGLE_", "AZURE_"))]:
        monkeypatch.delenv(name)
    for name, value in exported.items():
        monkeypatch.setenv(name, value)
    assert parse_place(f"{address}/") == address
    with raises(TrapsError, "traps_cluster.bucket.Bucket._used", f"{address}: ", f"({variable}"):
        Bucket(address).get("a")


def test_a_budget_of_an_account_in_a_folder_that_all_hosts_see_is_spent_from(address: str, tmp_path: Path) -> None:
    shared = tmp_path / "openai"
    shared.mkdir()
    (shared / "budget.yaml").write_text("usd: 100")
    workspace = Workspace.create(address, Study(budget_usd=50, account_budgets={"openai": "openai"}))
    entry = get_model("gpt-5-mini")

    def pay() -> None:
        with open_budget(Workspace.open(address), [entry]) as budget:
            asyncio.run(budget.reserve(entry.id, 2.0))

    remedied(
        pay, "models.money.spending.account_budgets", lambda: workspace.allow(account_budgets={"openai": str(shared)})
    )


# --- runs on other hosts ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_runs_want_the_extra_the_address_and_the_head(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in PACKAGES:
        pytest.importorskip(name, reason="the extra `cluster` is not installed")
    workspace, by = Workspace.create(address, Study()), "traps_cluster.ray_runs.require_cluster"
    monkeypatch.setenv("TRAPS_WORKSPACE", address)

    def required() -> None:
        monkeypatch.setenv("DAGSTER_HOME", str(workspace.dagster_home))
        with dagster_history(workspace) as instance:
            require_cluster(workspace, instance)

    with monkeypatch.context() as bare:
        bare.setitem(sys.modules, "ray", None)  # to Python's imports it is not there
        with raises(TrapsError, by, " ray ", "requirements-cluster.lock"):
            required()
    with raises(TrapsError, by, "export TRAPS_RAY=http://HEAD:8265"):
        required()
    monkeypatch.setenv(RAY, "http://127.0.0.1:1")
    with raises(TrapsError, by, workspace.study.name, "`traps ui`"):
        required()
