"""`traps plan`: what an experiment would ask, and what that would cost."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

from traps_pipeline.cli.command import OK, Commands, experiment_of, load_definitions, open_workspace, root_of

if TYPE_CHECKING:
    from traps_pipeline.models.forecast import Forecast
    from traps_pipeline.study.plan import Count


def add(commands: Commands) -> None:
    """Add `traps plan`."""
    parser = commands.add("plan", plan, "count the calls of an experiment: wanted, known, new; nothing is sent")
    parser.add_argument("experiment")


def plan(arguments: argparse.Namespace) -> int:
    """See `traps plan --help`."""
    from traps_pipeline.study.plan import Count, make_plan

    experiment, root = experiment_of(arguments), root_of(arguments)
    workspace = open_workspace(arguments) if (root / "study.yaml").exists() else None
    load_definitions()
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


def _plan_line(name: str, counts: tuple[Count, Count]) -> str:
    answers, votes = ((count.wanted, count.known, count.new) for count in counts)
    return (
        f"{name:<24} {answers[0]:>9,} {answers[1]:>9,} {answers[2]:>9,}   {votes[0]:>9,} {votes[1]:>9,} {votes[2]:>9,}"
    )


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
