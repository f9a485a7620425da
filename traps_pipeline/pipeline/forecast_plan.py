"""Plan an experiment (`traps plan`): calls, tokens, dollars, minutes, GPU-hours."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from traps_pipeline.benchmark.corrections import load_scenarios, load_two_events
from traps_pipeline.benchmark.items import expected_items
from traps_pipeline.judging.confabulation import sample_failures
from traps_pipeline.judging.confabulation_protocol import load_protocol
from traps_pipeline.judging.judging_rows import VOTES
from traps_pipeline.judging.panel import tasks_for, vote_requests
from traps_pipeline.mechanism.cost import CARDS, RANDOM, ROWS_BEHIND, Cost, Work, cost_of, mechanism_passes
from traps_pipeline.mechanism.mechanism_rows import HIDDEN_STATES
from traps_pipeline.mechanism.probing_versions import mechanism_entry
from traps_pipeline.mechanism.steering import count_answers
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.models.asking.answers import answer_request, asked_items, is_prepared, response_row
from traps_pipeline.models.money.forecast import Experience, Forecast, experience, forecast, minutes_of
from traps_pipeline.models.registry.entries import LOCAL, NETWORK, Entry, get_model
from traps_pipeline.models.registry.judges import JudgeEntry, load_panel
from traps_pipeline.models.request import JUDGED_OUTCOMES
from traps_pipeline.pipeline.experiment import Experiment
from traps_pipeline.pipeline.graph import Node
from traps_pipeline.pipeline.lineage import Lineage
from traps_pipeline.pipeline.run_plan import RunPlan
from traps_pipeline.protocol.cells import Cell, SteeredEvaluation
from traps_pipeline.protocol.datasets import (
    DATASETS,
    TWO_EVENTS,
    UNPAIRED,
    all_datasets_of,
    datasets_of_category,
    sides_of,
)
from traps_pipeline.protocol.two_events import ITEMS_A_SIDE
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.tables import Table
from traps_pipeline.storage.workspace import Workspace

LABEL_TOKENS = 2500  # estimated prompt of a label: instructions, answer and, for half of the models, a trace


@dataclass
class Count:
    """The number of wanted calls, and of those that the ledger already answers (known)."""

    wanted: int = 0
    known: int = 0

    @property
    def new(self) -> int:
        """The number of calls still to be sent."""
        return self.wanted - self.known

    def add(self, wanted: int, known: int) -> None:
        """Add to both counts in place."""
        self.wanted, self.known = self.wanted + wanted, self.known + known


@dataclass(frozen=True)
class CallPlan:
    """The calls of an experiment, which cost money or time.

    calls: answers and votes by model. uncertain: datasets with items that are unknown before a run has made them; their
    calls are counted as new, which is an upper bound. forecasts: tokens, dollars and minutes of the new calls over the
    network, by model and judge. labels: calls to the confabulation judge; None if the study's panel has none. steered:
    answers of steered models and votes on them, by model. pairs: their number by dataset. local: GPU costs of local
    models.
    """

    calls: Mapping[str, tuple[Count, Count]]
    uncertain: Sequence[str]
    forecasts: Sequence[Forecast]
    labels: Count | None
    steered: Mapping[str, tuple[Count, Count]] = field(default_factory=dict)
    pairs: Mapping[str, int] = field(default_factory=dict)
    local: Sequence[Cost] = ()

    @property
    def minutes(self) -> float:
        """The minutes that all calls take: models run in parallel, and then judges."""
        models = [row for row in self.forecasts if row.participant in self.calls]
        judges = [row for row in self.forecasts if row.participant not in self.calls]
        return minutes_of(models) + minutes_of(judges)


def plan_calls(plan: RunPlan | None, experiment: Experiment, study: Study, card: str = "H100") -> CallPlan:
    """Return an experiment's calls with a forecast of their cost; nothing is sent or written.

    plan: of its workspace, None for a new one. study: with the panel that judges. card: one of CARDS.
    """
    panel = load_panel(study.panel)
    calls, uncertain_datasets, items = _count_calls(plan, experiment, study)
    steered_counts = _count_steered(plan, experiment, study)
    local = [*_local_costs(plan, experiment, study, card, calls, steered_counts)]
    votes = sum(count.new for _, count in [*calls.values(), *steered_counts.values()])
    new: list[tuple[Entry, int]] = [(get_model(model), answers.new) for model, (answers, _) in calls.items()]
    new += [(judge, votes // len(panel)) for judge in panel]
    new = [(entry, count) for entry, count in new if entry.backend == NETWORK]
    scenarios_by_category = Counter(s.category for s in load_scenarios(study).values())
    pairs = {
        dataset: sum(n for category, n in scenarios_by_category.items() if dataset in datasets_of_category(category))
        for dataset in DATASETS
        if dataset in experiment.datasets
    }
    ledgers = [ledger.totals() for ledger in (plan.workspace.answers, plan.workspace.votes)] if plan else []
    forecasts = [
        forecast(entry, count, experience(totals[entry.id] for totals in ledgers if entry.id in totals), items)
        for entry, count in new
    ]
    judge = load_protocol().judge(study.panel)
    labels = _count_labels(plan, experiment, judge) if judge else None
    if judge and labels and labels.new:
        cost = forecast(judge, labels.new, Experience(prompt_tokens=LABEL_TOKENS))
        forecasts.append(replace(cost, participant="confabulation labels"))
    return CallPlan(calls, uncertain_datasets, forecasts, labels, steered_counts, pairs, local)


def _count_steered(plan: RunPlan | None, experiment: Experiment, study: Study) -> dict[str, tuple[Count, Count]]:
    """Count the calls for steered models' answers and the panel's votes, by model."""
    settings, counts = experiment.mechanism, dict[str, tuple[Count, Count]]()
    if settings is None or settings.steering is None:
        return counts
    scenarios, seats = load_scenarios(study).values(), len(load_panel(study.panel))
    taxonomies = [datasets_of_category(scenario.category)[0] for scenario in scenarios]
    for model in settings.models:
        answers, votes = counts[model] = (Count(), Count())
        datasets = [name for name in experiment.datasets if name in DATASETS]
        for regime, side_counts in count_answers(settings, model, datasets, Counter(taxonomies)).items():
            n_answers, ballots = side_counts.total(), seats * sum(len(tasks_for(s)) * n for s, n in side_counts.items())
            folder, ledgers = (
                SteeredEvaluation(model, regime, 1).key,
                (plan.workspace.answers, plan.workspace.votes) if plan else (),
            )
            settled = [len(ledger.read(folder).settled) for ledger in ledgers] or [0, 0]
            answers.add(n_answers, min(settled[0], n_answers))
            votes.add(ballots, min(settled[1], ballots))
    return counts


def _local_costs(
    plan: RunPlan | None,
    experiment: Experiment,
    study: Study,
    card: str,
    calls: Mapping[str, tuple[Count, Count]],
    steered: Mapping[str, tuple[Count, Count]],
) -> Iterator[Cost]:
    """Yield each local model's GPU cost: new answers, and passes for states, patches."""
    settings, scenarios = experiment.mechanism, load_scenarios(study).values()
    taxonomies = Counter(datasets_of_category(scenario.category)[0] for scenario in scenarios)
    for model in dict.fromkeys([*calls, *(settings.models if settings else ())]):
        entry = get_model(model)
        if entry.backend != LOCAL or entry.media is None:
            continue
        tokens = min(entry.expected_completion_tokens, entry.local_params().max_new_tokens)
        work = [(entry, Work("answers", calls[model][0].new, tokens), entry.local_params())] if model in calls else []
        if settings and model in settings.models:
            inside_entry, params = mechanism_entry(entry, settings), entry.inside_params()
            parts = plan.workspace.tables.partitions(HIDDEN_STATES) if plan else []
            if not any(part["model"] == model for part in parts):
                passes_of_all = mechanism_passes(settings, experiment.datasets, taxonomies, entry.has_random_weights)
                work += [(inside_entry, passes, params) for passes in passes_of_all]
            if settings.steering and model in steered:
                max_tokens = min(entry.expected_completion_tokens, settings.steering.max_new_tokens)
                answers = steered[model][0].new
                work.append((inside_entry, Work("steered answers", answers, max_tokens), params))
                work.append((inside_entry, Work("their perplexity", answers / ROWS_BEHIND), params))
        for media, passes, params in work:
            assert media.media is not None, "local entries have media"
            if passes.passes:
                is_quantised = params.quantisation == "nf4" and passes.kind != RANDOM
                yield cost_of(media, media.media, passes, CARDS[card], quantised=is_quantised)


def _count_labels(plan: RunPlan | None, experiment: Experiment, judge: JudgeEntry) -> Count:
    """Count confabulation labels, a full sample for models without verdicts."""
    protocol, cell_keys = load_protocol(), {cell.key for cell in experiment.cells()}
    labels = Count()
    for model in protocol.models:
        cells = [cell for cell in protocol.cells(model) if cell.key in cell_keys]
        if not cells:
            continue
        if plan is None or not _is_judged(plan.lineage, cells):
            labels.add(protocol.n, 0)
            continue
        samples = sample_failures(plan.workspace, judge, model).values()
        keys = {failure.request.key for failures in samples for failure in failures}
        labels.add(len(keys), len(plan.workspace.votes.read(cells[0].evaluation.key, keys).settled))
    return labels


def _is_judged(lineage: Lineage, cells: Sequence[Cell]) -> bool:
    """Return whether current verdicts exist of all cells whose dataset has items."""
    with_items = [cell for cell in cells if lineage.state("items", cell.dataset) is not None]
    return bool(with_items) and all(lineage.status("verdicts", cell.key).kind == "fresh" for cell in with_items)


def _count_calls(
    plan: RunPlan | None, experiment: Experiment, study: Study
) -> tuple[dict[str, tuple[Count, Count]], list[str], Counter[str]]:
    counts = {model: (Count(), Count()) for model in experiment.models}
    panel = load_panel(study.panel)
    scenes = Counter(name for scenario in load_scenarios(study).values() for name in all_datasets_of(scenario.category))
    scenes[TWO_EVENTS] = ITEMS_A_SIDE * len(load_two_events(study))
    current = {dataset for dataset in experiment.datasets if plan and _has_current_items(plan.lineage, dataset)}
    items = {d: _items(plan, d, scenes[d], is_current=d in current) for d in experiment.datasets}
    for cell in experiment.cells():
        answers, votes = counts[cell.evaluation.model]
        cell_items, unknown_items = items[cell.dataset]
        answers.add(unknown_items.total(), 0)
        votes.add(len(panel) * sum(len(tasks_for(side)) * n for side, n in unknown_items.items()), 0)
        if plan is None:
            continue
        # A fresh cell of current items is complete: skip building its keys and reading its ledger.
        fresh_answers, cast = (_count_fresh_rows(plan.lineage, table, cell) for table in (RESPONSES, VOTES))
        if fresh_answers is not None and cast is not None and cell.dataset in current:
            answers.add(fresh_answers, fresh_answers)
            votes.add(cast, cast)
        else:
            _count_cell(plan.workspace, panel, cell, cell_items, answers, votes)
    uncertain = sorted(dataset for dataset, (_, unknown_items) in items.items() if unknown_items)
    sizes = Counter({dataset: len(known) + unknown.total() for dataset, (known, unknown) in items.items()})
    return counts, uncertain, sizes


def _items(
    plan: RunPlan | None, dataset: str, scenes: int, *, is_current: bool
) -> tuple[list[dict[str, Any]], Counter[str]]:
    """Return a dataset's items in the next run, and counts by side of unknown ones."""
    unknown_items = Counter(dict.fromkeys(sides_of(dataset), scenes))
    if plan is None or not _is_there(plan.lineage, ("items", dataset)):
        return [], unknown_items
    workspace, lineage = plan.workspace, plan.lineage
    if is_current:
        return asked_items(workspace, dataset), Counter()
    for stage, key in _input_versions(lineage, dataset):
        state, is_lost = lineage.state(stage, key), stage != "items" and lineage.damage(stage, key)
        if is_lost or (state and state.code != lineage.graph[stage].code):
            return [], unknown_items
    if dataset in UNPAIRED and lineage.state("items", dataset):  # not every scenario admits all
        unknown_items = Counter(workspace.tables.read_all(ITEMS, ["side"], dataset=dataset)["side"])
    items = expected_items(workspace, dataset)
    return items, unknown_items - Counter(item["side"] for item in items)


def _count_cell(
    workspace: Workspace,
    panel: Sequence[JudgeEntry],
    cell: Cell,
    items: Sequence[Mapping[str, Any]],
    answers: Count,
    votes: Count,
) -> None:
    """Count a cell's calls: votes by key on known answers, and all on missing ones."""
    entry, folder = get_model(cell.evaluation.model), cell.evaluation.key
    keys = {  # an item without media was never asked
        item["item_id"]: answer_request(workspace, entry, item, cell.evaluation).key
        for item in items
        if is_prepared(workspace, entry, item)
    }
    rows = workspace.answers.read(folder, {*keys.values()}).settled
    traces = workspace.answers.reasoning(folder, rows)
    ballots, n_new = set[str](), 0
    for item in items:
        row, tasks = rows.get(keys.get(item["item_id"], "")), tasks_for(item["side"])
        if row is None:
            n_new += len(panel) * len(tasks)
            continue
        answer = response_row(cell, item, row, traces.get(row["key"]))
        if answer.outcome in JUDGED_OUTCOMES and answer.text is not None:
            for task in tasks:
                ballots |= {request.key for request in vote_requests(panel, task, cell, item, answer.text)}
    answers.add(len({*keys.values()}) + len(items) - len(keys), len(rows))
    votes.add(len(ballots) + n_new, len(workspace.votes.read(folder, ballots).settled))


def _count_fresh_rows(lineage: Lineage, table: Table[Any], cell: Cell) -> int | None:
    """Return the number of rows of a cell's table; None unless it is fresh."""
    state = lineage.state(table.name, cell.key)
    return state.rows if state and lineage.status(table.name, cell.key).kind == "fresh" else None


def _has_current_items(lineage: Lineage, dataset: str) -> bool:
    """Return whether a dataset's items and everything upstream are current."""
    return all(lineage.status(*node).kind == "fresh" for node in _input_versions(lineage, dataset))


def _input_versions(lineage: Lineage, dataset: str) -> list[Node]:
    """Return the existing partitions of a dataset's items and of all upstream."""
    parents = lineage.graph.parents("items", dataset).items()
    inputs = [("items", dataset), *((stage, key) for stage, keys in parents for key in keys)]
    return [node for node in inputs if _is_there(lineage, node)]


def _is_there(lineage: Lineage, node: Node) -> bool:
    """Return whether a partition was made, be it damaged since."""
    return lineage.state(*node) is not None or bool(lineage.damage(*node))
