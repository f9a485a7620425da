# pyright: reportMissingImports=false
"""Run the benchmark with inspect_ai (`inspect eval traps_task.py -T regime=...`)."""

from __future__ import annotations

from typing import Any

from inspect_ai import Task, task
from inspect_ai.dataset import MemoryDataset, Sample
from inspect_ai.model import ChatMessageSystem, ChatMessageUser, ContentImage, ContentText, ContentVideo, GenerateConfig
from inspect_ai.scorer import Score, metric, scorer
from inspect_ai.solver import generate

from traps_pipeline.release.harness.harness_items import about, harness_prompt, items, media_of
from traps_pipeline.release.harness.scoring import PanelDecision, judge, run_metrics

_OUTCOMES = {"max_tokens": "truncated", "model_length": "truncated", "content_filter": "refused"}


@task
def traps(regime: str = "standard") -> Any:
    """Return the task of the installed package: `inspect eval traps_harness/traps`."""
    return evaluation(regime)


def evaluation(regime: str) -> Any:
    """Return a task with all items under a regime, once; each run is an evaluation."""
    system = harness_prompt(regime)
    samples = [
        Sample(
            id=item["item_id"],
            input=[ChatMessageSystem(content=system), ChatMessageUser(content=[*_media_content(item), _text(item)])],
            target=item["ground_truth"] or "",
            metadata={"item_id": item["item_id"], "dataset": item["dataset"], "side": item["side"], "regime": regime},
        )
        for item in items()
    ]
    release = about()
    return Task(
        dataset=MemoryDataset(samples, name=release["name"]),
        solver=generate(),
        scorer=panel(regime),
        config=GenerateConfig(**release["parameters"]),
        version=release["version"],
        metadata={"canary": release["canary"], "panel": release["panel"]},
    )


def _media_content(item: dict[str, Any]) -> list[Any]:
    paths = [str(path) for path in media_of(item)]
    if paths[0].endswith(".mp4"):
        return [ContentVideo(video=path, format="mp4") for path in paths]
    return [ContentImage(image=path) for path in paths]


def _text(item: dict[str, Any]) -> Any:
    return ContentText(text=item["question"])


@metric
def traps_metrics() -> Any:
    """Return PECS and its factors, overall and by dataset, and the metrics of two events."""

    def compute(scores: list[Any]) -> dict[str, float]:
        results = run_metrics(PanelDecision.of(score.score.metadata) for score in scores)
        return {name: value for name, value in results.items() if value is not None}

    return compute


@scorer(metrics=[traps_metrics()])
def panel(regime: str) -> Any:
    """Return the rule panel as scorer: 1 for a correct control or an abstained void."""
    item_of = {item["item_id"]: item for item in items()}

    async def score(state: Any, target: Any) -> Any:
        outcome = _OUTCOMES.get(state.output.stop_reason, "answer")
        judged = judge(item_of[str(state.sample_id)], outcome, state.output.completion, regime)
        return Score(value=float(judged.is_right), answer=state.output.completion, metadata={**vars(judged)})

    return score
