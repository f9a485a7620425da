"""`traps plan`: the calls that an experiment would make, with their tokens, dollars and minutes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from traps_pipeline.base.partitions import (
    BESIDE,
    DATASETS,
    Cell,
    Evaluation,
    SteeredEvaluation,
    all_datasets_of,
    datasets_of_category,
    sides_of,
)
from traps_pipeline.benchmark.corrections import load_scenarios
from traps_pipeline.benchmark.tables import ITEMS
from traps_pipeline.judging.confabulation import load_protocol, sample_failures
from traps_pipeline.judging.panel import tasks_for, wanted_ballots
from traps_pipeline.judging.tables import VOTES
from traps_pipeline.mechanism.steering import count_answers
from traps_pipeline.models.answers import answer_request, is_prepared
from traps_pipeline.models.forecast import Experience, Forecast, experience, forecast, minutes_of
from traps_pipeline.models.judges import JudgeEntry, load_panel
from traps_pipeline.models.registry import NETWORK, Entry, get_model
from traps_pipeline.models.tables import RESPONSES
from traps_pipeline.orchestration.lineage import Lineage
from traps_pipeline.storage.ledger import Ledger
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.tables import Table
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.study.experiment import Experiment

LABEL_TOKENS = 2500  # estimated prompt of a label: instructions, answer and, for half of the models, a trace


@dataclass
class Count:
    """Numbers of calls: wanted, and of these already in the ledger (known)."""

    wanted: int = 0
    known: int = 0

    @property
    def new(self) -> int:
        """The number of calls still to be made."""
        return self.wanted - self.known

    def add(self, wanted: int, known: int) -> None:
        """Add to both counts in place."""
        self.wanted, self.known = self.wanted + wanted, self.known + known


@dataclass(frozen=True)
class Plan:
    """The calls of an experiment. calls: answers and votes by model. uncertain: datasets whose items are not current;
    since their items may change, all of their calls are counted as new, which is an upper bound. forecasts: tokens,
    dollars and minutes of the new calls over the network, by model and judge. labels: calls to the confabulation judge;
    None if the study's panel has none. steered: answers of steered models and votes on them, by model. pairs: how many
    there are, by dataset."""

    calls: Mapping[str, tuple[Count, Count]]
    uncertain: Sequence[str]
    forecasts: Sequence[Forecast]
    labels: Count | None
    steered: Mapping[str, tuple[Count, Count]] = field(default_factory=dict)
    pairs: Mapping[str, int] = field(default_factory=dict)

    @property
    def minutes(self) -> float:
        """Of all calls: models are asked side by side, and then judges."""
        models = [row for row in self.forecasts if row.participant in self.calls]
        judges = [row for row in self.forecasts if row.participant not in self.calls]
        return minutes_of(models) + minutes_of(judges)


def make_plan(workspace: Workspace | None, experiment: Experiment, study: Study) -> Plan:
    """Count the calls of an experiment and forecast their cost; nothing is sent and nothing is made. study: the
    workspace's, or the one that a new workspace would have, with the panel that judges."""
    panel = load_panel(study.panel)
    calls, uncertain = _count_calls(workspace, experiment, study)
    steered = _count_steered(workspace, experiment, study)
    votes = sum(count.new for _, count in [*calls.values(), *steered.values()])
    new: list[tuple[Entry, int]] = [(get_model(model), answers.new) for model, (answers, _) in calls.items()]
    new += [(judge, votes // len(panel)) for judge in panel]
    new = [(entry, count) for entry, count in new if entry.backend == NETWORK]
    of_category = Counter(s.category for s in load_scenarios(study).values())
    pairs = {
        dataset: sum(n for category, n in of_category.items() if dataset in datasets_of_category(category))
        for dataset in DATASETS
        if dataset in experiment.datasets
    }
    ledgers = [ledger.totals() for ledger in (workspace.answers, workspace.votes)] if workspace else []
    forecasts = [
        forecast(entry, count, experience(totals[entry.id] for totals in ledgers if entry.id in totals))
        for entry, count in new
    ]
    judge = load_protocol().judge(study.panel)
    if judge is None:
        return Plan(calls, uncertain, forecasts, None, steered, pairs)
    labels = _count_labels(workspace, experiment, judge)
    taken = forecast(judge, labels.new, Experience(prompt_tokens=LABEL_TOKENS))
    forecasts.append(replace(taken, participant="confabulation labels"))
    return Plan(calls, uncertain, forecasts, labels, steered, pairs)


def _count_steered(workspace: Workspace | None, experiment: Experiment, study: Study) -> dict[str, tuple[Count, Count]]:
    """Calls for the answers of steered models, and for the panel's votes on them, by model."""
    settings, counts = experiment.mechanism, dict[str, tuple[Count, Count]]()
    if settings is None or settings.steering is None:
        return counts
    scenarios, seats = load_scenarios(study).values(), len(load_panel(study.panel))
    taxonomies = [datasets_of_category(scenario.category)[0] for scenario in scenarios]
    for model in settings.models:
        answers, votes = counts[model] = (Count(), Count())
        datasets = [name for name in experiment.datasets if name in DATASETS]
        for regime, by_side in count_answers(settings, model, datasets, Counter(taxonomies)).items():
            wanted, ballots = by_side.total(), seats * sum(len(tasks_for(s)) * n for s, n in by_side.items())
            folder, known = SteeredEvaluation(model, regime, 1).key, [0, 0]
            if workspace is not None:
                known = [len(ledger.read(folder).settled) for ledger in (workspace.answers, workspace.votes)]
            answers.add(wanted, min(known[0], wanted))
            votes.add(ballots, min(known[1], ballots))
    return counts


def _count_labels(workspace: Workspace | None, experiment: Experiment, judge: JudgeEntry) -> Count:
    """Calls to the confabulation judge about the experiment's models; a model that is not judged yet counts with a full
    sample."""
    protocol, wanted = load_protocol(), {cell.key for cell in experiment.cells()}
    labels, known, lineage = Count(), _KnownKeys(), Lineage(workspace) if workspace else None
    for model in protocol.models:
        cells = [cell for cell in protocol.cells(model) if cell.key in wanted]
        if not cells:
            continue
        if workspace is None or lineage is None or not _judged(lineage, cells):
            labels.add(protocol.n, 0)
            continue
        samples = sample_failures(workspace, judge, model).values()
        keys = {failure.request.key for failures in samples for failure in failures}
        labels.add(len(keys), len(keys & known.of(workspace.votes, cells[0].evaluation)))
    return labels


def _judged(lineage: Lineage, cells: Sequence[Cell]) -> bool:
    """Whether the verdicts of all cells whose dataset has items exist and are current."""
    made = [cell for cell in cells if lineage.state("items", cell.dataset) is not None]
    return bool(made) and all(lineage.status("verdicts", cell.key).kind == "fresh" for cell in made)


def _count_calls(
    workspace: Workspace | None, experiment: Experiment, study: Study
) -> tuple[dict[str, tuple[Count, Count]], list[str]]:
    plan = {model: (Count(), Count()) for model in experiment.models}
    scenarios, panel = load_scenarios(study).values(), load_panel(study.panel)
    known, lineage, uncertain = _KnownKeys(), Lineage(workspace) if workspace else None, set[str]()
    for cell in experiment.cells():
        answers, votes = plan[cell.evaluation.model]
        scenes = sum(cell.dataset in all_datasets_of(s.category) for s in scenarios)
        sides = sides_of(cell.dataset)
        items, votes_asked = len(sides) * scenes, len(panel) * sum(len(tasks_for(side)) for side in sides) * scenes
        if workspace is None or lineage is None or not _items_current(lineage, cell.dataset):
            uncertain.add(cell.dataset)
            answers.add(items, 0)
            votes.add(votes_asked, 0)
            continue
        # A fresh cell has every answer that it wants: its keys need not be made again, nor its ledger be read.
        answered = _fresh_rows(workspace, lineage, RESPONSES, cell)
        if answered is not None:
            answers.add(answered, answered)
        else:
            keys = _answer_keys(workspace, cell)
            wanted = len(keys) if cell.dataset in BESIDE else items  # not every scenario admits all
            answers.add(wanted, len(keys & known.of(workspace.answers, cell.evaluation)))
        if answered is None:
            votes.add(votes_asked, 0)
        elif (cast := _fresh_rows(workspace, lineage, VOTES, cell)) is not None:
            votes.add(cast, cast)
        else:
            ballots = {ballot.request.key for ballot in wanted_ballots(workspace, panel, cell)}
            votes.add(len(ballots), len(ballots & known.of(workspace.votes, cell.evaluation)))
    return plan, sorted(uncertain)


def _fresh_rows(workspace: Workspace, lineage: Lineage, table: Table[Any], cell: Cell) -> int | None:
    """The number of rows of a cell's table; None unless it is fresh."""
    state = workspace.tables.state(table, cell.partition)
    return state.rows if state and lineage.status(table.name, cell.key).kind == "fresh" else None


def _items_current(lineage: Lineage, dataset: str) -> bool:
    """Whether a dataset's items, and everything they are made from, are current."""
    if lineage.state("items", dataset) is None:
        return False
    above = [("items", dataset), *((s, k) for s, keys in lineage.graph.parents("items", dataset).items() for k in keys)]
    return all(lineage.status(stage, key).kind == "fresh" for stage, key in above if lineage.state(stage, key))


class _KnownKeys:
    """The keys with an answer in the ledgers, which are read once per evaluation."""

    def __init__(self) -> None:
        self._keys: dict[tuple[str, Evaluation], set[str]] = {}

    def of(self, ledger: Ledger, evaluation: Evaluation) -> set[str]:
        slot = (ledger.kind, evaluation)
        if slot not in self._keys:
            self._keys[slot] = {*ledger.read(evaluation.key).settled}
        return self._keys[slot]


def _answer_keys(workspace: Workspace, cell: Cell) -> set[str]:
    entry = get_model(cell.evaluation.model)
    items = workspace.tables.read(ITEMS, {"dataset": cell.dataset}).to_dict("records")
    sent = [item for item in items if is_prepared(workspace, entry, item)]  # an item without media was never asked
    return {answer_request(workspace, entry, item, cell.evaluation).key for item in sent}
