"""Drawing scenarios of a family until its quotas are full, and writing them down as released records."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from traps_pipeline.scenes.kit import Family
from traps_pipeline.scenes.outcome import Rejected, compile_scene, read_outcome
from traps_pipeline.scenes.resolve import Resolved, resolve
from traps_pipeline.scenes.simulate import replay, simulate
from traps_pipeline.scenes.spec import save_trajectory
from traps_pipeline.scenes.wording import draw_ill_posed


@dataclass
class Sample:
    """Accepted scenarios with their trajectories, and why the others were rejected."""

    scenarios: list[Resolved] = field(default_factory=list)
    rejections: Counter[str] = field(default_factory=Counter)


def answer_quota(count: int, n_labels: int) -> int:
    """How often one answer may occur among `count` scenarios of a family.

    Under ten: once more than the even split, rounded up. Else 60 % of two answers, 1.5 times the fair share of more.
    """
    if count < 10:
        return math.ceil(count / n_labels) + 1
    return math.floor(count * (0.6 if n_labels == 2 else 1.5 / n_labels))


def ill_posed_quota(family: Family, count: int) -> int:
    """How often one ill-posed text may occur: once in an occlusion family, in 5 % of a chaotic one."""
    return 1 if family.taxonomy == "occlusion" else max(1, count // 20)


def sample_family(
    family: Family, count: int, seed: int, *, max_draws: int = 4000, report: Callable[[str], None] = lambda _: None
) -> Sample:
    """Draw until `count` scenarios are accepted. The same seed gives the same scenarios on the same machine type.

    Raises RuntimeError with the tally of rejections when `max_draws` draws are not enough.
    """
    sample, answers, texts = Sample(), Counter[str](), Counter[str]()
    for draw in range(max_draws):
        if len(sample.scenarios) == count:
            return sample
        scenario_id = f"{family.name}-{len(sample.scenarios) + 1:04d}"
        try:
            found = attempt(family, seed, draw, scenario_id, answers, texts, count)
        except Rejected as rejected:
            sample.rejections[str(rejected).split(":")[0]] += 1
            continue
        answers[found.spec.ground_truth] += 1
        texts[found.spec.ill_posed_question] += 1
        sample.scenarios.append(found)
        report(f"{scenario_id}: {found.spec.ground_truth} after {draw + 1} draws {json.dumps(found.spec.evidence)}")
    if len(sample.scenarios) < count:
        tally = ", ".join(f"{n} x {reason}" for reason, n in sample.rejections.most_common())
        raise RuntimeError(
            f"{family.name}: {len(sample.scenarios)} of {count} after {max_draws} draws; rejected: {tally}"
        )
    return sample


def attempt(
    family: Family, seed: int, draw: int, scenario_id: str, answers: Counter[str], texts: Counter[str], count: int
) -> Resolved:
    """One draw, resolved. Raises Rejected when it makes no valid pair or its answer has its quota."""
    rng = np.random.default_rng([seed, *family.name.encode(), draw])
    params = family.draw(rng)
    wording = family.word(params, rng)
    full = answer_quota(count, len(wording.labels))
    answer = simulated_answer(family, params)
    if answers[answer] >= full:
        raise Rejected(f"answer {answer!r} has its quota")
    inventory = family.build(params, family.physics).inventory
    most = ill_posed_quota(family, count)
    question = draw_ill_posed(family.taxonomy, inventory, rng, lambda text: texts[text] < most)
    return resolve(family, params, wording, question, scenario_id=scenario_id, seed=draw)


def simulated_answer(family: Family, params: Any) -> str:
    """What the control of a draw shows: a second's work, so that a draw without a place costs no certificates."""
    model, scene = compile_scene(family, params, family.physics)
    try:
        qpos = simulate(model, scene, family.physics)
    except FloatingPointError as error:
        raise Rejected(str(error)) from error
    return read_outcome(family, replay(model, qpos, family.physics), params).label


def write_released(folder: Path, family: Family, sample: Sample) -> None:
    """`<folder>/<family>.jsonl`, one record a line, and `<folder>/trajectories/<scenario_id>.npz`."""
    folder.mkdir(parents=True, exist_ok=True)
    for found in sample.scenarios:
        save_trajectory(folder / "trajectories", found.spec.scenario_id, found.qpos, found.twin)
    lines = [json.dumps(found.spec.model_dump(mode="json"), ensure_ascii=False) for found in sample.scenarios]
    (folder / f"{family.name}.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")
