# pyright: reportMissingImports=false
"""Define the functions that the YAML files of lmms-eval tasks name."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # lmms-eval loads this file alone, from any folder

from traps_pipeline.release.harness.harness_items import harness_prompt, media_of
from traps_pipeline.release.harness.scoring import RUN_METRICS, TWO_WAY_METRICS, PanelDecision, judge, run_metrics


def doc_to_visual(doc: dict[str, Any]) -> list[Any]:
    """Return the clip's path, or its frames in order."""
    from PIL import Image

    paths = media_of(doc)
    if paths[0].suffix == ".mp4":
        return [str(path) for path in paths]
    return [Image.open(path).convert("RGB") for path in paths]


def doc_to_target(doc: dict[str, Any]) -> str:
    """Return the right answer; empty on a void."""
    return doc["ground_truth"] or ""


def _text(doc: dict[str, Any], lmms_eval_specific_kwargs: Any = None, *, regime: str) -> str:
    """Return system prompt and question as one text, for models without the former."""
    return f"{harness_prompt(regime)}\n\n{doc['question']}"


def _messages(doc: dict[str, Any], lmms_eval_specific_kwargs: Any = None, *, regime: str) -> list[dict[str, Any]]:
    """Return chat messages: system prompt, then the clip and the question."""
    visuals = doc_to_visual(doc)
    kind = "video" if isinstance(visuals[0], str) else "image"
    content = [{"type": kind, "url": visual} for visual in visuals]
    return [
        {"role": "system", "content": [{"type": "text", "text": harness_prompt(regime)}]},
        {"role": "user", "content": [*content, {"type": "text", "text": doc["question"]}]},
    ]


def _results(doc: dict[str, Any], results: list[str], *, regime: str) -> dict[str, Any]:
    """Return the panel's decision about an answer, under the name of each metric."""
    judged = {**vars(judge(doc, "answer", results[0], regime)), "regime": regime}
    return dict.fromkeys((f"traps_{name}" for name in NAMES), judged)


def _metric(rows: list[dict[str, Any]], *, name: str) -> float | None:
    return run_metrics(PanelDecision.of(row) for row in rows).get(name)


NAMES = (*RUN_METRICS, *TWO_WAY_METRICS, "missing", "unread")
_BY_REGIME = {"text": _text, "messages": _messages, "results": _results}  # a task of a regime names `REGIME_text`


def __getattr__(name: str) -> Callable[..., Any]:
    """Return a function by its name in a task's YAML: a metric's, or a regime's (`guided_results`)."""
    if name in NAMES:
        return partial(_metric, name=name)
    regime, _, kind = name.rpartition("_")
    if not regime or kind not in _BY_REGIME:
        raise AttributeError(name)
    return partial(_BY_REGIME[kind], regime=regime)
