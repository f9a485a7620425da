"""Pack a study's items, answers, votes and numbers into one verifiable file.

The file is a zip of Parquet tables and one JSON; nothing in it is executed. It is untrusted: names, sizes and schemas
are checked before anything is read, and nothing is written to disk.
"""

from __future__ import annotations

import hashlib
import io
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from traps_pipeline.base.archives import BadArchive, reading_archive
from traps_pipeline.base.archives import zip_bytes as pack_archive
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_bytes
from traps_pipeline.base.names import Name
from traps_pipeline.base.terminal import plain
from traps_pipeline.base.yamlfile import faults_of
from traps_pipeline.benchmark.held_out import begin_publication
from traps_pipeline.benchmark.records import load_release
from traps_pipeline.judging.judging_rows import VOTES
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.models.reading.interpret import READING
from traps_pipeline.models.reading.thinking import Marks
from traps_pipeline.models.registry.judges import RULES_VERSION, load_panel, panel_id
from traps_pipeline.models.registry.prompts import prompt_version
from traps_pipeline.protocol.datasets import DATASETS, TWO_EVENTS
from traps_pipeline.scoring.score_rows import LEADERBOARD, METRICS, TWO_WAY
from traps_pipeline.storage.benchmark_tables import ITEMS, current_rows
from traps_pipeline.storage.tables import Table, records
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    import pyarrow.parquet as pq

ABOUT = "submission.json"
TABLES: Mapping[str, Table[Any]] = {
    f"{t.name}.parquet": t for t in (ITEMS, RESPONSES, VOTES, METRICS, LEADERBOARD, TWO_WAY)
}
SUBMITTED_DATASETS = (*DATASETS, TWO_EVENTS)  # the second may be absent
MAX_FILE_BYTES, MAX_TABLE_BYTES, MAX_VALUES = 2 * 2**30, 2**30, 100_000_000
MAX_TEXT_BYTES = 16 * 2**20  # no call answers with more
MAX_ABOUT_BYTES = 2**20


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class SubmittedJudge(_Strict):
    """A submission's judge: all that decides its votes, without address and key."""

    id: str = Field(max_length=200)
    backend: str = Field(max_length=50)
    endpoint: str = Field(max_length=300)
    params: dict[str, Any]
    thinking: Marks | None = Field(default=None, strict=False)
    premise: bool = False


class SubmissionAbout(_Strict):
    """What a submission says of itself: the contents of `submission.json`.

    panel: name of the panel. prompts: version of each regime's. versions: code versions of the tables. files:
    SHA-256 of each table.
    """

    format: Literal[1] = 1
    name: Name
    benchmark: str = Field(max_length=200)
    version: str = Field(max_length=200)
    panel: str = Field(max_length=200)
    judges: tuple[SubmittedJudge, ...] = Field(min_length=1, max_length=10, strict=False)
    judged_by_rules: bool
    prompts: dict[str, str]
    versions: dict[str, str]
    files: dict[str, str]


@dataclass(frozen=True)
class Submission:
    """A submission in memory. altered: tables whose digest differs from `about`."""

    path: Path
    about: SubmissionAbout
    tables: Mapping[str, pd.DataFrame]
    altered: tuple[str, ...]

    def read_table(self, table: Table[Any]) -> pd.DataFrame:
        """Return the rows of one of its tables."""
        return self.tables[f"{table.name}.parquet"]


# --- packing ----------------------------------------------------------------------------------------------------------


def pack_submission(workspace: Workspace, target: Path, name: str) -> SubmissionAbout:
    """Write a study's submission, equal bytes for equal studies. Raises TrapsError unless it is judged and scored."""
    begin_publication(workspace.root, "a submission")
    study = workspace.study
    frames = {
        "items.parquet": workspace.tables.read_all(ITEMS, dataset=SUBMITTED_DATASETS),
        "responses.parquet": current_rows(workspace, RESPONSES, dataset=SUBMITTED_DATASETS),
        "votes.parquet": current_rows(workspace, VOTES, dataset=SUBMITTED_DATASETS),
        "metrics.parquet": workspace.tables.read_all(METRICS, dataset=SUBMITTED_DATASETS),
        "leaderboard.parquet": workspace.tables.read_all(LEADERBOARD),
        "two_way.parquet": _two_events_alone(workspace.tables.read_all(TWO_WAY)),
    }
    empty = [file.partition(".")[0] for file, frame in frames.items() if frame.empty and file != "two_way.parquet"]
    if empty:
        raise TrapsError(f"{workspace.root}: has no {', '.join(empty)}; run it first: traps run EXPERIMENT")
    frames["votes.parquet"] = frames["votes.parquet"].loc[lambda votes: votes["panel"] == panel_id(study.panel)]
    content = {file: table_bytes(TABLES[file], frame) for file, frame in frames.items()}
    seats = [
        SubmittedJudge.model_validate({name: getattr(seat, name) for name in SubmittedJudge.model_fields})
        for seat in load_panel(study.panel)
    ]
    try:
        description = SubmissionAbout(
            name=name,
            benchmark=load_release().name,
            version=load_release().version,
            panel=study.panel,
            judges=tuple(seats),
            judged_by_rules=study.judged_by_rules,
            prompts={regime: prompt_version(regime) for regime in sorted({*frames["responses.parquet"]["regime"]})},
            versions={"traps": version("traps-pipeline"), "rules": str(RULES_VERSION), "reading": READING},
            files={file: hashlib.sha256(data).hexdigest() for file, data in content.items()},
        )
    except ValidationError as error:
        raise TrapsError(f"--name {name!r:.100}: {faults_of(error)}; use letters a to z, digits, - and .") from error
    write_bytes(target, pack_archive({ABOUT: description.model_dump_json(indent=1).encode() + b"\n", **content}))
    return description


def _two_events_alone(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the TWO_WAY rows of two events, without what arms give, which are not submitted."""
    return rows.loc[rows["n_scenarios"] > 0].assign(inference_acc=None, inference_abstains=None)


def table_bytes(table: Table[Any], frame: pd.DataFrame) -> bytes:
    """Return rows as Parquet, sorted by the table's key; equal rows give equal bytes."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    data = pa.Table.from_pandas(frame, schema=table.arrow_schema(), preserve_index=False)
    data = data.replace_schema_metadata(None).sort_by([(name, "ascending") for name in table.key])
    buffer = io.BytesIO()
    pq.write_table(data, buffer, compression="zstd")
    return buffer.getvalue()


# --- reading ----------------------------------------------------------------------------------------------------------


def read_submission(path: Path) -> Submission:
    """Return a submission. Raises TrapsError for anything unexpected in the file."""
    try:
        size = path.stat().st_size
        if size > MAX_FILE_BYTES:
            raise TrapsError(f"{path}: has {size} bytes, at most {MAX_FILE_BYTES} are read; submit models one by one")
        with reading_archive(), zipfile.ZipFile(path) as archive:
            content = _members(path, archive)
    except OSError as error:
        raise TrapsError(
            f"{path}: cannot be read ({error.strerror}); name a file that `traps publish submit` wrote"
        ) from error
    except BadArchive as error:
        raise TrapsError(f"{path}: is no submission ({plain(error)[:200]}); get it again") from error
    try:
        description = SubmissionAbout.model_validate_json(content[ABOUT])
    except ValidationError as error:
        raise TrapsError(f"{path}: {ABOUT}: {faults_of(error)}; pack it again with `traps publish submit`") from error
    altered_tables = [
        file for file in TABLES if description.files.get(file) != hashlib.sha256(content[file]).hexdigest()
    ]
    frames = {file: _frame(path, file, content[file]) for file in TABLES}
    return Submission(path, description, frames, tuple(altered_tables))


def _members(path: Path, archive: zipfile.ZipFile) -> dict[str, bytes]:
    entries = archive.infolist()
    expected = sorted([ABOUT, *TABLES])
    if sorted(entry.filename for entry in entries) != expected:
        raise TrapsError(f"{path}: is no submission: it holds other files than {', '.join(expected)}")
    for entry in entries:
        # Stored, so that no entry can be larger than the file; Parquet compresses its own columns.
        if entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & 1:
            raise TrapsError(
                f"{path}: {entry.filename} is compressed or encrypted; pack it with `traps publish submit`"
            )
        if entry.filename == ABOUT and entry.file_size > MAX_ABOUT_BYTES:
            raise TrapsError(f"{path}: {ABOUT} has {entry.file_size} bytes, at most {MAX_ABOUT_BYTES} are read")
    return {entry.filename: archive.read(entry) for entry in entries}


def _frame(path: Path, file: str, content: bytes) -> pd.DataFrame:
    """Unpack a submitted table; check its size before, and its columns after."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = TABLES[file]
    schema = table.arrow_schema()
    try:
        parquet = pq.ParquetFile(pa.BufferReader(content))
        groups = [parquet.metadata.row_group(i) for i in range(parquet.metadata.num_row_groups)]
        chunks = [group.column(i) for group in groups for i in range(group.num_columns)]
        n_values, size = (sum(getattr(c, n) for c in chunks) for n in ("num_values", "total_uncompressed_size"))
        if n_values > MAX_VALUES or size > MAX_TABLE_BYTES:
            raise TrapsError(f"{path}: {file} is too large ({n_values} values, {size} bytes); submit models one by one")
        if parquet.schema_arrow.names != schema.names or parquet.schema_arrow.types != schema.types:
            raise TrapsError(f"{path}: {file} has other columns than this version's; pack it again, or verify it there")
        texts = {chunk.path_in_schema for chunk in chunks if chunk.physical_type == "BYTE_ARRAY"}
        data = _with_bounded_texts(path, file, pq.ParquetFile(pa.BufferReader(content), read_dictionary=sorted(texts)))
        data = data.cast(parquet.schema_arrow).replace_schema_metadata(None)  # a stranger's would decide what is read
        frame = data.to_pandas(ignore_metadata=True)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise TrapsError(f"{path}: {file} is no readable table ({plain(error)[:200]}); pack it again") from error
    for column in schema:
        if not column.nullable and data[column.name].null_count:
            raise TrapsError(f"{path}: {file}: column {column.name} has missing values")
    keys = frame[list(table.key)]
    if keys.duplicated().any():
        raise TrapsError(f"{path}: {file}: {records(keys.loc[keys.duplicated()])[0]} stands there twice")
    return frame


def _with_bounded_texts(path: Path, file: str, parquet: pq.ParquetFile) -> pa.Table:
    """Return a table, its texts as dictionaries that store one of many rows once. Raises TrapsError for large texts."""
    import pyarrow.compute

    pc: Any = pyarrow.compute  # it creates its functions on import, invisible to type checkers
    data, longest, total = parquet.read(), 0, 0
    for column in data.columns:
        texts = pc.list_flatten(column) if pyarrow.types.is_list(column.type) else column
        for chunk in texts.chunks if pyarrow.types.is_dictionary(texts.type) else ():
            sizes = pc.binary_length(chunk.dictionary).take(chunk.indices)
            longest, total = max(longest, pc.max(sizes).as_py() or 0), total + (pc.sum(sizes).as_py() or 0)
    if longest > MAX_TEXT_BYTES or total > MAX_TABLE_BYTES:
        raise TrapsError(
            f"{path}: {file}: its longest text has {longest} bytes and all have {total}, at most {MAX_TEXT_BYTES} and "
            f"{MAX_TABLE_BYTES} are read; submit models one by one, without such texts"
        )
    return data
