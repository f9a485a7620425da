"""Certify a whole benchmark on all cores, resumably, with a table of results."""

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

import numpy as np

from traps_pipeline.base.digests import digest, file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_text
from traps_pipeline.base.paths import PACKAGE
from traps_pipeline.base.terminal import text_table
from traps_pipeline.base.workers import run_in_order
from traps_pipeline.benchmark.composition import composition_problems, load_composition, repeated
from traps_pipeline.benchmark.filmed_lanes import trajectories_of
from traps_pipeline.benchmark.lane_balance import telling_numbers
from traps_pipeline.benchmark.outcome_leakage import MAX_GAIN, MIN_RECORDS, outcome_leakage
from traps_pipeline.benchmark.records import load_release, load_released, refuse_recorded, two_events_lines
from traps_pipeline.scenes.certification.certify_lanes import certify_lane_record
from traps_pipeline.scenes.certification.certify_record import Verdict, certify
from traps_pipeline.scenes.draw.sample import Tally, load_tallies
from traps_pipeline.scenes.family_registry import added_digests
from traps_pipeline.scenes.worlds.lane_records import TwoEventsSpec
from traps_pipeline.scenes.worlds.spec import SceneSpec, load_trajectory


@dataclass(frozen=True)
class Case:
    """A record to certify, with the paths of its trajectories and of its cached verdict."""

    spec: SceneSpec | TwoEventsSpec
    trajectory: Path
    verdict: Path


def certify_all(
    folder: Path,
    cache_folder: Path,
    *,
    families: Sequence[str] | None = None,
    workers: int | None = None,
    fresh: bool = False,
    report: Callable[[str], None] = lambda _: None,
) -> tuple[list[Verdict], list[str]]:
    """Return verdicts on a folder's records, of pairs and of two events, and problems, scenarios' before others.

    Verdicts are cached in `cache_folder` by record and code, so that an interrupted call resumes.
    """
    if (folder / "benchmark.yaml").is_file():
        load_release(folder / "benchmark.yaml")  # refuses that of another version
    released_folder, lanes_folder = folder / "released", folder / "two_events" / "released"
    specs = [s for s in load_released(released_folder).values() if families is None or s.family in families]
    lines = two_events_lines(lanes_folder).values()
    lanes = [line.spec for line in lines if families is None or line.family in families]
    if not specs and not lanes:
        raise TrapsError(f"{released_folder}: holds no records of {', '.join(families or ())}")
    refuse_recorded("traps benchmark certify", released_folder)
    cases = [_case(released_folder, cache_folder, spec) for spec in specs]
    cases += [_case(lanes_folder, cache_folder, spec) for spec in lanes]
    if fresh:
        for case in cases:
            case.verdict.unlink(missing_ok=True)
    verdicts = []
    for count, (_, verdict) in enumerate(run_in_order(judge, cases, workers), start=1):
        verdicts.append(verdict)
        if not verdict.passed or count % 20 == 0 or count == len(cases):
            report(f"{count} of {len(cases)} examined: {verdict.scenario_id} {'passes' if verdict.passed else 'FAILS'}")
    failures = [f"{v.scenario_id}: {name}: {reason}" for v in verdicts for name, reason in v.failures.items()]
    is_complete = families is None and (folder / "composition.yaml").is_file()
    failures += composition_problems(specs, load_composition(folder / "composition.yaml") if is_complete else None)
    failures += telling_numbers(lanes) if is_complete and lanes else []
    for side in ("control_end", "void_end"):
        ends = [(end, verdict.scenario_id) for verdict in verdicts if (end := getattr(verdict, side))]
        failures += repeated(ends, "clips end in the same frame")
    return verdicts, failures + foreseeable(specs, verdicts)


def _case(released: Path, folder: Path, spec: SceneSpec | TwoEventsSpec) -> Case:
    trajectory = released / "trajectories" / f"{spec.scenario_id}.npz"
    content = file_digest(trajectory) if trajectory.is_file() else "missing"
    name = digest([spec.spec_hash, content, code_digest(spec.family)])[:24]
    return Case(spec, trajectory, folder / f"{spec.scenario_id}-{name}.json")


@cache
def code_digest(family: str) -> str:
    """Return the digest of the code that certifies a family; it keys cached verdicts."""
    folder = PACKAGE / "scenes"
    files = [path for path in sorted(folder.rglob("*.py")) if path.parent.name != "families" or path.stem == family]
    return digest([*([path.name, file_digest(path)] for path in files), *added_digests()])


def judge(case: Case) -> Verdict:
    """Return the verdict on one record, from its file if it is cached."""
    if case.verdict.is_file():
        return Verdict(**json.loads(case.verdict.read_text(encoding="utf-8")))
    spec = case.spec
    try:
        if isinstance(spec, TwoEventsSpec):
            verdict = certify_lane_record(spec, trajectories_of(spec, case.trajectory))
        else:
            qpos = load_trajectory(case.trajectory, spec.trajectory_sha256)
            verdict = certify(spec, qpos, load_trajectory(case.trajectory, spec.twin.trajectory_sha256, "twin"))
    except (ValueError, KeyError, TypeError) as error:  # an altered record may not even build
        verdict = Verdict(spec.scenario_id, spec.family, {"record": str(error)}, {}, same_physics=False)
    write_text(case.verdict, json.dumps(asdict(verdict)))
    return verdict


def foreseeable(specs: Iterable[SceneSpec], verdicts: Iterable[Verdict]) -> list[str]:
    """Return in words the families of 100+ cut clips whose state at the cut predicts the outcome."""
    states = {verdict.scenario_id: verdict.at_cut for verdict in verdicts if len(verdict.at_cut)}
    families: defaultdict[str, list[SceneSpec]] = defaultdict(list)
    for spec in specs:
        if spec.scenario_id in states:
            families[spec.family].append(spec)
    problems = []
    for family, members in families.items():
        if len(members) < MIN_RECORDS:
            continue
        leakage = outcome_leakage([states[spec.scenario_id] for spec in members], [s.ground_truth for s in members])
        if leakage is not None and leakage[0] - leakage[1] > MAX_GAIN:
            problems.append(
                f"{family}: the state at the cut predicts {leakage[0]:.3f} of the outcomes, the commonest one is "
                f"{leakage[1]:.3f}; at most {MAX_GAIN} more is allowed"
            )
    return problems


def family_table(folder: Path, verdicts: Sequence[Verdict]) -> str:
    """Return a table of verdicts as text, one line per family.

    Columns: scenarios, passed, rejected draws, entropy of the futures and accuracy of the best guess, margins, twins,
    CPU seconds.
    """
    tallies = load_tallies(folder / "released")
    members: defaultdict[str, list[Verdict]] = defaultdict(list)
    for verdict in verdicts:
        members[verdict.family].append(verdict)
    headings = (
        *("family", "scenarios", "passed", "rejected", "entropy", "best guess"),
        *("margin m", "twins", "CPU s", "other physics"),
    )
    rows = []
    for family, group in sorted(members.items()):
        twins = sum("twin" not in v.failures and "record" not in v.failures for v in group)
        n_rejected = tallies.get(family, Tally(0, 0)).rejected.total()
        n_changed = sum(not v.same_physics for v in group)
        spans = (_span(group, "entropy_bits", 2), _span(group, "top_share", 2), _span(group, "margin_m", 3))
        seconds = f"{np.median([v.cpu_s for v in group]):.1f}"
        rows.append((family, len(group), sum(v.passed for v in group), n_rejected, *spans, twins, seconds, n_changed))
    lines = [text_table(headings, rows)]
    if any(not v.same_physics for v in verdicts):
        lines.append(
            "other physics: simulating here does not give the frozen trajectory bit by bit (another CPU or version); "
            "outcome, visibility and frames are certified on the trajectory as shipped; futures are those of this "
            "machine, which are another sample, and a chaotic twin is held against its start alone"
        )
    return "\n".join(lines)


def _span(verdicts: Sequence[Verdict], name: str, digits: int) -> str:
    values = [v.measured[name] for v in verdicts if name in v.measured]
    return f"{min(values):.{digits}f}-{max(values):.{digits}f}" if values else "-"
