"""Sample a benchmark with set numbers of scenarios, and check it as a whole."""

import uuid
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import yaml
from pydantic import RootModel, ValidationError

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_text
from traps_pipeline.base.paths import SCENE_SPECS
from traps_pipeline.base.wording import count_noun
from traps_pipeline.base.workers import keep_workers
from traps_pipeline.base.yamlfile import faults_of, read_yaml
from traps_pipeline.benchmark.items import commonest_answers
from traps_pipeline.scenes.draw.draw_lanes import lane_families, sample_two_events
from traps_pipeline.scenes.draw.sample import answer_quota, ill_posed_quota, require_difficulty, sample_family
from traps_pipeline.scenes.parts.difficulty import DEFAULT_DIFFICULTY, Difficulty
from traps_pipeline.scenes.worlds.spec import SceneSpec

PRIOR_AT_MOST = 0.55  # accuracy of the commonest answer, occlusion and chaotic weighted equally


class Composition(RootModel[dict[str, int]]):
    """The number of scenarios of each family."""


def load_composition(path: Path = SCENE_SPECS / "composition.yaml") -> dict[str, int]:
    """Return each family's number of scenarios. Raises TrapsError naming the file."""
    try:
        return Composition.model_validate(read_yaml(path)).root
    except ValidationError as error:
        raise TrapsError(f"{path}: {faults_of(error)}") from error


def sample_benchmark(
    out: Path,
    counts: Mapping[str, int],
    seed: int,
    name: str,
    *,
    look: Collection[str] = (),
    difficulty: Difficulty = DEFAULT_DIFFICULTY,
    two_events: int = 0,
    workers: int | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> int:
    """Sample a benchmark into `out`: records, trajectories, and `benchmark.yaml`; return its number of scenarios.

    two_events: how many scenarios of two events of each of these families that has them. It has a canary of its own.
    Existing records of the same seed and numbers stay: an interrupted sampling resumes.
    Raises TrapsError if a family cannot be filled, or does not support a setting of the difficulty.
    """
    of_pairs = replace(difficulty, window_s=DEFAULT_DIFFICULTY.window_s)
    require_difficulty(counts, of_pairs)
    with keep_workers():
        for family, count in ((family, count) for family, count in counts.items() if count):
            released = out / "released"
            tally = sample_family(
                family, count, seed, released, look=look, difficulty=of_pairs, workers=workers, report=report
            )
            reasons = ", ".join(f"{n} x {reason}" for reason, n in tally.rejected.most_common()) or "none rejected"
            report(f"{family}: {count} of {count_noun(tally.draws, 'draw')}; {reasons}")
        names = [family for family in lane_families() if family in counts]
        drawn = (names, two_events, seed, out / "two_events" / "released", difficulty)
        lanes = sample_two_events(*drawn, workers=workers, report=report) if two_events else 0
    name_benchmark(out, name)
    return sum(counts.values()) + lanes


def name_benchmark(out: Path, name: str) -> None:
    """Write `benchmark.yaml` with a canary of its own, unless the folder has one."""
    if not (out / "benchmark.yaml").exists():
        release = {"name": name, "version": "1.0.0", "canary": f"{name.upper()}:CANARY:{uuid.uuid4()}"}
        write_text(out / "benchmark.yaml", yaml.safe_dump(release, sort_keys=False))


def composition_problems(specs: Sequence[SceneSpec], counts: Mapping[str, int] | None = None) -> list[str]:
    """Return in words what is wrong with all records together, and with their numbers against `counts`."""
    families: defaultdict[str, list[SceneSpec]] = defaultdict(list)
    for spec in specs:
        families[spec.family].append(spec)
    messages = [] if counts is None else _wrong_counts(families, counts)
    for family, members in families.items():
        messages += _imbalances(family, members)
        messages += _repeated_questions(family, members)
        messages += _constant_margin(family, members)
    trajectories = [(spec.trajectory_sha256 + spec.scene_hash, spec.scenario_id) for spec in specs]
    messages += repeated(trajectories, "the same trajectory")
    accuracy = prior_accuracy(specs) if counts is not None else 0.0
    if accuracy > PRIOR_AT_MOST:
        messages.append(
            f"the commonest answer of each sub-scenario is right in {accuracy:.3f}, at most {PRIOR_AT_MOST} allowed"
        )
    return messages


def _wrong_counts(families: Mapping[str, Sequence[SceneSpec]], counts: Mapping[str, int]) -> list[str]:
    return [
        f"{family}: {count_noun(len(families.get(family, ())), 'scenario')}, {counts.get(family, 0)} wanted"
        for family in sorted({*families, *counts})
        if len(families.get(family, ())) != counts.get(family, 0)
    ]


def _imbalances(family: str, members: Sequence[SceneSpec]) -> list[str]:
    messages = []
    for answer, n in Counter(spec.ground_truth for spec in members).items():
        choices = [len(spec.labels) for spec in members if answer in spec.labels]
        quota = answer_quota(len(members), len(members) / sum(1 / c for c in choices))  # the fair share of this answer
        if n > quota:
            messages.append(f"{family}: answer {answer!r} occurs {n} times, at most {quota} allowed")
    return messages


def _repeated_questions(family: str, members: Sequence[SceneSpec]) -> list[str]:
    quota = ill_posed_quota(members[0].taxonomy, len(members))
    texts = Counter(spec.ill_posed_question for spec in members)
    return [f"{family}: {text!r} is asked {n} times, at most {quota} allowed" for text, n in texts.items() if n > quota]


def _constant_margin(family: str, members: Sequence[SceneSpec]) -> list[str]:
    """Return a problem if a margin is equal in all scenes, so nothing was measured."""
    margins = {spec.evidence.get("margin_m") for spec in members}
    return [f"{family}: every scenario has the margin {margins.pop()} m"] if len(margins) == 1 < len(members) else []


def repeated(keys: Iterable[tuple[str, str]], problem: str) -> list[str]:
    """Return a sentence for each key that several scenarios share. keys: key and scenario id."""
    owners: defaultdict[str, list[str]] = defaultdict(list)
    for key, scenario_id in keys:
        owners[key].append(scenario_id)
    return [f"{', '.join(ids)}: {problem}" for ids in owners.values() if len(ids) > 1]


def prior_accuracy(specs: Sequence[SceneSpec]) -> float:
    """Return the accuracy of answering each sub-scenario's commonest answer, mean of taxonomies."""
    commonest = commonest_answers([spec.model_dump(mode="json") for spec in specs])
    shares = []
    for taxonomy in ("occlusion", "chaotic"):
        hits = [spec.ground_truth == commonest[spec.sub_scenario] for spec in specs if spec.taxonomy == taxonomy]
        if hits:
            shares.append(sum(hits) / len(hits))
    return sum(shares) / len(shares)
