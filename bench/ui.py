"""Seconds until pages of Dagster's UI show what was asked for, in a study of many cells: the graph and the partitions
of `responses`, beside a stock project with one asset of as many partitions.

python bench/ui.py [--cells 576 10000] [--database]

--database: Dagster's history in PostgreSQL, and the study in an object store (moto's server), as on a cluster; there
is no cluster, since nothing is launched.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import yaml
from playwright.sync_api import Page, sync_playwright

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
from bench.quick import parse  # noqa: E402

CHROMIUM, TOKEN = "/usr/bin/chromium", "a-token-of-the-benchmark"
DATASETS, REGIMES, RUNS = 4, 3, 3
VIEWS = 3  # of each page; the fastest counts, so that the first one fills caches
# One asset, statically partitioned in two dimensions as `responses` is, and nothing of ours.
STOCK = """
import dagster as dg
keys = dg.MultiPartitionsDefinition({{
    "dataset": dg.StaticPartitionsDefinition([f"d{{n}}" for n in range({datasets})]),
    "evaluation": dg.StaticPartitionsDefinition([f"e{{n}}" for n in range({evaluations})]),
}})
@dg.asset(partitions_def=keys)
def responses(): ...
defs = dg.Definitions([responses])
"""
SHARED = "storage: {{postgres: {{postgres_url: {address!r}}}}}\n"
# Every cell is told to be made, as the stage tells it.
FILL = """
import dagster as dg
import sqlalchemy
from {module} import defs
(spec,) = [spec for spec in defs.resolve_all_asset_specs() if spec.key.path[-1] == "responses"]
with dg.DagsterInstance.get() as history:
    store = history.event_log_storage
    if hasattr(store, "postgres_url"):  # where it connects anew for each event, which takes most of its time
        store._engine = sqlalchemy.create_engine(store.postgres_url, isolation_level="AUTOCOMMIT")
    for key in spec.partitions_def.get_partition_keys():
        tags = {{"dagster/data_version": "0", "dagster/data_version_is_user_provided": "true"}}
        event = dg.AssetMaterialization(spec.key, partition=key, metadata={{"rows": 48}}, tags=tags)
        history.report_runless_asset_event(event)
    print(len(spec.partitions_def.get_partition_keys()), "/".join(spec.key.path), key)
"""


def study(folder: Path, cells: int, shared: dict[str, str] | None) -> dict[str, str]:
    """Return a workspace whose study names so many cells, of models in a registry of its own; its environment. shared:
    the variables of a study in an object store."""
    models = -(-cells // (DATASETS * REGIMES * RUNS))
    entries = [  # each of its own: a dictionary that is written twice would become an alias, which the reader refuses
        {"id": f"m{n:04d}", "backend": "reference", "params": {"strategy": "oracle"}, "runs": RUNS}
        for n in range(models)
    ]
    shipped = yaml.safe_load((ROOT / "assets" / "models.yaml").read_text())
    registry = shipped | {"models": [*shipped["models"], *entries]}
    (folder / "models.yaml").write_text(yaml.safe_dump(registry))
    experiment = {
        "name": "many",
        "description": "Cells of many models.",
        "models": [entry["id"] for entry in entries],
        "regimes": ["standard", "guided", "json"],
        "runs": [1, 2, 3],
        "panel": "rules",
        "per_family": 1,
    }
    (folder / "many.yaml").write_text(yaml.safe_dump(experiment))
    plain = {name: value for name, value in os.environ.items() if name != "DAGSTER_HOME"}
    environment = plain | {
        "TRAPS_MODELS": str(folder / "models.yaml"),
        "TRAPS_WORKSPACE": str(folder / "study"),
        "TRAPS_SCRATCH": str(folder / "scratch"),
        "PYTHONPATH": str(ROOT),
    } | (shared or {})  # fmt: skip
    command = [sys.executable, "-m", "traps_pipeline.cli", "init", str(folder / "many.yaml")]
    said = subprocess.run(command, cwd=ROOT, env=environment, check=True, stdout=subprocess.PIPE, text=True).stdout
    if shared:  # what `traps ui` exports
        url = shared["TRAPS_DATABASE"].replace("postgresql:", "postgresql+psycopg2:")
        environment |= {"TRAPS_HISTORY": url, "TRAPS_LOGS": str(folder / "logs")}
    return environment | {"DAGSTER_HOME": said.partition("DAGSTER_HOME=")[2].strip()}


def stock(folder: Path, cells: int, shared: dict[str, str] | None) -> dict[str, str]:
    """Return a folder with the stock project; its environment. shared: with the address of a database for its
    history.
    """
    home = folder / "home"
    home.mkdir()
    if shared:
        address = shared["TRAPS_DATABASE"].replace("postgresql:", "postgresql+psycopg2:")
        (home / "dagster.yaml").write_text(SHARED.format(address=address))
    (folder / "stock.py").write_text(STOCK.format(datasets=DATASETS, evaluations=cells // DATASETS))
    return os.environ | {"DAGSTER_HOME": str(home), "PYTHONPATH": str(folder)}


@contextmanager
def serving(command: list[str], environment: dict[str, str], folder: Path) -> Iterator[float]:
    """Seconds until a server answers; it is stopped at the end."""
    port = command[command.index("--port") + 1]
    begun, log = time.monotonic(), (folder / "server.log").open("w")
    process = subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=log, start_new_session=True)
    asked = urllib.request.Request(f"http://127.0.0.1:{port}/server_info", headers={"Authorization": f"Bearer {TOKEN}"})
    try:
        while process.poll() is None:
            try:
                urllib.request.urlopen(asked, timeout=2).close()
                break
            except OSError:
                time.sleep(0.1)
        yield time.monotonic() - begun
    finally:
        os.killpg(process.pid, signal.SIGINT)
        try:
            process.wait(timeout=30)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        log.close()


def seconds(page: Page, address: str, text: str) -> float:
    """Return the seconds from opening a page until it shows a text; the least of several views."""
    found = []
    for _ in range(VIEWS):
        begun = time.monotonic()
        page.goto(address)
        page.get_by_text(text, exact=True).first.wait_for(timeout=300_000)
        found.append(time.monotonic() - begun)
    return min(found)


def measure(kind: str, cells: int, browser: Any, *, in_database: bool) -> dict[str, float]:
    """Return the seconds of each page for one project."""
    from tests.objectstore import S3
    from tests.postgres import Postgres

    with socket.socket() as probe, tempfile.TemporaryDirectory() as name, ExitStack() as opened:
        probe.bind(("127.0.0.1", 0))
        port, folder = probe.getsockname()[1], Path(name)
        probe.close()
        ours, shared = kind == "study", None
        if in_database:
            database = opened.enter_context(Postgres.running(durable=True))
            shared = opened.enter_context(S3.running()).environment | {
                "TRAPS_DATABASE": database.address(), "TRAPS_WORKSPACE": "s3://lab/pages",
                "TRAPS_RAY": f"http://127.0.0.1:{port}",
            }  # fmt: skip
        environment = (study if ours else stock)(folder, cells, shared)
        module = "traps_pipeline.definitions" if ours else "stock"
        begun = time.monotonic()
        filled = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", FILL.format(module=module)],
            cwd=folder,
            env=environment,
            check=True,
            capture_output=True,
            text=True,
        )
        found = {"events written": time.monotonic() - begun}
        command = [sys.executable, "-m", "traps_pipeline.cli", "ui", "--port", str(port), "--token", TOKEN]
        if not ours:
            command = [sys.executable, "-m", "dagster_webserver", "-m", "stock", "--port", str(port)]
        with serving(command, environment, folder) as started:
            found["server answers"] = started
            page = browser.new_page(viewport={"width": 1600, "height": 1000})
            root = f"http://127.0.0.1:{port}"
            page.goto(f"{root}/?token={TOKEN}" if ours else root)
            made, asset, last = filled.stdout.split()[-3:]
            shown, address = "evaluation" if ours else "responses", f"{root}/assets/{asset}?view"
            found["graph"] = seconds(page, f"{root}/asset-groups", shown)
            found[f"partitions of responses ({made})"] = seconds(
                page, f"{address}=partitions", f"Materialized ({made})"
            )
            found["overview of responses"] = seconds(page, f"{address}=overview", last)
            page.close()
        return found


def main() -> None:
    """Print a table for each number of cells."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, nargs="+", default=[576, 10_000])
    parser.add_argument("--database", action="store_true", help="Dagster's history in PostgreSQL")
    arguments = parse(parser, cells=[24])
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        for cells in arguments.cells:
            kinds = ("study", "stock")
            ours, other = (measure(kind, cells, browser, in_database=arguments.database) for kind in kinds)
            print(f"{cells} cells: seconds, in a stock project, ratio")
            for (what, mine), theirs in zip(ours.items(), other.values(), strict=True):
                print(f"  {what:44} {mine:7.2f} {theirs:7.2f} {mine / theirs:7.2f}", flush=True)
        browser.close()


if __name__ == "__main__":
    main()
