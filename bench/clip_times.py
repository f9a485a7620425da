"""CPU seconds of rendering a scenario's clips and of certifying it, for the first records of each family, against other
versions of this project with their own records: all in one run, in turn, on the same libraries. Where two versions have
the same record it also says whether they draw the same frames and measure the same evidence.

git worktree add ../traps-0.1.0 c32d7b2^      # the last state of version 0.1.0
python bench/clip_times.py --against ../traps-0.1.0
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[1]
WHAT = ("rendering", "certification")
Times = dict[str, list[list[float]]]  # by family: the seconds of each of WHAT, of each version


class Version:
    """A process that works with the code and the records of a checkout; it waits while another one works."""

    def __init__(self, folder: Path) -> None:
        environment = os.environ | {"PYTHONPATH": str(folder), "MUJOCO_GL": "osmesa"}
        command = [sys.executable, str(Path(__file__).resolve()), "--work"]
        self._process = subprocess.Popen(
            command, cwd=folder, env=environment, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        said = self._answer()
        if Path(said["package"]) != folder / "traps_pipeline":
            raise SystemExit(f"{folder}: the package comes from {said['package']}; give the folder of a checkout")
        self.scenarios: dict[str, int] = said["scenarios"]

    def work(self, scenario_id: str) -> dict[str, Any]:
        """Return the seconds of each of WHAT for a record, and digests of the record and of what came of it."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{scenario_id}\n")
        self._process.stdin.flush()
        return self._answer()

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit(f"a version ended with code {self._process.wait()}; what it said stands above")
        return json.loads(line)


def work() -> None:
    """What a `Version` does, with the package of its folder, which may be an old one: records by id, one a line."""
    import traps_pipeline

    base = "traps_pipeline.base" if importlib.util.find_spec("traps_pipeline.base") else "traps_pipeline"  # of old ones
    digest = importlib.import_module(f"{base}.digests").digest
    released = importlib.import_module(f"{base}.paths").RELEASED
    from traps_pipeline.benchmark.composition import load_composition
    from traps_pipeline.benchmark.records import load_released
    from traps_pipeline.scenes.certification.certify_record import certify
    from traps_pipeline.scenes.worlds.clip_notes import read_clip
    from traps_pipeline.scenes.worlds.clips import Job, render_pair
    from traps_pipeline.scenes.worlds.spec import load_trajectory

    specs, package = load_released(), Path(str(traps_pipeline.__file__)).resolve().parent
    print(json.dumps({"package": str(package), "scenarios": load_composition()}), flush=True)
    for line in sys.stdin:
        spec = specs[line.strip()]
        path = released / "trajectories" / f"{spec.scenario_id}.npz"
        qpos, twin = (
            load_trajectory(path, spec.trajectory_sha256),
            load_trajectory(path, spec.twin.trajectory_sha256, "twin"),
        )
        with tempfile.TemporaryDirectory() as folder:
            clips = [Path(folder) / f"{side}.mp4" for side in ("control", "void", "twin")]
            job = Job(spec, qpos, twin, clips[0], clips[1], clips[2])
            rendering, _ = _cpu_seconds(lambda: render_pair(job))  # noqa: B023 (called at once)
            frames = [vars(read_clip(clip)) for clip in clips]
        certification, verdict = _cpu_seconds(lambda: certify(spec, qpos, twin))  # noqa: B023
        found = [frames, str(verdict.measured), dict(verdict.failures), verdict.control_end, verdict.void_end]
        answer = {"rendering": rendering, "certification": certification}
        print(json.dumps(answer | {"record": spec.spec_hash, "found": digest(found)}), flush=True)


def _cpu_seconds(call: Callable[[], Any]) -> tuple[float, Any]:
    """Return user and system seconds of this process and its children, and what the call returns."""
    began = os.times()
    result = call()
    return sum(os.times()[:4]) - sum(began[:4]), result


def measure(versions: Sequence[Version], families: Sequence[str], records: int, repeats: int) -> tuple[Times, int]:
    """Return the least seconds of each record, as means of each family, and how many records came out unlike in
    versions that all have them."""
    for version in versions:
        version.work(f"{families[0]}-0001")  # first use opens contexts and compiles shaders
    times: Times = {}
    unlike = 0
    for family in families:
        ids = [f"{family}-{number:04}" for number in range(1, records + 1)]
        least = [[[float("inf")] * len(versions) for _ in WHAT] for _ in ids]
        for of, scenario_id in zip(least, ids, strict=True):
            for turn in range(repeats):
                answers = [version.work(scenario_id) for version in versions]
                for what, row in zip(WHAT, of, strict=True):
                    row[:] = [min(known, answer[what]) for known, answer in zip(row, answers, strict=True)]
                same_record = len({answer["record"] for answer in answers}) == 1
                unlike += turn == 0 and same_record and len({answer["found"] for answer in answers}) > 1
        times[family] = [
            [statistics.mean(of[what][which] for of in least) for which in range(len(versions))]
            for what in range(len(WHAT))
        ]
        print(_row(family, times[family]), flush=True)
    return times, unlike


def _row(name: str, of: Sequence[Sequence[float]]) -> str:
    cells = []
    for seconds in of:
        cells += [f"{value:>8.2f}" for value in seconds] + [f"{seconds[0] / other:>6.2f}" for other in seconds[1:]]
    return f"{name:<20}" + " ".join(cells)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", type=Path, nargs="+", default=[], help="folders of checkouts of other versions")
    parser.add_argument("--families", nargs="+", help="these families alone")
    parser.add_argument("--records", type=int, default=1, help="so many records of each family")
    parser.add_argument("--repeats", type=int, default=1, help="the least seconds of so many runs of each record")
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    from bench.quick import parse  # not at the top: other versions, which this file measures, may lack it

    arguments = parse(parser, families=["hidden_race"])
    if arguments.work:
        work()
        return
    began = time.perf_counter()
    versions = [Version(folder.resolve()) for folder in (HERE, *arguments.against)]
    scenarios = versions[0].scenarios
    families = arguments.families or sorted(scenarios)
    print(f"CPU seconds a scenario, of this version and of {', '.join(map(str, arguments.against)) or 'no other'}, and")
    print(f"the ratio to each other one: {', then '.join(WHAT)}")
    times, unlike = measure(versions, families, arguments.records, arguments.repeats)
    total = [
        [sum(scenarios[family] * times[family][what][which] for family in families) for which in range(len(versions))]
        for what in range(len(WHAT))
    ]
    print(_row("all, weighted", total))
    for at, what in enumerate(WHAT):
        for which in range(1, len(versions)):
            ratios = [times[family][at][0] / times[family][at][which] for family in families]
            said = f"{what} against {arguments.against[which - 1]}: {total[at][0] / total[at][which]:.2f} weighted"
            print(f"{said}, median {statistics.median(ratios):.2f}, {min(ratios):.2f} to {max(ratios):.2f}")
    print(f"records that came out unlike: {unlike}; {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
