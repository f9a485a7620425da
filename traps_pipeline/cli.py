"""The `traps` command. Nothing heavy is imported before a subcommand needs it: `traps --help` answers at once."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from traps_pipeline.errors import TrapsError

if TYPE_CHECKING:
    from traps_pipeline.models.forecast import Forecast
    from traps_pipeline.storage.workspace import Workspace
    from traps_pipeline.study.experiment import Experiment

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

    add("doctor", doctor, "render one frame, encode it, and name what is missing").add_argument(
        "--local", action="store_true", help="try local models instead: tiny checkpoints of each family, devices, NF4"
    )
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
    running.add_argument(
        "--until", metavar="STAGES", help="make these (with commas between) and what they are made from, no more"
    )
    add("status", status, "what is there, missing and stale, and why").add_argument("experiment", nargs="?")
    add("why", why, "why an item's answers stand or will be asked again").add_argument(
        "item", help="dataset:scenario:side"
    )
    auditing = add("audit", audit_published, "recompute what the published tables allow, and compare", workspace=False)
    auditing.add_argument("--all", action="store_true", help="show what agrees, too")
    auditing.add_argument("--csv", type=Path, metavar="FILE", help="write every finding to a file")
    printing = add("export", export_results, "write every table, figure and page to a folder")
    printing.add_argument("folder", nargs="?", type=Path, help="default: `export` in the study's folder")
    comparing = add("compare", compare_studies, "this study minus another on what both hold, with paired intervals")
    comparing.add_argument("other", type=Path, help="folder of the other study, such as an earlier benchmark version")
    comparing.add_argument("--csv", type=Path, metavar="FILE", help="write every row to a file")
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
    judges = commands.add_parser("judges", help="how a panel bears up").add_subparsers(required=True)
    bearing = judges.add_parser("check", help="put answers that instruct their judge to a panel; costs calls to judges")
    bearing.set_defaults(command=check_judges)
    bearing.add_argument("panel", nargs="?", help="of assets/judges.yaml (default: the study's)")
    confabulation = commands.add_parser("confabulation", help="labels of void failures").add_subparsers(required=True)
    sheet = confabulation.add_parser("sheet", help="write a CSV of labelled failures for a person to label blindly")
    sheet.set_defaults(command=write_sheet)
    compared = confabulation.add_parser("validate", help="compare the judge with the labels of two annotators")
    compared.set_defaults(command=validate_judge)
    for sub in (sheet, compared):
        sub.add_argument("file", type=Path, help="CSV; see docs/judging.md for its columns")
    for sub in (bearing, sheet, compared):
        sub.add_argument("--workspace", type=Path, help="study folder (default: $TRAPS_WORKSPACE)")
    certify = add("certify", certify_benchmark, "re-derive every certificate of the released records", workspace=False)
    certify.add_argument("--specs", type=Path, help="folder of a sampled benchmark (default: scene_specs)")
    certify.add_argument("--families", nargs="+", metavar="FAMILY", help="these only")
    certify.add_argument("--workers", type=int, help="processes (default: one a core)")
    certify.add_argument("--fresh", action="store_true", help="certify again what an earlier call has certified")
    _add_pocket(commands)
    sample = add("sample", sample_scenarios, "draw a fresh benchmark, certified like the released one", workspace=False)
    sample.add_argument("--seed", type=int, required=True, help="the same seed gives the same scenarios")
    sample.add_argument("--out", type=Path, required=True, help="folder of the new benchmark")
    sample.add_argument("--name", help="its name (default: private-SEED)")
    sample.add_argument("--families", nargs="+", metavar="FAMILY", help="these only (default: all)")
    sample.add_argument("--scale", type=float, default=1.0, help="times as many scenarios as the released benchmark")
    sample.add_argument("--count", type=int, help="so many scenarios of each family instead")
    sample.add_argument("--workers", type=int, help="processes (default: one a core)")
    return parser


def _add_pocket(commands: Any) -> None:
    """`traps pocket render|train|evaluate|card`."""
    pocket = commands.add_parser("pocket", help="the small model that is trained here").add_subparsers(required=True)
    for name, text in (
        ("render", "draw the scenes that the pocket model is trained and tested on; goes on where it was stopped"),
        ("train", "train the pocket model from scratch (renders what is missing); goes on where it was stopped"),
        ("evaluate", "ask trained weights about the held-out scenes, and write the counts"),
        ("card", "write the counts, and what was found inside, into the model card"),
    ):
        sub = pocket.add_parser(name, help=text, description=text)
        sub.set_defaults(command=pocket_command, pocket=name)
        sub.add_argument("--recipe", type=Path, help="another recipe (default: assets/pocket/recipe.yaml)")
        if name != "card":
            sub.add_argument("--data", type=Path, required=True, help="folder of the rendered scenes")
            sub.add_argument("--workers", type=int, help="processes that render (default: one a core)")
        if name in ("train", "evaluate"):
            sub.add_argument("--seed", type=int, default=1, help="of weights and batches (default: 1)")
            sub.add_argument("--out", type=Path, required=True, help="folder of the weights of this seed")
        if name == "evaluate":
            sub.add_argument("--scenes", type=int, help="so many held-out scenes a family (default: all)")
        if name in ("evaluate", "card"):
            sub.add_argument("--csv", type=Path, help="the counts (default: assets/pocket/evaluation.csv)")
        if name == "card":
            sub.add_argument(
                "--mechanism",
                type=Path,
                nargs="+",
                default=[],
                metavar="WORKSPACE",
                help="finished by `traps run mechanism`, one a seed: their figures go into assets/pocket/mechanism.csv",
            )


# --- commands ---------------------------------------------------------------------------------------------------------


def doctor(arguments: argparse.Namespace) -> int:
    """See `traps doctor --help`."""
    from traps_pipeline.study.doctor import examine, examine_local

    who, needs = ("local models", "need") if arguments.local else ("the demo", "needs")
    problems = 0
    for finding in examine_local() if arguments.local else examine(_root(arguments)):
        print(f"{'ok  ' if finding.ok else 'FAIL'} {finding.what}: {finding.detail}", flush=True)
        problems += not finding.ok
    print(f"{problems} problem(s); {who} will not run" if problems else f"everything that {who} {needs} is here")
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


def compare_studies(arguments: argparse.Namespace) -> int:
    """See `traps compare --help`."""
    from traps_pipeline.judging.verdicts import current
    from traps_pipeline.scoring.contrasts import version_contrasts
    from traps_pipeline.storage.workspace import Workspace
    from traps_pipeline.tables import VERDICTS

    studies = Workspace.open(arguments.other), Workspace.open(_root(arguments))
    then, now = (current(study, VERDICTS) for study in studies)
    table = version_contrasts(then, now)
    if arguments.csv:
        table.to_csv(arguments.csv, index=False)
    shown = table.assign(refused=table["refused"].fillna(""))
    print(shown.to_string(index=False, na_rep="-", float_format=lambda value: f"{value:.4f}"))
    return OK


def init(arguments: argparse.Namespace) -> int:
    """See `traps init --help`."""
    workspace = _create(arguments, _experiment(arguments))
    print(f"workspace {workspace.root} (study.yaml names its benchmark, panel and budget)")
    print(f"next: export TRAPS_WORKSPACE={workspace.root} DAGSTER_HOME={workspace.dagster_home}")
    return OK


def plan(arguments: argparse.Namespace) -> int:
    """See `traps plan --help`."""
    from traps_pipeline.study.plan import Count, make_plan

    experiment, root = _experiment(arguments), _root(arguments)
    workspace = _open(root) if (root / "study.yaml").exists() else None
    _load_definitions()
    planned = make_plan(workspace, experiment)
    total = (Count(), Count())
    print(f"{experiment.name} in {root if workspace else 'a new workspace'}: calls wanted, known (in the ledger), new")
    print(f"{'model':<24} {'answers':>9} {'known':>9} {'new':>9}   {'votes':>9} {'known':>9} {'new':>9}")
    for model, counts in planned.calls.items():
        for sum_, count in zip(total, counts, strict=True):
            sum_.add(count.wanted, count.known)
        print(_plan_line(model, counts))
    for model, counts in planned.steered.items():
        for sum_, count in zip(total, counts, strict=True):
            sum_.add(count.wanted, count.known)
        print(_plan_line(f"{model}, steered", counts))
    if planned.labels is not None:
        total[1].add(planned.labels.wanted, planned.labels.known)
        print(_plan_line("confabulation labels", (Count(), planned.labels)))
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
    from traps_pipeline.progress import Tally, TerminalProgress, clock, reporting

    experiment = _experiment(arguments)
    workspace = _allow(_create(arguments, experiment), experiment, arguments)
    from traps_pipeline.definitions import defs
    from traps_pipeline.orchestration.run import dagster_history, failed_checks, stages_until, walk

    stages = stages_until(arguments.until)
    print(f"{experiment.name}: {experiment.description}\nworkspace {workspace.root}", flush=True)
    with reporting(TerminalProgress()) as progress, dagster_history(workspace) as instance:
        every_asset = defs.resolve_implicit_global_asset_job_def()
        outcome = walk(instance, every_asset, workspace, stages, experiment=experiment.name)
    problems = [*dict.fromkeys([*outcome.problems, *failed_checks(workspace, experiment.name)])]
    total = progress.totals
    asked, voted, drawn = (total.get(stage, Tally()) for stage in ("responses", "votes", "videos"))
    print(
        f"\n{asked.asked} answers asked ({asked.cached} from the ledger), {voted.asked} votes asked "
        f"({voted.cached} from the ledger), {drawn.frames} frames rendered, {clock(outcome.seconds)} min"
    )
    if experiment.mechanism is not None:
        states, steered, judged = (
            total.get(stage, Tally()) for stage in ("hidden_states", "steering", "steering_votes")
        )
        print(
            f"inside models: {states.asked} items extracted, {steered.asked} steered answers asked "
            f"({steered.cached} from the ledger), {judged.asked} votes on them"
        )
    if problems:
        for problem in problems:
            print(f"traps: {problem}", file=sys.stderr)
        print(
            f"traps: {len(problems)} problem(s); what is done is kept: run the same command to go on",
            file=sys.stderr,
        )
        return OVER_BUDGET if outcome.over_budget else FAILED
    if arguments.until is not None:
        print(f"next: traps run {arguments.experiment} for the stages after {arguments.until}")
        return OK
    _print_results(workspace)
    print(f"next: open {workspace.reports / 'report.html'}, or traps why ITEM for what stands behind a figure")
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
    from traps_pipeline.models.judges import load_judges
    from traps_pipeline.models.registry import get_model

    return name if name in load_judges() else get_model(name).id


def _print_results(workspace: Workspace) -> None:
    from traps_pipeline.report.page import leaderboard_text
    from traps_pipeline.tables import LEADERBOARD

    print(leaderboard_text(workspace.tables.read(LEADERBOARD, {})))
    pictures = ("figures/pecs_landscape.png", "contact_sheet.png", "shortcuts.png")
    for name in ("report.html", "leaderboard.md", "gallery.html", *pictures):
        print(workspace.reports / name)


def status(arguments: argparse.Namespace) -> int:
    """See `traps status --help`."""
    workspace = _open(_root(arguments))
    experiment = _experiment(arguments).name if arguments.experiment else None
    if experiment is not None and experiment not in workspace.study.experiments:
        raise TrapsError(
            f"{workspace.root}/study.yaml: has no experiment {experiment!r}; traps init {experiment} adds it"
        )
    from traps_pipeline.orchestration.history import History
    from traps_pipeline.orchestration.lineage import Lineage
    from traps_pipeline.orchestration.run import dagster_history
    from traps_pipeline.study.status import stage_statuses

    _load_definitions()
    lineage = Lineage(workspace)
    with dagster_history(workspace) as instance:
        History(instance, lineage.graph).observe(lineage)  # so that Dagster's UI shows the same partitions stale
    print(f"workspace {workspace.root}\n{'stage':<34} {'fresh':>6} {'stale':>6} {'missing':>8}")
    for row in stage_statuses(workspace, lineage, experiment):
        print(f"{row.stage:<34} {row.fresh:>6} {len(row.stale):>6} {row.missing:>8}")
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
    from traps_pipeline.study.why import why as explain

    for line in explain(_open(_root(arguments)), arguments.item):
        print(line)
    return OK


def export_results(arguments: argparse.Namespace) -> int:
    """See `traps export --help`."""
    from traps_pipeline.report.publish import INDEX
    from traps_pipeline.report.publish import export as write

    workspace = _open(_root(arguments))
    target = (arguments.folder or workspace.root / "export").absolute()
    count = write(workspace, target, say=lambda line: print(line, flush=True))
    print(f"{count} files in {target}\nnext: open {target / INDEX}")
    return OK


def export_calls(arguments: argparse.Namespace) -> int:
    """See `traps requests export --help`."""
    from traps_pipeline.study.exchange import REQUESTS, export_requests

    experiment = _experiment(arguments)
    count = export_requests(_open(_root(arguments)), experiment, arguments.out.absolute())
    print(f"{count} requests in {arguments.out / REQUESTS}")
    print(f"next: have them answered, then traps answers import {arguments.experiment} ANSWERS.jsonl")
    return OK


def import_given(arguments: argparse.Namespace) -> int:
    """See `traps answers import --help`."""
    from traps_pipeline.study.exchange import import_answers

    imported = import_answers(_open(_root(arguments)), _experiment(arguments), arguments.file)
    print(f"{imported.new} answers imported, {imported.known} were there already")
    print(f"next: traps run {arguments.experiment}")
    return OK


def check_models(arguments: argparse.Namespace) -> int:
    """See `traps models check --help`."""
    from traps_pipeline.study.wire_check import check_named

    wrong = 0
    for checked in check_named(arguments.names):
        print("\n    ".join([checked.line, *checked.problems]), flush=True)
        wrong += bool(checked.problems)
    print("every entry sends what it declares" if not wrong else f"{wrong} entries do not send what they declare")
    return FAILED if wrong else OK


def check_judges(arguments: argparse.Namespace) -> int:
    """See `traps judges check --help`."""
    from traps_pipeline.judging.robustness import check_panel, load_attacks, summary
    from traps_pipeline.models.judges import load_panel

    workspace = _open(_root(arguments))
    name = arguments.panel or workspace.study.panel
    rows = check_panel(workspace, name, load_panel(name), load_attacks())
    print(f"panel {name}: votes on {rows['attack'].nunique()} answers that try to instruct the judge")
    print(summary(rows))
    print("flipped: right on the plain answer, wrong under the attack; broken: no valid vote under it")
    return OK


def write_sheet(arguments: argparse.Namespace) -> int:
    """See `traps confabulation sheet --help`."""
    from traps_pipeline.judging.validation import annotation_sheet
    from traps_pipeline.judging.validation import write_sheet as write

    rows = annotation_sheet(_open(_root(arguments)))
    write(rows, arguments.file)
    print(f"{len(rows)} failures in {arguments.file}; two people each fill in a copy: their name, then 1 or 0 an axis")
    print("next: put both copies' rows into one file, then traps confabulation validate FILE.csv")
    return OK


def validate_judge(arguments: argparse.Namespace) -> int:
    """See `traps confabulation validate --help`."""
    from traps_pipeline.judging.validation import validate, validation_text

    print(validation_text(validate(_open(_root(arguments)), arguments.file)))
    return OK


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


def pocket_command(arguments: argparse.Namespace) -> int:
    """See `traps pocket --help`."""
    from traps_pipeline.pocket.commands import COMMANDS

    COMMANDS[arguments.pocket](arguments)
    return OK


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

    return _entered(Workspace.open(root))


def _entered(workspace: Workspace) -> Workspace:
    """The workspace, named to everything that this process loads and starts: partition keys are those of its study."""
    from traps_pipeline.storage.workspace import VARIABLE

    os.environ[VARIABLE] = str(workspace.root)
    os.environ.setdefault("DAGSTER_HOME", str(workspace.dagster_home))
    return workspace


def _load_definitions() -> None:
    """Declare the graph, which staleness is read off. Not at the top: `traps --help` answers at once."""
    import importlib

    importlib.import_module("traps_pipeline.definitions")


def _create(arguments: argparse.Namespace, experiment: Experiment) -> Workspace:
    from traps_pipeline.storage.workspace import Workspace

    workspace = Workspace.create(_root(arguments), experiment.study)
    experiment.check_study(workspace.study, workspace.root / "study.yaml")
    if experiment.mechanism is not None and workspace.study.mechanism is None:
        workspace = workspace.allow(mechanism=experiment.mechanism)
    asked = workspace.study.experiments | {experiment.name: experiment.asked}
    if asked != workspace.study.experiments:
        workspace = workspace.allow(experiments=asked)
    _entered(workspace)
    from traps_pipeline.orchestration.run import dagster_history

    with dagster_history(workspace):  # opened once here, so that several processes may use it afterwards
        return workspace


def _experiment(arguments: argparse.Namespace) -> Experiment:
    from traps_pipeline.study.experiment import load_experiment

    return load_experiment(arguments.experiment)


if __name__ == "__main__":
    sys.exit(main())
