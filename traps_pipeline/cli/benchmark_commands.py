"""Certify, sample, import, commit to and prove benchmarks (`traps benchmark`)."""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.wording import count_noun
from traps_pipeline.cli.command import FAILED, OK, Commands, integer, number, print_json

if TYPE_CHECKING:
    from traps_pipeline.release.commitment import Commitment, Specs

# Copied from `scenes.parts.look.PARTS` and from `scenes.parts.difficulty`, which take long to import.
SPEEDS, MAX_DISTRACTORS = (1.0, 1.5, 2.0), 3
LOOKS = ("floor", "pale-floor", "light", "panel", "bystanders", "camera", "material", "size")


def add(commands: Commands) -> None:
    """Add the `traps benchmark` commands to the parser."""
    text = "compute every certificate of the released records again"
    parser = commands.add("benchmark certify", certify, text, example="--families plinko", workspace=False, json=True)
    parser.add_argument("--specs", type=Path, help="folder of a sampled benchmark (default: scene_specs)")
    parser.add_argument("--families", nargs="+", metavar="FAMILY", help="certify only these (default: all)")
    parser.add_argument("--workers", type=integer(1, 1024), help="processes (default: one per core)")
    parser.add_argument(
        "--fresh", action="store_true", help="certify all again, also those that an earlier call certified"
    )

    text = "sample a fresh benchmark, certified like the released one"
    parser = commands.add(
        "benchmark sample", sample, text, example="--seed 7 --out private --scale 0.1", workspace=False
    )
    parser.add_argument(
        "--seed", type=integer(0, 2**63 - 1), required=True, help="the same seed gives the same scenarios"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the new benchmark")
    parser.add_argument("--name", help="its name (default: private-SEED)")
    parser.add_argument("--families", nargs="+", metavar="FAMILY", help="sample only these (default: all)")
    parser.add_argument(
        "--scale", type=number(0, 1000), default=1.0, help="number of scenarios, relative to the released benchmark"
    )
    parser.add_argument(
        "--count", type=integer(0, 1_000_000), help="number of pairs of each family, instead of --scale"
    )
    parser.add_argument(
        "--two-events",
        type=integer(0, 1000),
        default=0,
        metavar="N",
        help="scenarios of two events of each family that has them, besides (default: none)",
    )
    parser.add_argument(
        "--look",
        nargs="+",
        choices=LOOKS,
        default=[],
        metavar="PART",
        help=f"vary how scenes look, too: {', '.join(LOOKS)} (default: what varies in the released benchmark)",
    )
    parser.add_argument(
        "--distractors",
        type=integer(0, MAX_DISTRACTORS),
        default=0,
        metavar="N",
        help="things like the named ones that cross before each scene (default: none)",
    )
    parser.add_argument(
        "--speed", type=float, choices=SPEEDS, default=1.0, help="how many times as fast all happens (default: 1.0)"
    )
    parser.add_argument(
        "--window",
        type=number(0.2, 1.0),
        default=1.0,
        metavar="SECONDS",
        help="for how long two events show a settled outcome, at least (default: 1; 0.2 is hard)",
    )
    parser.add_argument("--longer", action="store_true", help="longer rows, more lanes, greater counts")
    parser.add_argument("--workers", type=integer(1, 1024), help="processes (default: one per core)")

    text = "make a benchmark of your own videos: a table of pairs and their clips in, records out"
    parser = commands.add("benchmark import", import_pairs, text, example="videos --out garden", workspace=False)
    parser.add_argument("folder", type=Path, help="folder with pairs.csv or pairs.jsonl (docs/recorded.md)")
    parser.add_argument("--out", type=Path, required=True, help="folder of the benchmark; what it has is kept")
    parser.add_argument("--name", help="its name (default: that of the folder --out)")
    parser.add_argument("--workers", type=integer(1, 1024), help="processes (default: one per core)")

    text = "fix a sampled benchmark before anybody sees it: write a commitment to publish, and a reveal to keep"
    example = "private --out public.json --reveal secret.json"
    parser = commands.add("benchmark commit", commit_benchmark, text, example=example, workspace=False)
    parser.add_argument("benchmark", type=Path, help="a folder that `traps benchmark sample` wrote")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="the commitment")
    parser.add_argument("--reveal", type=Path, required=True, metavar="FILE", help="the seed and a secret number")

    text = "prove that a revealed benchmark is the one that was committed"
    example = "commitment.json reveal.json --specs private"
    parser = commands.add("benchmark prove", verify_commitment, text, example=example, workspace=False, json=True)
    parser.add_argument("commitment", type=Path, help="a file of `traps benchmark commit --out`")
    parser.add_argument("reveal", type=Path, help="a file of `traps benchmark commit --reveal`")
    parser.add_argument("--specs", type=Path, metavar="FOLDER", help="the revealed benchmark, sampled or released")
    parser.add_argument("--without-drawing", action="store_true", help="check --specs alone, without drawing it again")
    parser.add_argument("--workers", type=integer(1, 1024), help="processes (default: one per core)")


def certify(arguments: argparse.Namespace) -> int:
    from traps_pipeline.base.paths import SCENE_SPECS, WORKSPACES
    from traps_pipeline.benchmark.certify_all import certify_all, family_table

    folder = (arguments.specs or SCENE_SPECS).absolute()
    cache_folder = WORKSPACES / "certificates"
    verdicts, problems = certify_all(
        folder,
        cache_folder,
        families=arguments.families,
        workers=arguments.workers,
        fresh=arguments.fresh,
        report=lambda line: print(line, file=sys.stderr, flush=True),
    )
    if arguments.json:
        print_json({"verdicts": verdicts, "problems": problems})
        return FAILED if problems else OK
    print(family_table(folder, verdicts))
    for problem in problems:
        print(f"traps: {problem}", file=sys.stderr)
    n_passed = sum(verdict.passed for verdict in verdicts)
    print(f"{n_passed:,} of {count_noun(len(verdicts), 'scenario')} certified")
    return FAILED if problems else OK


def _name(text: str) -> str:
    from traps_pipeline.base.names import check_name

    try:
        return check_name(text)
    except ValueError as error:
        raise TrapsError(f"--name: {error}") from None


def sample(arguments: argparse.Namespace) -> int:
    from traps_pipeline.benchmark.composition import load_composition, sample_benchmark
    from traps_pipeline.benchmark.records import load_release
    from traps_pipeline.scenes.family_registry import family_names
    from traps_pipeline.scenes.parts.difficulty import Difficulty

    counts = load_composition()
    names = arguments.families or list(counts)
    unknown = sorted(set(names) - set(family_names()))
    if unknown:
        raise TrapsError(f"unknown families {', '.join(unknown)}; known: {', '.join(family_names())}")
    names_without_count = [name for name in names if name not in counts]
    if names_without_count and arguments.count is None:
        raise TrapsError(
            f"composition.yaml has no number of scenarios for {', '.join(names_without_count)}; say --count N"
        )
    if arguments.count == 0 and not arguments.two_events:
        raise TrapsError("--count: 0 pairs are a benchmark only with --two-events N")
    scaled = {name: max(1, round(counts.get(name, 0) * arguments.scale)) for name in names}
    targets = scaled if arguments.count is None else dict.fromkeys(names, arguments.count)
    n_scenarios = sample_benchmark(
        arguments.out.absolute(),
        targets,
        arguments.seed,
        _name(arguments.name or f"private-{arguments.seed}"),
        look=arguments.look,
        difficulty=Difficulty(arguments.distractors, arguments.speed, arguments.longer, arguments.window),
        two_events=arguments.two_events,
        workers=arguments.workers,
        report=lambda line: print(line, flush=True),
    )
    scenarios, families = count_noun(n_scenarios, "scenario"), count_noun(len(targets), "family", "families")
    print(f"{scenarios} of {families} in {arguments.out}")
    benchmark = load_release(arguments.out.absolute() / "benchmark.yaml").name
    print(
        f"next: traps benchmark certify --specs {arguments.out}; to run studies on it, "
        f"TRAPS_SCENE_SPECS={arguments.out} and `benchmark: {benchmark}` in the experiment"
    )
    return OK


def import_pairs(arguments: argparse.Namespace) -> int:
    from traps_pipeline.benchmark.import_recorded import import_recorded
    from traps_pipeline.benchmark.leaks import measure_leaks
    from traps_pipeline.benchmark.records import load_release
    from traps_pipeline.people.recorded_certificates import NOT_CERTIFIED
    from traps_pipeline.protocol.datasets import datasets_of_category
    from traps_pipeline.scenes.worlds.spec import SceneSpec
    from traps_pipeline.scoring.power import precision

    out = arguments.out.absolute()
    name = _name(arguments.name or out.name)
    say = partial(print, flush=True)
    records, problems = import_recorded(arguments.folder, out, name, workers=arguments.workers, report=say)
    print(measure_leaks([record for record in records if isinstance(record, SceneSpec)], out))
    datasets = {dataset for record in records for dataset in datasets_of_category(record.category)}
    needed = 400 * (precision(dict.fromkeys(datasets, 400)).width / 0.1) ** 2  # as intervals of so many pairs shrink
    print(f"pairs of each dataset for an interval of PECS of .1, with a model in the middle: about {needed:,.0f}")
    for problem in problems:
        print(f"traps: {problem}", file=sys.stderr)
    print(f"{count_noun(len(records), 'pair')} in {arguments.out}, {len(problems)} not imported; {NOT_CERTIFIED}")
    release = load_release(out / "benchmark.yaml").name
    print(f"next: TRAPS_SCENE_SPECS={arguments.out}, `benchmark: {release}` in the experiment, and traps run")
    return FAILED if problems else OK


def commit_benchmark(arguments: argparse.Namespace) -> int:
    from traps_pipeline.release.commitment import commit

    public = commit(arguments.benchmark.absolute(), arguments.out, arguments.reveal)
    records = count_noun(len(public.specs), "record")
    print(f"committed {records} of {public.name} {public.version} in {arguments.out}: publish it")
    print(f"keep {arguments.reveal} secret until the benchmark is revealed; without it nothing can be proven")
    return OK


def verify_commitment(arguments: argparse.Namespace) -> int:
    from traps_pipeline.release import commitment as sealed

    published, reveal = sealed.read_commitment(arguments.commitment), sealed.read_reveal(arguments.reveal)
    if arguments.without_drawing and not arguments.specs:
        raise TrapsError("--without-drawing: leaves nothing to look at; name the revealed benchmark with --specs")
    problems, proofs, output = [], [], sys.stderr if arguments.json else sys.stdout
    specs = sealed.revealed_specs(arguments.specs.absolute()) if arguments.specs else None
    if specs is not None:
        problems += sealed.broken_seals(published, reveal, specs)
        proofs.append(f"the records of {arguments.specs} are the committed ones")
    if not arguments.without_drawing and not problems:
        sample = sealed.redraw_records(
            published, reveal, workers=arguments.workers, report=lambda line: print(line, file=output, flush=True)
        )
        problems += _redraw_problems(published, sealed.broken_seals(published, reveal, sample), specs, sample)
        proofs.append("the revealed seed draws them")
    if arguments.json:
        print_json({"benchmark": published.name, "version": published.version, "problems": problems, "proven": proofs})
        return FAILED if problems else OK
    for problem in problems:
        print(problem)
    if problems:
        raise TrapsError(f"{arguments.commitment}: is not proven: {count_noun(len(problems), 'problem')}")
    print(
        f"{count_noun(len(published.specs), 'record')} of {published.name} {published.version}: {', and '.join(proofs)}"
    )
    if arguments.without_drawing:
        print("not checked: whether the revealed seed draws them")
    return OK


def _redraw_problems(published: Commitment, problems: list[str], specs: Specs | None, drawn: Specs) -> list[str]:
    """Return the problems of drawn scenes, and whether only their last digits differ."""
    from traps_pipeline.release.commitment import environment_differences, is_same_scene

    if (
        problems
        and specs is not None
        and {*specs} == {*drawn}
        and all(is_same_scene(specs[i], drawn[i]) for i in specs)
    ):
        machine_difference = environment_differences(published) or "another kind of CPU"
        problems.append(f"all scenes are the same but for the last digits of their simulation ({machine_difference})")
    return problems
