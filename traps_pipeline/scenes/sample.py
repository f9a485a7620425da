"""Drawing scenarios of a family until its quotas are full, and writing them down as released records."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from traps_pipeline.scenes.kit import Family, Wording
from traps_pipeline.scenes.resolve import Rejected, resolve
from traps_pipeline.scenes.spec import SceneSpec, save_trajectory


@dataclass
class Sample:
    """Accepted scenarios with their trajectories, and why the others were rejected."""

    scenarios: list[tuple[SceneSpec, np.ndarray]] = field(default_factory=list)
    rejections: Counter[str] = field(default_factory=Counter)


def answer_quota(count: int, n_labels: int) -> int:
    """How often one answer may occur among `count` scenarios: the even split rounded up, once more for three labels
    or more (rare buckets would otherwise never fill)."""
    return math.ceil(count / n_labels) + (n_labels > 2)


def sample_family(
    family: Family, count: int, seed: int, *, max_draws: int = 2000, report: Callable[[str], None] = lambda _: None
) -> Sample:
    """Draw until `count` scenarios are accepted. The same seed gives the same scenarios on the same machine type.

    Raises RuntimeError with the tally of rejections when `max_draws` draws are not enough.
    """
    sample, answers, ill_posed = Sample(), Counter[str](), set[str]()
    for draw in range(max_draws):
        if len(sample.scenarios) == count:
            return sample
        rng = np.random.default_rng([seed, *family.name.encode(), draw])
        params = family.draw(rng)
        wording = _fresh_wording(family, params, rng, ill_posed)
        scenario_id = f"{family.name}-{len(sample.scenarios) + 1:04d}"
        try:
            if wording is None:
                raise Rejected("every ill-posed question drawn is taken")
            spec, qpos = resolve(family, params, wording, scenario_id=scenario_id, seed=draw)
            if answers[spec.ground_truth] >= answer_quota(count, len(spec.labels)):
                raise Rejected(f"answer {spec.ground_truth!r} has its quota")
        except Rejected as rejected:
            sample.rejections[str(rejected).split(":")[0]] += 1
            continue
        answers[spec.ground_truth] += 1
        ill_posed.add(spec.ill_posed_question)
        sample.scenarios.append((spec, qpos))
        report(f"{scenario_id}: {spec.ground_truth} after {draw + 1} draws {json.dumps(spec.evidence)}")
    if len(sample.scenarios) < count:
        tally = ", ".join(f"{n} x {reason}" for reason, n in sample.rejections.most_common())
        raise RuntimeError(
            f"{family.name}: {len(sample.scenarios)} of {count} after {max_draws} draws; rejected: {tally}"
        )
    return sample


def _fresh_wording(family: Family, params: object, rng: np.random.Generator, taken: set[str]) -> Wording | None:
    """Words whose ill-posed question no other scenario of an occlusion family has."""
    for _ in range(50):
        wording = family.word(params, rng)
        if family.taxonomy == "chaotic" or wording.ill_posed_question not in taken:
            return wording
    return None


def write_released(folder: Path, family: Family, sample: Sample) -> None:
    """`<folder>/<family>.jsonl`, one record a line, and `<folder>/trajectories/<scenario_id>.npz`."""
    folder.mkdir(parents=True, exist_ok=True)
    for spec, qpos in sample.scenarios:
        save_trajectory(folder / "trajectories", spec.scenario_id, qpos)
    lines = [json.dumps(spec.model_dump(mode="json"), ensure_ascii=False) for spec, _ in sample.scenarios]
    (folder / f"{family.name}.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")
