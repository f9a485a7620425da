"""Drawing scenarios of a family until its quotas are full, and writing them down as released records.

Draws are numbered and independent, so they run on all cores; acceptance goes through them in order, so that the same
seed gives the same scenarios. Every finished draw is kept on disk at once: a sampling that was stopped goes on.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from traps_pipeline.scenes.kit import Family
from traps_pipeline.scenes.outcome import Rejected, compile_scene, read_outcome
from traps_pipeline.scenes.registry import get_family
from traps_pipeline.scenes.resolve import Resolved, resolve
from traps_pipeline.scenes.simulate import replay, simulate
from traps_pipeline.scenes.spec import SceneSpec, load_trajectory, save_trajectory
from traps_pipeline.scenes.wording import draw_ill_posed
from traps_pipeline.scenes.workers import run_in_order

MOST_DRAWS = 40  # for each scenario wanted; a family that needs more is not worth its time
_UNASKED = "?"  # stands for the ill-posed question until the scenario has its place


@dataclass
class Sample:
    """Accepted scenarios with their trajectories, how many draws they took, and why the others were rejected."""

    scenarios: list[Resolved] = field(default_factory=list)
    draws: int = 0
    rejections: Counter[str] = field(default_factory=Counter)


def answer_quota(count: int, n_labels: float) -> int:
    """How often one answer may occur among `count` scenarios of a family.

    Under ten: once more than the even split, rounded up. Else 60 % of two answers, 1.5 times the fair share of more.
    """
    if count < 10:
        return math.ceil(count / n_labels) + 1
    return math.floor(count * (0.6 if n_labels == 2 else 1.5 / n_labels))


def ill_posed_quota(taxonomy: str, count: int) -> int:
    """How often one ill-posed text may occur: once in an occlusion family, in 5 % of a chaotic one."""
    return 1 if taxonomy == "occlusion" else max(1, count // 20)


@dataclass(frozen=True)
class Draw:
    """One numbered draw of a family. closed: answers that have their quota already and need not be resolved."""

    family: str
    seed: int
    number: int
    closed: frozenset[str]
    folder: Path

    @property
    def file(self) -> Path:
        """Where its result is kept."""
        return self.folder / f"{self.number:05d}.json"


def sample_family(
    name: str,
    count: int,
    seed: int,
    folder: Path,
    *,
    workers: int | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> Sample:
    """Draw until `count` scenarios are accepted. The same seed gives the same scenarios on the same machine type.

    folder keeps the draws, so that a sampling that was stopped goes on. Raises RuntimeError with the tally of
    rejections when 40 draws a scenario are not enough.
    """
    family, sample = get_family(name), Sample()
    answers, texts = Counter[str](), Counter[str]()
    folder.mkdir(parents=True, exist_ok=True)

    def jobs() -> Iterator[Draw]:
        for number in range(MOST_DRAWS * count):
            yield Draw(name, seed, number, _closed(answers, count, family), folder)

    results = run_in_order(try_draw, jobs(), workers)
    try:
        for draw, reason in results:
            sample.draws += 1
            found = None if reason else _load(draw)
            if found is not None and found.spec.ground_truth in _closed(answers, count, family):
                found, reason = None, f"answer {found.spec.ground_truth!r} has its quota"
            if found is None:
                sample.rejections[str(reason).split(":")[0]] += 1
                continue
            named = _named(family, found, draw, len(sample.scenarios) + 1, texts, count)
            answers[named.spec.ground_truth] += 1
            texts[named.spec.ill_posed_question] += 1
            sample.scenarios.append(named)
            report(f"{named.spec.scenario_id}: {named.spec.ground_truth} after {sample.draws} draws")
            if len(sample.scenarios) == count:
                return sample
    finally:
        results.close()  # type: ignore[attr-defined]
    tally = ", ".join(f"{n} x {reason}" for reason, n in sample.rejections.most_common())
    raise RuntimeError(f"{name}: {len(sample.scenarios)} of {count} after {sample.draws} draws; rejected: {tally}")


def _closed(answers: Counter[str], count: int, family: Family) -> frozenset[str]:
    labels = _label_count(family)
    return frozenset(answer for answer, n in answers.items() if n >= answer_quota(count, labels))


@cache
def _label_count(family: Family) -> float:
    """Choices of a question of the family, on average over draws (plinko has boards of five to seven buckets)."""
    rng = np.random.default_rng(0)
    return float(np.mean([len(family.word(family.draw(rng), rng).labels) for _ in range(32)]))


def try_draw(draw: Draw) -> str | None:
    """Resolve a draw and keep it; None if it is a valid pair, else why it is rejected."""
    if draw.file.is_file():
        return json.loads(draw.file.read_text(encoding="utf-8")).get("rejected")
    family = get_family(draw.family)
    rng = _generator(draw)
    params = family.draw(rng)
    wording = family.word(params, rng)
    try:
        answer = simulated_answer(family, params)
        if answer in draw.closed:
            return f"answer {answer!r} has its quota"  # not kept: it depends on the draws before
        found = resolve(family, params, wording, _UNASKED, scenario_id=f"{family.name}-0000", seed=draw.number)
    except Rejected as rejected:
        _write(draw.file, {"rejected": str(rejected)})
        return str(rejected)
    save_trajectory(draw.folder, draw.file.stem, found.qpos, found.twin)
    _write(draw.file, {"record": found.spec.model_dump(mode="json")})
    return None


def _generator(draw: Draw) -> np.random.Generator:
    return np.random.default_rng([draw.seed, *draw.family.encode(), draw.number])


def _write(path: Path, record: dict[str, Any]) -> None:
    part = path.with_suffix(".part")
    part.write_text(json.dumps(record), encoding="utf-8")
    part.replace(path)


def _load(draw: Draw) -> Resolved:
    spec = SceneSpec.model_validate(json.loads(draw.file.read_text(encoding="utf-8"))["record"])
    path = draw.file.with_suffix(".npz")
    return Resolved(
        spec,
        load_trajectory(path, spec.trajectory_sha256),
        load_trajectory(path, spec.twin.trajectory_sha256, "twin"),
    )


def _named(family: Family, found: Resolved, draw: Draw, place: int, texts: Counter[str], count: int) -> Resolved:
    """The scenario with its id and an ill-posed question that its family still has room for."""
    physics = family.physics
    inventory = family.build(family.params_from(found.spec.params), physics).inventory
    most = ill_posed_quota(family.taxonomy, count)
    rng = np.random.default_rng([draw.seed, *draw.family.encode(), draw.number, place])
    question = draw_ill_posed(family.taxonomy, inventory, rng, lambda text: texts[text] < most)
    names = {"scenario_id": f"{family.name}-{place:04d}", "ill_posed_question": question}
    return Resolved(found.spec.model_copy(update=names), found.qpos, found.twin)


def simulated_answer(family: Family, params: Any) -> str:
    """What the control of a draw shows: a second's work, so that a draw without a place costs no certificates."""
    model, scene = compile_scene(family, params, family.physics)
    try:
        qpos = simulate(model, scene, family.physics)
    except FloatingPointError as error:
        raise Rejected(str(error)) from error
    return read_outcome(family, replay(model, qpos, family.physics), params).label


def write_released(folder: Path, name: str, sample: Sample) -> None:
    """`<folder>/<family>.jsonl`, one record a line, and `<folder>/trajectories/<scenario_id>.npz`."""
    folder.mkdir(parents=True, exist_ok=True)
    for old in (folder / "trajectories").glob(f"{name}-*.npz"):
        old.unlink()
    for found in sample.scenarios:
        save_trajectory(folder / "trajectories", found.spec.scenario_id, found.qpos, found.twin)
    lines = [json.dumps(found.spec.model_dump(mode="json"), ensure_ascii=False) for found in sample.scenarios]
    (folder / f"{name}.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")
