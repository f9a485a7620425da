"""Print an experiment's calls and their cost (`traps plan`)."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from math import comb
from typing import TYPE_CHECKING

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.terminal import plain, text_table, wrap_text
from traps_pipeline.base.wording import count_noun, in_percent
from traps_pipeline.cli.command import (
    OK,
    Commands,
    add_experiment,
    add_panel,
    experiment_of,
    ledger_faults,
    load_definitions,
    open_workspace,
    place_of,
    print_json,
)
from traps_pipeline.protocol.datasets import taxonomy_of

if TYPE_CHECKING:
    from traps_pipeline.mechanism.cost import Cost
    from traps_pipeline.models.money.forecast import Forecast


def add(commands: Commands) -> None:
    """Add `traps plan` to the parser."""
    text = "count the calls of an experiment, with their price and the precision of PECS; nothing is sent"
    parser = commands.add("study plan", plan, text, example="demo", json=True)
    add_experiment(parser)
    parser.add_argument(
        "--card", default="H100", help="GPU for which hours are estimated: H100 (default), A100, L40S, RTX4090"
    )
    add_panel(parser)


def plan(arguments: argparse.Namespace) -> int:
    from traps_pipeline.mechanism.cost import CARDS
    from traps_pipeline.pipeline.forecast_plan import Count, plan_calls
    from traps_pipeline.pipeline.run_plan import RunPlan
    from traps_pipeline.storage.workspace import Workspace

    experiment, place = experiment_of(arguments), place_of(arguments)
    workspace = open_workspace(arguments) if Workspace.is_there(place) else None
    load_definitions()
    study = experiment.judged(
        workspace.study if workspace else None, arguments.panel, judged_by_rules=arguments.judged_by_rules
    )
    if arguments.card not in CARDS:
        raise TrapsError(f"--card {arguments.card}: name one of {', '.join(CARDS)}")
    run_plan = RunPlan(workspace, experiment.name) if workspace else None
    plan_counts = plan_calls(run_plan, experiment, study, arguments.card)
    # An experiment that the study does not hold in this form wants other partitions, which a run would add.
    is_held = workspace is not None and workspace.study.experiments.get(experiment.name) == experiment.asked
    stages = [status for status in run_plan.statuses() if status.to_make] if run_plan and is_held else []
    faults = ledger_faults(workspace) if workspace else []
    if arguments.json:
        head = {"experiment": experiment.name, "workspace": str(place) if workspace else None, "ledger": faults}
        print_json(head | {"plan": plan_counts, "stages": stages})
        return OK
    total = (Count(), Count())
    for fault in faults:
        print(wrap_text(plain(fault)))
    location = place if workspace else "a new workspace"
    print(wrap_text(f"{experiment.name} in {location}: calls wanted, known (in the ledger), new"))
    rows = {**plan_counts.calls, **{f"{model}, steered": counts for model, counts in plan_counts.steered.items()}}
    if plan_counts.labels is not None and plan_counts.labels.wanted:
        rows["confabulation labels"] = (Count(), plan_counts.labels)
    for counts in rows.values():
        for sum_, count in zip(total, counts, strict=True):
            sum_.add(count.wanted, count.known)
    headings = ("model", "answers", "known", "new", "votes", "known", "new")
    cells = [
        [name, *(f"{number:,}" for count in counts for number in (count.wanted, count.known, count.new))]
        for name, counts in [*rows.items(), ("all", total)]
    ]
    print(text_table(headings, cells))
    if plan_counts.forecasts:
        _print_forecasts(plan_counts.forecasts, plan_counts.minutes)
    if plan_counts.local:
        _print_local(plan_counts.local, arguments.card)
    _print_precision(plan_counts.pairs, len(plan_counts.calls))
    if stages:
        order = ", ".join(f"{status.stage} {status.to_make:,}" for status in stages)
        print(wrap_text(f"\npartitions to make, in this order: {order}; `traps status` says why"))
    if plan_counts.uncertain:
        text = (
            f"This is an upper bound: items of {', '.join(plan_counts.uncertain)} are still to be made, so all of "
            "their calls are counted as new. `traps run EXPERIMENT --until items` makes them, for exact counts."
        )
        print(wrap_text(text))
    return OK


def _print_precision(pairs: Mapping[str, int], models: int) -> None:
    from traps_pipeline.scoring.power import Shares, precision

    if any(pairs.values()):
        expected, example = precision(pairs, models=models), Shares()
        acc, abs_rec, false_abs = map(in_percent, (example.acc, example.abs_rec, example.false_abs))
        text = (
            f"\nprecision with {count_noun(sum(pairs.values()), 'pair')}: a model with Acc {acc}, AbsRec {abs_rec}, "
            f"FalseAbs {false_abs} (PECS {example.pecs:.2f}) gets a 95 % interval of PECS about {expected.width:.3f} "
            f"wide; {_power(expected.difference, 'two models with unrelated answers')}"
        )
        if (balanced := _balanced(pairs, models)) and balanced[1] < (expected.difference or 2.0):
            text += f"; as many scenarios, but {balanced[0]} of each taxonomy, find one of {balanced[1]:.3f}"
        if models > 2:
            all_models = f"two of {models} models, after Holm's correction over their {comb(models, 2)} comparisons"
            text += f"\n{_power(expected.among_all, all_models)}"
        print(wrap_text(text))


def _balanced(pairs: Mapping[str, int], models: int) -> tuple[int, float] | None:
    """Return scenarios of each taxonomy and what they detect, if one has less than half of the other's."""
    from traps_pipeline.scoring.power import precision

    sizes = {taxonomy_of(name): count for name, count in pairs.items() if count}
    if len(sizes) != 2 or 2 * min(sizes.values()) > max(sizes.values()):
        return None
    half = sum(sizes.values()) // 2
    difference = precision({name: half for name, count in pairs.items() if count}, models=models).difference
    return None if difference is None else (half, difference)


def _power(least: float | None, models: str) -> str:
    if least is None:
        return f"the pairs are too few for 80 % of studies to find a difference between {models}"
    return f"80 % of studies find a difference of {least:.3f} between {models}"


def _print_forecasts(forecasts: Sequence[Forecast], minutes: float) -> None:
    """Print tokens, dollars and minutes of new calls; sums omit unknown prices."""
    known_dollars = [row.dollars for row in forecasts if row.dollars is not None]
    total = (sum(d[0] for d in known_dollars), sum(d[1] for d in known_dollars), sum(d[2] for d in known_dollars))
    calls = sum(row.calls for row in forecasts)
    rows = [
        (
            row.participant,
            f"{row.calls:,}",
            f"{row.prompt_tokens / 1e6:.2f}, {row.completion_tokens / 1e6:.2f}",
            *_dollars(row.dollars),
            f"{row.minutes:,.0f}",
        )
        for row in forecasts
    ]
    rows.append(("all", f"{calls:,}", "", *_dollars(total), f"{minutes:,.0f}"))
    headings = ("over the network", "calls", "tokens (M)", "USD low", "expected", "high", "minutes")
    print(f"\n{text_table(headings, rows)}")
    print("tokens: millions read, written; minutes of all: models, then judges")
    for row in forecasts:
        if row.queued_minutes >= 1 and row.queued_minutes > 2 * row.minutes:
            duration = f"{row.queued_minutes:,.0f} minutes"
            print(wrap_text(f"{row.participant}: {duration} instead, if its server takes one call at a time"))
    batch_usd = sum(row.dollars[1] * row.batch_price for row in forecasts if row.dollars is not None)
    if batch_usd < total[1]:
        heading = "expected if all calls are made in batches (traps study export-requests --batch)"
        print(wrap_text(f"{heading}: USD {batch_usd:,.2f}"))
    if len(known_dollars) < len(forecasts):
        unknown = ", ".join(row.participant for row in forecasts if row.dollars is None)
        print(wrap_text(f"price unknown, not in the sum: {unknown}"))


def _print_local(costs: Sequence[Cost], card: str) -> None:
    """Print passes, tokens, GPU-hours, memory, and what does not fit; sums omit models without a size."""
    from traps_pipeline.mechanism.cost import CARDS, too_large
    from traps_pipeline.models.registry.entries import get_model

    rows = [
        (
            cost.model, cost.kind, f"{cost.passes:,}", f"{cost.tokens_in / 1e6:,.2f}, {cost.tokens_out / 1e6:,.2f}",
            *("unknown" if number is None else f"{number:,.1f}" for number in (cost.hours, cost.gigabytes)),
        )
        for cost in costs
    ]  # fmt: skip
    hours = sum(cost.hours or 0.0 for cost in costs)
    rows.append(("all", "", f"{sum(cost.passes for cost in costs):,}", "", f"{hours:,.1f}", ""))
    print(f"\n{text_table(('on this machine', 'work', 'new', 'M tokens in, out', f'{card} hours', 'GB'), rows)}")
    print("hours and GB are arithmetic, checked on one card: docs/mechanism.md#cost")
    quantised = {c.model for c in costs if get_model(c.model).inside_params().quantisation == "nf4"}
    for sentence in too_large(costs, CARDS[card], quantised):
        print(wrap_text(sentence))


def _dollars(amounts: tuple[float, float, float] | None) -> list[str]:
    return ["unknown" if amounts is None else f"{amounts[k]:,.2f}" for k in range(3)]
