"""What a run prints on one host is read on another, from the study's object store."""

import secrets
from collections.abc import Sequence
from pathlib import Path

import dagster as dg
import pytest
import yaml
from dagster._core.storage.compute_log_manager import ComputeIOType

from tests.objectstore import S3
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.cluster.bucket import Bucket
from traps_pipeline.cluster.ray_runs import dagster_yaml
from traps_pipeline.cluster.shared_logs import SharedLogs
from traps_pipeline.storage.workspace import RAY


class Host:
    """A host with a scratch folder and a history of its own, as far as what runs print is concerned."""

    def __init__(self, folder: Path, place: str, monkeypatch: pytest.MonkeyPatch) -> None:
        folder.mkdir()
        monkeypatch.setenv(RAY, "http://head:8265")
        monkeypatch.setenv("TRAPS_SCRATCH", str(folder / "scratch"))
        said = {"compute_logs": dagster_yaml("X", place)["compute_logs"], "telemetry": {"enabled": False}}
        (folder / "dagster.yaml").write_text(yaml.safe_dump(said))
        self.instance = dg.DagsterInstance.from_config(str(folder))
        found = self.instance.compute_log_manager
        assert isinstance(found, SharedLogs)
        self.logs = found

    def read(self, key: Sequence[str]) -> tuple[bytes | None, bytes | None]:
        """What a page shows of a log."""
        found = self.logs.get_log_data(key)
        return found.stdout, found.stderr


def keys_of(instance: dg.DagsterInstance, run_id: str) -> list[Sequence[str]]:
    """The logs that a run has captured."""
    logged = instance.all_logs(run_id, of_type=dg.DagsterEventType.LOGS_CAPTURED)
    files = [entry.get_dagster_event().logs_captured_data.file_key for entry in logged]
    return [instance.compute_log_manager.build_log_key_for_run(run_id, file) for file in files]


@pytest.fixture
def place(s3: S3) -> str:
    return f"s3://lab/{secrets.token_hex(4)}"


def test_what_a_run_prints_on_one_host_is_read_on_another(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, there = Host(tmp_path / "one", place, monkeypatch), Host(tmp_path / "two", place, monkeypatch)

    @dg.op
    def speaks(context: dg.OpExecutionContext) -> None:
        print("made on this host", flush=True)
        here.logs.on_progress(keys_of(here.instance, context.run_id)[0])
        seen.append(there.read(keys_of(here.instance, context.run_id)[0])[0])
        print("and ended", flush=True)

    @dg.job
    def study() -> None:
        speaks()

    seen = list[bytes | None]()
    result = study.execute_in_process(instance=here.instance)
    (key,) = keys_of(here.instance, result.run_id)
    assert seen == [b"made on this host\n"]  # while the run goes on: all that is left of one whose host dies
    said, told = there.read(key)
    assert said == b"made on this host\nand ended\n"
    assert told and b"STEP_SUCCESS" in told  # Dagster's own events
    assert there.logs.is_capture_complete(key)
    shown = there.logs.get_log_metadata(key)
    assert shown.stdout_location == f"{place}/logs/{'/'.join(key)}.out"
    names = {name for name, *_ in Bucket(place).names()}
    assert {f"logs/{'/'.join(key)}.{end}" for end in ("out", "err")} <= names
    there.logs.delete_logs(prefix=[result.run_id])
    assert not [*Bucket(place).names()] and there.read(key) == (None, None)


def test_a_run_ends_well_where_the_store_does_not_take_what_it_prints(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    @dg.op
    def speaks(context: dg.OpExecutionContext) -> None:
        print("made on this host", flush=True)
        host.logs.on_progress(keys_of(host.instance, context.run_id)[0])

    @dg.job
    def study() -> None:
        speaks()

    host = Host(tmp_path / "one", f"{place.replace('lab', 'no-such-bucket')}", monkeypatch)
    result = study.execute_in_process(instance=host.instance)
    assert result.success
    (key,) = keys_of(host.instance, result.run_id)
    with pytest.raises(TrapsError, match=r"no-such-bucket/.*: cannot be used from the host"):
        host.logs.upload_to_cloud_storage(key, ComputeIOType.STDOUT)
    said = [entry.message for entry in host.instance.all_logs(result.run_id)]
    assert any("compute log" in one.lower() for one in said)
    assert "what this run prints was not brought to the store" in capfd.readouterr().err


def test_a_page_reads_no_file_outside_the_logs(place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    host = Host(tmp_path / "one", place, monkeypatch)
    (tmp_path / "one" / "scratch" / "secret.out").parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / "one" / "scratch" / "secret.out").write_text("a key")
    with pytest.raises(ValueError, match="Invalid path"):
        host.read(["..", "..", "secret"])
