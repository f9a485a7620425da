"""The `traps` command. Nothing heavy is imported before a subcommand needs it: `traps --help` answers at once."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from traps_pipeline.errors import TrapsError

if TYPE_CHECKING:
    from traps_pipeline.experiment import Experiment
    from traps_pipeline.models.forecast import Forecast
    from traps_pipeline.storage.workspace import Workspace

MONEY = ("budget_usd", "model_budgets_usd", "allow_unknown_prices")  # fields of an experiment and of a study
OK, FAILED, BAD_USAGE, OVER_BUDGET, INTERRUPTED = 0, 1, 2, 4, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run a subcommand; returns the exit code: 0 done, 1 something failed, 2 bad usage, 4 a budget is reached, 130
    interrupted."""
    arguments = build_parser().parse_args(argv)
    command: Callable[[argparse.Namespace], int] = arguments.command
    try:
        return command(arguments)
    except TrapsError as error:
        print(f"traps: {error}", file=sys.stderr)
        return FAILED
    except OSError as error:
        if isinstance(error, BrokenPipeError):
            sys.stderr.close()
        else:
            where = f"{error.filename}: " if error.filename else ""
            print(f"traps: {where}{error.strerror}; mend that and run the same command again", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print(
            "\ntraps: interrupted; everything answered or rendered is kept. Run the same command to go on.",
            file=sys.stderr,
        )
        return INTERRUPTED


def build_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="traps", description="TRAPSBench: do vision-language models know when not to answer?"
    )
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    def add(
        name: str, command: Callable[[argparse.Namespace], int], text: str, *, workspace: bool = True
    ) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text)
        sub.set_defaults(command=command)
        if workspace:
            sub.add_argument(
                "--workspace", type=Path, help="study folder (default: $TRAPS_WORKSPACE, else .workspaces/default)"
            )
        return sub

    add("doctor", doctor, "render one frame, encode it, and name what is missing")
    add("init", init, "make a workspace for an experiment without running it").add_argument(
        "experiment", nargs="?", default="demo"
    )
    add("plan", plan, "count the calls of an experiment: wanted, known, new; nothing is sent").add_argument(
        "experiment"
    )
    running = add("run", run, "materialize whatever of an experiment is missing or stale")
    running.add_argument("experiment")
    running.add_argument(
        "--budget-usd", action="append", default=[], metavar="[MODEL=]USD",
        help="spend no more on calls over the network, in this study or on one model or judge; kept in study.yaml",
    )  # fmt: skip
    running.add_argument(
        "--allow-unknown-prices",
        action="store_true",
        default=None,
        help="ask models that have no price in the registry",
    )
    add("status", status, "what is there, missing and stale, and why").add_argument("experiment", nargs="?")
    add("why", why, "why an item's answers stand or will be asked again").add_argument(
        "item", help="dataset:scenario:side"
    )
    auditing = add("audit", audit_published, "recompute what the published tables allow, and compare", workspace=False)
    auditing.add_argument("--all", action="store_true", help="show what agrees, too")
    auditing.add_argument("--csv", type=Path, metavar="FILE", help="write every finding to a file")
    requests = commands.add_parser("requests", help="calls for others to make").add_subparsers(required=True)
    export = requests.add_parser("export", help="write an experiment's missing calls and their media to a folder")
    export.set_defaults(command=export_calls)
    export.add_argument("experiment")
    export.add_argument("--out", type=Path, required=True, help="folder of requests.jsonl and media/")
    answers = commands.add_parser("answers", help="answers that others got").add_subparsers(required=True)
    imported = answers.add_parser("import", help="take answers (JSON lines by key) into the ledger")
    imported.set_defaults(command=import_given)
    imported.add_argument("experiment")
    imported.add_argument("file", type=Path)
    for sub in (export, imported):
        sub.add_argument("--workspace", type=Path, help="study folder (default: $TRAPS_WORKSPACE)")
    models = commands.add_parser("models", help="entries of the registry").add_subparsers(required=True)
    check = models.add_parser("check", help="show what models and judges are really sent; no key, nothing leaves here")
    check.set_defaults(command=check_models)
    check.add_argument("names", nargs="*", metavar="MODEL", help="these models and judges only")
    certify = add("certify", certify_benchmark, "re-derive every certificate of the released records", workspace=False)
    certify.add_argument("--specs", type=Path, help="folder of a sampled benchmark (default: scene_specs)")
    certify.add_argument("--families", nargs="+", metavar="FAMILY", help="these only")
    certify.add_argument("--workers", type=int, help="processes (default: one a core)")
    certify.add_argument("--fresh", action="store_true", help="certify again what an earlier call has certified")
    sample = add("sample", sample_scenarios, "draw a fresh benchmark, certified like the released one", workspace=False)
    sample.add_argument("--seed", type=int, required=True, help="the same seed gives the same scenarios")
    sample.add_argument("--out", type=Path, required=True, help="folder of the new benchmark")
    sample.add_argument("--name", help="its name (default: private-SEED)")
    sample.add_argument("--families", nargs="+", metavar="FAMILY", help="these only (default: all)")
    sample.add_argument("--scale", type=float, default=1.0, help="times as many scenarios as the released benchmark")
    sample.add_argument("--count", type=int, help="so many scenarios of each family instead")
    sample.add_argument("--workers", type=int, help="processes (default: one a core)")
    return parser


# --- commands ---------------------------------------------------------------------------------------------------------


def doctor(arguments: argparse.Namespace) -> int:
    """See `traps doctor --help`."""
    from traps_pipeline.doctor import examine

    problems = 0
    for finding in examine(_root(arguments)):
        print(f"{'ok  ' if finding.ok else 'FAIL'} {finding.what}: {finding.detail}")
        problems += not finding.ok
    print("everything that the demo needs is here" if not problems else f"{problems} problem(s); the demo will not run")
    return FAILED if problems else OK


def audit_published(arguments: argparse.Namespace) -> int:
    """See `traps audit --help`. Discrepancies of the published tables are findings, not failures."""
    from traps_pipeline.scoring.audit import audit, audit_text

    findings = audit()
    print(audit_text(findings, arguments.all))
    if arguments.csv:
        findings.to_csv(arguments.csv, index=False)
        print(f"every finding: {arguments.csv}")
    return OK


def init(arguments: argparse.Namespace) -> int:
    """See `traps init --help`."""
    workspace = _create(arguments, _experiment(arguments))
    print(f"workspace {workspace.root} (study.yaml names its benchmark, panel and budget)")
    print(f"next: export TRAPS_WORKSPACE={workspace.root} DAGSTER_HOME={workspace.dagster_home}")
    return OK


def plan(arguments: argparse.Namespace) -> int:
    """See `traps plan --help`."""
    from traps_pipeline.plan import Count, make_plan

    experiment, root = _experiment(arguments), _root(arguments)
    workspace = _open(root) if (root / "study.yaml").exists() else None
    planned = make_plan(workspace, experiment)
    total = (Count(), Count())
    print(f"{experiment.name} in {root if workspace else 'a new workspace'}: calls wanted, known (in the ledger), new")
    print(f"{'model':<24} {'answers':>9} {'known':>9} {'new':>9}   {'votes':>9} {'known':>9} {'new':>9}")
    for model, counts in planned.calls.items():
        for sum_, count in zip(total, counts, strict=True):
            sum_.add(count.wanted, count.known)
        print(_plan_line(model, counts))
    print(_plan_line("all", total))
    if planned.forecasts:
        _print_forecasts(planned.forecasts)
    if planned.uncertain:
        print(
            f"an upper bound: the items of {', '.join(planned.uncertain)} are not made, or are outdated: all "
            "of their calls are counted as new. Materialize scene_specs, videos and items for exact counts."
        )
    return OK


def _print_forecasts(forecasts: Sequence[Forecast]) -> None:
    """Tokens, dollars and minutes of the new calls over the network; an unknown price stays unknown in the sum."""
    print(
        f"\n{'over the network':<24} {'new calls':>9} {'M tokens in, out':>18}   {'USD low':>10} {'expected':>10}",
        end="",
    )
    print(f" {'high':>10} {'minutes':>8}")
    for row in forecasts:
        tokens = f"{row.prompt_tokens / 1e6:.2f}, {row.completion_tokens / 1e6:.2f}"
        print(f"{row.participant:<24} {row.calls:>9,} {tokens:>18}   {_dollars(row.dollars)} {row.minutes:>8,.0f}")
    known = [row.dollars for row in forecasts if row.dollars is not None]
    total = (sum(d[0] for d in known), sum(d[1] for d in known), sum(d[2] for d in known))
    longest = max(row.minutes for row in forecasts)
    calls = sum(row.calls for row in forecasts)
    print(f"{'all, side by side':<24} {calls:>9,} {'':>18}   {_dollars(total)} {longest:>8,.0f}")
    if len(known) < len(forecasts):
        unknown = ", ".join(row.participant for row in forecasts if row.dollars is None)
        print(f"price unknown, not in the sum: {unknown}")


def _dollars(amounts: tuple[float, float, float] | None) -> str:
    return " ".join(f"{'unknown' if amounts is None else f'{amounts[k]:,.2f}':>10}" for k in range(3))


def _plan_line(name: str, counts: tuple) -> str:
    answers, votes = ((count.wanted, count.known, count.new) for count in counts)
    return (
        f"{name:<24} {answers[0]:>9,} {answers[1]:>9,} {answers[2]:>9,}   {votes[0]:>9,} {votes[1]:>9,} {votes[2]:>9,}"
    )


def run(arguments: argparse.Namespace) -> int:
    """See `traps run --help`."""
    from traps_pipeline.driver import run_experiment
    from traps_pipeline.progress import Tally, TerminalProgress, clock, reporting

    experiment = _experiment(arguments)
    workspace = _allow(_create(arguments, experiment), experiment, arguments)
    print(f"{experiment.name}: {experiment.description}\nworkspace {workspace.root}", flush=True)
    with reporting(TerminalProgress()) as progress:
        outcome = run_experiment(workspace, experiment)
    total = progress.totals
    asked, voted, drawn = (total.get(stage, Tally()) for stage in ("responses", "votes", "videos"))
    print(
        f"\n{asked.asked} answers asked ({asked.cached} from the ledger), {voted.asked} votes asked "
        f"({voted.cached} from the ledger), {drawn.frames} frames rendered, {clock(outcome.seconds)} min"
    )
    if outcome.problems:
        for problem in outcome.problems:
            print(f"traps: {problem}", file=sys.stderr)
        print(
            f"traps: {len(outcome.problems)} problem(s); what is done is kept: run the same command to go on",
            file=sys.stderr,
        )
        return OVER_BUDGET if outcome.over_budget else FAILED
    _print_results(workspace)
    print(f"next: open {workspace.reports / 'leaderboard.html'}, or traps why ITEM for what stands behind a figure")
    return OK


def _allow(workspace: Workspace, experiment: Experiment, arguments: argparse.Namespace) -> Workspace:
    """The workspace with what the experiment, and above it the command line, says about money in its study. Raises
    TrapsError for a wrong amount or name."""
    stated = {name: getattr(experiment, name) for name in MONEY}
    money: dict[str, Any] = {name: value for name, value in stated.items() if value is not None}
    if arguments.allow_unknown_prices:
        money["allow_unknown_prices"] = True
    for text in arguments.budget_usd:
        name, _, amount = text.rpartition("=")
        try:
            dollars = float(amount)
        except ValueError:
            dollars = -1.0
        if not 0 <= dollars < float("inf"):
            raise TrapsError(
                f"--budget-usd {text}: give dollars (20 or 20.50), or MODEL=dollars for one model or judge"
            )
        if name:
            caps = money.setdefault("model_budgets_usd", dict(workspace.study.model_budgets_usd))
            caps[name] = dollars
        else:
            money["budget_usd"] = dollars
    for name in money.get("model_budgets_usd", {}):
        _known_participant(name)
    return workspace.allow(**money) if money else workspace


def _known_participant(name: str) -> str:
    from traps_pipeline.judging.panel import load_judges
    from traps_pipeline.models.registry import get_model

    return name if name in load_judges() else get_model(name).id


def _print_results(workspace: Workspace) -> None:
    from traps_pipeline.report.page import leaderboard_text
    from traps_pipeline.tables import LEADERBOARD

    print(leaderboard_text(workspace.tables.read(LEADERBOARD, {})))
    pictures = ("pecs_landscape.png", "contact_sheet.png", "shortcuts.png")
    for name in ("leaderboard.html", "leaderboard.md", "gallery.html", *pictures):
        print(workspace.reports / name)


def status(arguments: argparse.Namespace) -> int:
    """See `traps status --help`."""
    from traps_pipeline.definitions import observe_sources
    from traps_pipeline.driver import dagster_history, wanted_keys
    from traps_pipeline.lineage import STAGES
    from traps_pipeline.plan import stage_statuses

    workspace = _open(_root(arguments))
    experiment = _experiment(arguments) if arguments.experiment else None
    wanted = {stage: wanted_keys(workspace, experiment, stage) for stage in STAGES} if experiment else None
    with dagster_history(workspace) as instance:
        observe_sources(instance, workspace)  # so that Dagster's UI shows the same partitions stale
    print(f"workspace {workspace.root}\n{'stage':<18} {'fresh':>6} {'stale':>6} {'missing':>8}")
    for row in stage_statuses(workspace, wanted):
        missing = f"{row.missing:>8}" if wanted else f"{'-':>8}"
        print(f"{row.stage:<18} {row.fresh:>6} {len(row.stale):>6} {missing}")
        for key, reasons in list(row.stale.items())[:SHOWN]:
            print(f"    {key}: {'; '.join(reasons[:3])}{' ...' if len(reasons) > 3 else ''}")
        if len(row.stale) > SHOWN:
            print(f"    ... and {len(row.stale) - SHOWN} more")
    for file in sorted((workspace.root / "checks").glob("*/*/*.json")):
        stage, check = file.parts[-3:-1]
        print(f"check {check} of {stage} {file.stem} does not pass: {file.read_text(encoding='utf-8')[:200]}")
    print("stale means made from something that has changed since; `traps run EXPERIMENT` makes it anew")
    return OK


SHOWN = 8


def why(arguments: argparse.Namespace) -> int:
    """See `traps why --help`."""
    from traps_pipeline.plan import why as explain

    for line in explain(_open(_root(arguments)), arguments.item):
        print(line)
    return OK


def export_calls(arguments: argparse.Namespace) -> int:
    """See `traps requests export --help`."""
    from traps_pipeline.models.exchange import REQUESTS, export_requests

    experiment = _experiment(arguments)
    count = export_requests(_open(_root(arguments)), experiment, arguments.out.absolute())
    print(f"{count} requests in {arguments.out / REQUESTS}")
    print(f"next: have them answered, then traps answers import {arguments.experiment} ANSWERS.jsonl")
    return OK


def import_given(arguments: argparse.Namespace) -> int:
    """See `traps answers import --help`."""
    from traps_pipeline.models.exchange import import_answers

    imported = import_answers(_open(_root(arguments)), _experiment(arguments), arguments.file)
    print(f"{imported.new} answers imported, {imported.known} were there already")
    print(f"next: traps run {arguments.experiment}")
    return OK


def check_models(arguments: argparse.Namespace) -> int:
    """See `traps models check --help`."""
    from traps_pipeline.models.wire import check_named

    wrong = 0
    for checked in check_named(arguments.names):
        print("\n    ".join([checked.line, *checked.problems]), flush=True)
        wrong += bool(checked.problems)
    print("every entry sends what it declares" if not wrong else f"{wrong} entries do not send what they declare")
    return FAILED if wrong else OK


def certify_benchmark(arguments: argparse.Namespace) -> int:
    """See `traps certify --help`."""
    from traps_pipeline.benchmark.certificates import certify_all, family_table
    from traps_pipeline.paths import CHECKOUT, SCENE_SPECS

    folder = (arguments.specs or SCENE_SPECS).absolute()
    kept = CHECKOUT / ".workspaces" / "certificates"
    verdicts, problems = certify_all(
        folder,
        kept,
        families=arguments.families,
        workers=arguments.workers,
        fresh=arguments.fresh,
        report=lambda line: print(line, file=sys.stderr, flush=True),
    )
    print(family_table(folder, verdicts))
    for problem in problems:
        print(f"traps: {problem}", file=sys.stderr)
    passed = sum(verdict.passed for verdict in verdicts)
    print(f"{passed} of {len(verdicts)} scenarios certified")
    return FAILED if problems else OK


def sample_scenarios(arguments: argparse.Namespace) -> int:
    """See `traps sample --help`."""
    from traps_pipeline.benchmark.composition import load_composition, sample_benchmark
    from traps_pipeline.scenes.registry import family_names

    counts = load_composition()
    names = arguments.families or list(counts)
    unknown = sorted(set(names) - (set(family_names()) if arguments.count else set(counts)))
    if unknown:
        raise TrapsError(f"unknown families {', '.join(unknown)}; known: {', '.join(family_names())}")
    wanted = {name: arguments.count or max(1, round(counts[name] * arguments.scale)) for name in names}
    name = arguments.name or f"private-{arguments.seed}"
    sample_benchmark(
        arguments.out.absolute(),
        wanted,
        arguments.seed,
        name,
        workers=arguments.workers,
        report=lambda line: print(line, flush=True),
    )
    print(f"{sum(wanted.values())} scenarios of {len(wanted)} families in {arguments.out}")
    print(f"next: traps certify --specs {arguments.out}; to run studies on it, TRAPS_SCENE_SPECS={arguments.out}")
    return OK


# --- shared -----------------------------------------------------------------------------------------------------------


def _root(arguments: argparse.Namespace) -> Path:
    from traps_pipeline.storage.workspace import Workspace

    return arguments.workspace.absolute() if arguments.workspace else Workspace.default_root()


def _open(root: Path) -> Workspace:
    from traps_pipeline.storage.workspace import Workspace

    return Workspace.open(root)


def _create(arguments: argparse.Namespace, experiment: Experiment) -> Workspace:
    from traps_pipeline.storage.workspace import Workspace

    workspace = Workspace.create(_root(arguments), experiment.study)
    experiment.check_study(workspace.study, workspace.root / "study.yaml")
    from traps_pipeline.driver import dagster_history

    with dagster_history(workspace):  # opened once here, so that several processes may use it afterwards
        return workspace


def _experiment(arguments: argparse.Namespace) -> Experiment:
    from traps_pipeline.experiment import load_experiment

    return load_experiment(arguments.experiment)


if __name__ == "__main__":
    sys.exit(main())
