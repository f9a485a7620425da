"""Export a leaderboard as the hub's `.eval_results`, Every Eval Ever, and Parquet."""

import json
import re
import uuid
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_bytes, write_text
from traps_pipeline.base.wording import count_noun
from traps_pipeline.benchmark.records import Release, load_release
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.models.registry.entries import is_reference
from traps_pipeline.protocol.metric_words import METRIC_WORDS
from traps_pipeline.release.submission import table_bytes
from traps_pipeline.scoring.bootstrap import RESAMPLES
from traps_pipeline.scoring.score_rows import LEADERBOARD
from traps_pipeline.storage.benchmark_tables import current_rows
from traps_pipeline.storage.workspace import Workspace

HUB, EVER, PARQUET = "eval_results", "data", "leaderboard.parquet"
OWN_DEVELOPER = "traps-pipeline"  # developer of the reference strategies
EVER_SCHEMA = "0.3.0"  # schema version of Every Eval Ever
_REPOSITORY = re.compile(r"[\w.-]+/[\w.-]+")
_UNKNOWN = {"deployment_type": "unknown", "model_availability": "unknown"}
Row = Mapping[str, Any]


@dataclass(frozen=True)
class Attribution:
    """The evaluating organization, and the developer of all but reference strategies."""

    organization: str = "unknown"
    developer: str = "unknown"

    def developer_of(self, model: str) -> str:
        """Return the organization that made a model."""
        return OWN_DEVELOPER if is_reference(model) else self.developer


def write_results(workspace: Workspace, target: Path, dataset: str, who: Attribution) -> list[str]:
    """Write all rows as Parquet, and models' overall scores; return the files.

    dataset: the repository of the release, as the hub names it.

    `eval_results/MODEL.yaml` goes into the model's repository as `.eval_results/traps.yaml`, with a task for each
    regime; `data/` has the layout of Every Eval Ever, with each metric and its interval. Raises TrapsError if there is
    no overall metric.
    """
    if not _REPOSITORY.fullmatch(dataset):
        raise TrapsError(f"--dataset {dataset!r:.80}: is no repository of the hub; write it as OWNER/NAME")
    board, release = workspace.tables.read_all(LEADERBOARD), load_release()
    overall = board.loc[(board["dataset"] == "overall") & board["pecs"].notna()]
    if overall.empty:
        raise TrapsError(f"{workspace.root}: no model has all four datasets yet; run the experiment first")
    asked: Any = current_rows(workspace, RESPONSES, ["item_id", "model", "created_at"]).groupby("model")
    files = []
    for model, rows in overall.groupby("model", sort=True):
        entries = [{str(k): v for k, v in row.items()} for row in rows.to_dict("records")]
        evaluated_at = asked["created_at"].max()[str(model)]
        hub = [_hub_entry(row, dataset, evaluated_at) for row in entries]
        files.append(f"{HUB}/{model}.yaml")
        write_text(target / files[-1], yaml.safe_dump(hub, sort_keys=False, allow_unicode=True))
        record = _every_eval_record(str(model), entries, dataset, who, evaluated_at, release)
        name = uuid.UUID(digest(record)[:32], version=4)  # in the form of the random ids that the collection asks for
        files.append(f"{EVER}/{release.name}/{who.developer_of(str(model))}/{model}/{name}.json")
        write_text(target / files[-1], json.dumps(record, indent=1, ensure_ascii=False) + "\n")
    write_bytes(target / PARQUET, table_bytes(LEADERBOARD, board))
    return [*files, PARQUET]


def _hub_entry(row: Row, dataset: str, when: pd.Timestamp) -> dict[str, Any]:
    runs, version = count_noun(row["n_runs"], "run"), row["benchmark_version"]
    notes = f"PECS (0 to 1), mean of {runs}; panel {row['panel']}; benchmark {version}"
    return {
        "dataset": {"id": dataset, "task_id": f"traps_{row['regime']}"},
        "value": float(row["pecs"]),
        "date": when.strftime("%Y-%m-%dT%H:%M:%SZ"),
        "notes": notes,
    }


def _every_eval_record(
    model: str, rows: list[dict[str, Any]], dataset: str, who: Attribution, when: pd.Timestamp, release: Release
) -> dict[str, Any]:
    seconds = str(int(when.timestamp()))
    return {
        "schema_version": EVER_SCHEMA,
        "evaluation_id": f"{release.name}/{model}/{seconds}",
        "evaluation_timestamp": seconds,
        "retrieved_timestamp": seconds,
        "source_metadata": {
            "source_name": release.name,
            "source_type": "evaluation_run",
            "source_organization_name": who.organization,
            "evaluator_relationship": "other",
        },
        "eval_library": {"name": "traps-pipeline", "version": version("traps-pipeline")},
        "model_info": {
            "name": model,
            "id": f"{who.developer_of(model)}/{model}",
            "developer": who.developer_of(model),
            "additional_details": _UNKNOWN,
        },
        "evaluation_results": [result for row in rows for result in _every_eval_results(row, dataset, release)],
    }


def _every_eval_results(row: Row, dataset: str, release: Release) -> Iterator[dict[str, Any]]:
    for name, metric in METRIC_WORDS.items():
        score: dict[str, Any] = {"score": float(row[name]), "details": {"panel": row["panel"], "epoch": row["epoch"]}}
        low, high = row[f"{name}_ci_low"], row[f"{name}_ci_high"]
        if pd.notna(low) and pd.notna(high):
            interval: dict[str, Any] = {"lower": float(low), "upper": float(high), "confidence_level": 0.95}
            interval["method"] = "Bayesian bootstrap over scenarios with one unseen"
            score["uncertainty"] = {"confidence_interval": interval, "num_bootstrap_samples": RESAMPLES}
        yield {
            "evaluation_result_id": f"{release.name}/{row['regime']}/{name}",
            "evaluation_name": f"{release.name} {row['benchmark_version']}, {row['regime']}",
            "source_data": {
                "dataset_name": release.name,
                "source_type": "hf_dataset",
                "hf_repo": dataset,
                "hf_split": "test",
                "samples_number": int(row["n_items"]),
            },
            "metric_config": {
                "evaluation_description": metric.meaning,
                "metric_id": f"{release.name}.{name}",
                "metric_name": name,
                "metric_unit": "proportion",
                "lower_is_better": metric.less_is_better,
                "score_type": "continuous",
                "min_score": metric.lowest,
                "max_score": 1.0,
            },
            "score_details": score,
        }
