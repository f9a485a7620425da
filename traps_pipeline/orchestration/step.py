"""The one way to make a partition.

Whoever starts a run, the same protocol makes the partitions of a stage, in the one order that is sound: what the inputs
are is noted before anything is read; what cannot be made yet, or would be made from something damaged, is left with the
reason; each partition is written, read again, checked and told to Dagster as soon as it is done, with a data version
made from its content. Below a partition that is not made nothing is made, everything else is; the last step of a run
raises with all that is missing.
"""

import hashlib
import json
import os
from collections.abc import Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from typing import Any, cast

import dagster as dg

from traps_pipeline.base import progress
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.progress import Tally
from traps_pipeline.base.redaction import redacted
from traps_pipeline.base.workers import kept_workers
from traps_pipeline.models.budget import BudgetReached
from traps_pipeline.orchestration.graph import Collect, Node, Stage, name_of, the_graph
from traps_pipeline.orchestration.history import History
from traps_pipeline.orchestration.lineage import Lineage, write_report_state
from traps_pipeline.orchestration.machine import parts_of_run, require_machine, why_nothing
from traps_pipeline.orchestration.metadata import preview, visible_metadata
from traps_pipeline.orchestration.translation import asset_key
from traps_pipeline.orchestration.wanted import Wanted
from traps_pipeline.storage.leases import alone
from traps_pipeline.storage.parquet import Made, State
from traps_pipeline.storage.workspace import Workspace

CURRENT = "current"  # the check that every stage has
CURRENT_DOC = "Made from what is there now, whole, with no failed call: read again after writing."
MAKE_TAG, EXPERIMENT_TAG = "traps/make", "traps/experiment"  # of runs: what to make of what is selected, and for whom
BACKFILL_TAG = "dagster/backfill"  # of a run of many: one that has nothing to make must not end them
STALE, OUTDATED = "stale", "outdated"  # MAKE_TAG: what is not fresh; what is there and not fresh
REACHED = "a budget is reached"  # in a check's metadata
STILL = "still failing"  # in a check's metadata: of a partition that the run did not touch
TALLY, TAKEN = "tally", "taken over"  # in an event's metadata: what this run did for it; that another run has made it
_ATTEMPTS: dict[str, int] = {}  # by run: how often it had been resumed when this process began with it
RESUMED_ELSEWHERE = 5  # the exit code of a process whose run another one goes on with
SHOWN = 12  # unmade partitions named in an error
# Dagster skips a step below one that hands on no output, and writes an event with one version for all partitions for
# an output that is handed on, unless it carries this mark: observable sources that tell their own versions carry it.
_TOLD_ALREADY = {"__source_asset_observation__": True}
Event = dg.AssetMaterialization | dg.AssetCheckEvaluation | dg.MaterializeResult | dg.Output
# Steps that have begun and not ended. Where Dagster cannot write an event down it drops a step in the middle, in a
# reference cycle; the garbage collector would close it later, after the threads are gone that its calls in flight need,
# and wait for them for ever. What is held here is closed by us instead.
_BEGUN: list[Generator[Event, None, None]] = []


def close_dropped() -> None:
    """Close the steps of this process that were dropped in the middle: calls in flight come back and are stored, locks
    are given back."""
    while _BEGUN:
        _BEGUN.pop().close()


class Step:
    """One stage in one run."""

    def __init__(self, stage: Stage, context: dg.AssetExecutionContext, workspace: Workspace) -> None:
        self.stage, self.context, self.workspace = stage, context, workspace
        self.graph = the_graph()
        self.history = History(context.instance, self.graph)
        if context.run_id not in _ATTEMPTS:
            _ATTEMPTS[context.run_id] = context.instance.count_resume_run_attempts(context.run_id)
        self._wanted = Wanted(workspace, context.run.tags.get(EXPERIMENT_TAG))
        self.unmade: dict[str | None, TrapsError] = {}
        self.made_at: dict[str | None, int] = {}  # when partitions that other runs make, too, had been written
        self.taken: dict[str | None, tuple[str, Tally]] = {}  # made by others: version, and what was done here
        self.failing: dict[tuple[str, str | None], Mapping[str, Any]] = {}  # checks, with what is wrong

    def run(self) -> Iterator[Event]:
        """See the module."""
        close_dropped()
        events = self._events()
        _BEGUN.append(events)
        try:
            yield from events
        except Exception as error:  # Dagster stores its traceback
            if (shown := redacted(error)) is error:
                raise
            raise shown from None
        except (KeyboardInterrupt, dg.DagsterExecutionInterruptedError):
            # Else Dagster, which did not stop it itself, would call what a person has stopped a failure.
            run = self.context.instance.get_run_by_id(self.context.run_id)
            if run is not None and run.status == dg.DagsterRunStatus.STARTED:
                self.context.instance.report_run_canceling(run, "Stopped by a signal.")
            raise
        finally:
            if events in _BEGUN:
                _BEGUN.remove(events)

    def _events(self) -> Generator[Event, None, None]:
        stage, name = self.stage, self.stage.name
        require_machine(self.workspace, parts_of_run(self.context, self.stage, self._wanted))
        lineage = Lineage(self.workspace, thorough=True)
        self.history.observe(lineage, [p for p in self.graph.parents_of[name] if self.graph.source(p)])
        provenance = self.history.provenance(stage)
        todo = list[str | None]()
        for key in (yield from self._asked(lineage, provenance)):
            yield from self._tell_damage(lineage, key)
            if self.context.run.tags.get(MAKE_TAG) == OUTDATED and lineage.waits(name, key):
                continue  # for what is above it: it would be made twice
            if reason := lineage.blocked(name, key, current=MAKE_TAG in self.context.run.tags):
                self.unmade[key] = TrapsError(reason)
            else:
                todo.append(key)
        if todo:
            progress.current().stage(name, len(todo))
        inputs = {key: lineage.inputs(name, key) for key in todo}  # noted before anything is read
        if stage.shared is not None:
            self.made_at = {key: lineage.made_at(name, key) for key in todo}
        for key, made in self._make(todo, inputs):
            version = self._write(key, made, inputs[key])
            yield from self._checks(key, made)
            progress.current().partition(name, key or "", made.tally)
            yield self.history.event(stage, key, version, provenance, self._metadata(made))
        for key, (version, tally) in self.taken.items():
            progress.current().partition(name, key or "", tally)
            about = {TAKEN: "made by another run meanwhile", TALLY: json.dumps(vars(tally))}
            yield self.history.event(stage, key, version, provenance, about)
        if self.unmade:
            end_if_resumed(self.context.instance, self.context.run_id, _ATTEMPTS[self.context.run_id])
        for key, error in self.unmade.items():
            reached = isinstance(error, BudgetReached)
            yield self._evaluation(CURRENT, key, {"not made": str(error), REACHED: reached})
        yield from self._still_failing(lineage, {*todo, *self.unmade} - self.taken.keys())
        for output in self.context.op_def.output_dict:
            if output != "result":
                yield dg.Output(None, output_name=output)
        if not self._below():
            self._raise_for_all()
        yield dg.MaterializeResult(metadata=_TOLD_ALREADY)

    # --- what to make -------------------------------------------------------------------------------------------------

    def _asked(self, lineage: Lineage, provenance: Mapping[str, str]) -> Iterator[Any]:
        """The keys of this run that are to be made (the generator's value); tells Dagster of those that are not wanted.

        A range may hold cells that no experiment of the study asks for; they count as done, so that a backfill ends.
        """
        stage, tags = self.stage, self.context.run.tags
        keys: list[str | None] = [None] if stage.scheme is None else [str(key) for key in self.context.partition_keys]
        wanted = {*stage.wanted(self._wanted)}
        if MAKE_TAG in tags:
            recorded = self.history.recorded(stage.name)
            existing = tags[MAKE_TAG] == OUTDATED
            return [k for k in keys if k in wanted and to_make(lineage, recorded, stage.name, k, existing=existing)]
        if stage.scheme and not wanted & {*keys} and BACKFILL_TAG not in tags:
            raise TrapsError(f"{stage.name}: nothing is made: {why_nothing(keys, tags, self.workspace)}")
        for key in keys:
            if key not in wanted:
                why = f"nothing: no experiment in {self.workspace.root / 'study.yaml'} asks for it"
                yield self.history.event(stage, key, "not wanted", provenance, {"made": why})
        return [key for key in keys if key in wanted]

    def _tell_damage(self, lineage: Lineage, key: str | None) -> Iterator[dg.AssetCheckEvaluation]:
        """A failed check for each parent that is not what was written, before anything is made from it."""
        for parent, keys in self.graph.parents(self.stage.name, key).items():
            if self.graph.source(parent) is None:
                for above in keys:
                    if damage := lineage.damage(parent, above):
                        yield _evaluation(self.graph[parent], CURRENT, above, {"damaged": damage})

    # --- making it ----------------------------------------------------------------------------------------------------

    def _make(
        self, todo: Sequence[str | None], inputs: Mapping[str | None, Mapping[str, str]]
    ) -> Iterator[tuple[str | None, Made]]:
        """Each partition as it is done. One that ends in a sentence leaves the others to be made."""
        make = self.stage.make
        if not isinstance(make, Collect):
            for key, done in self._beside_others(todo, inputs):
                try:
                    made = make(self.workspace, key)
                except TrapsError as error:
                    self.unmade[key] = error
                    continue
                made.tally.add(done)
                yield key, made
            return
        left = [*todo]
        try:
            for key, made in make.partitions(self.workspace, [str(key) for key in todo]) if todo else ():
                left.remove(key)
                yield key, made
        except TrapsError as error:
            self.unmade |= dict.fromkeys(left, error)

    def _beside_others(
        self, todo: Sequence[str | None], inputs: Mapping[str | None, Mapping[str, str]]
    ) -> Iterator[tuple[str | None, Tally]]:
        """What is left for this run to make, where others may make the same, each once all files that it names are
        there, with what was done for them here: first what no other run is at. It is had alone until the next one is
        asked for."""
        if self.stage.shared is None:
            yield from ((key, Tally()) for key in todo)
            return
        store, later = self.workspace.store, dict[str | None, Tally]()
        with kept_workers():
            for key in todo:
                done = Tally()
                is_whole = self._make_files(key, done, wait=False)
                lease = store.lease(f"{self.stage.name}/{key}") if is_whole else None
                if lease is None:
                    later[key] = done
                    continue
                with closing(lease):
                    if not self._takes_over(key, inputs[key], done):
                        yield key, done
            for key, done in later.items():
                if key not in self.unmade and self._make_files(key, done, wait=True):
                    with alone(store, f"{self.stage.name}/{key}"):
                        if not self._takes_over(key, inputs[key], done):
                            yield key, done

    def _make_files(self, key: str | None, done: Tally, *, wait: bool) -> bool:
        """Make files that a partition names, and whether all are there. done: is told what was done here."""
        assert self.stage.shared is not None, "others may make the same"
        try:
            made, is_whole = self.stage.shared.files(self.workspace, key, wait)
        except TrapsError as error:
            self.unmade[key] = error
            return False
        done.add(made)
        return is_whole

    def _takes_over(self, key: str | None, inputs: Mapping[str, str], done: Tally) -> bool:
        """Whether another run has made a partition of the same inputs since this step began, and has told Dagster of it
        when it was checked, too. done: what was done for it here."""
        stage, lineage = self.stage, Lineage(self.workspace)
        state = lineage.state(stage.name, key)
        if state is None or lineage.made_at(stage.name, key) == self.made_at[key]:
            return False
        is_told = self.history.recorded(stage.name).get(key) == state.version
        if is_told and state.inputs == inputs and state.code == stage.code and not state.failed:
            self.taken[key] = state.version, done
        return key in self.taken

    def _write(self, key: str | None, made: Made, inputs: Mapping[str, str]) -> str:
        """Write what was made; returns its data version."""
        stage, tables, content = self.stage, self.workspace.tables, made.content
        if stage.table is not None:
            rows = cast(Any, content)
            return tables.write(
                stage.table, stage.columns(key), rows, inputs, failed=made.tally.errors, code=stage.code
            )
        files = cast(Mapping[str, bytes], content)
        self.workspace.store.write({self.workspace.reports / path: data for path, data in files.items()})
        version = hashlib.sha256(b"".join(files.values())).hexdigest()[:16]
        write_report_state(self.workspace, stage, State(version, dict(inputs), 0, 0, stage.code))
        return version

    def _checks(self, key: str | None, made: Made) -> Iterator[dg.AssetCheckEvaluation]:
        """Every check of a partition. A failure is kept in the workspace until the partition passes, so that each later
        run and `traps status` tell of it, even if this run dies before it reports to Dagster."""
        stage, failed = self.stage, made.tally.errors
        damage = ""
        if stage.table is not None:
            damage = self.workspace.tables.damage(stage.table, stage.columns(key), thorough=True)
        wrong: dict[str, Any] = {}
        if damage:
            wrong["damaged"] = damage
        if failed:
            wrong["failed"] = _failed_calls(failed)
        yield self._evaluation(CURRENT, key, wrong)
        for check in stage.checks:
            problems = check.wrong(self.workspace, key, made)
            file = self.workspace.failed_check(stage.name, check.name, key)
            if problems:
                self.workspace.store.write({file: json.dumps(problems, default=str).encode()})
            else:
                self.workspace.store.remove([file])
            yield self._evaluation(check.name, key, {"failing": _plain(problems)} if problems else {})

    def _still_failing(self, lineage: Lineage, seen: Collection[str | None]) -> Iterator[dg.AssetCheckEvaluation]:
        """Failed checks once more, those of partitions that this run has not made, too: Dagster shows the newest result
        of a check, and one that passes elsewhere must not hide them."""
        name = self.stage.name
        for key in self.graph.keys(name):
            if key not in seen:
                for check in self.workspace.failed_checks(name, key):
                    self.failing[check, key] = {STILL: json.loads(self.workspace.failure(name, check, key))}
                state = lineage.state(name, key)
                if state is not None and state.failed:
                    self.failing[CURRENT, key] = {STILL: _failed_calls(state.failed)}
        for (check, key), wrong in [*self.failing.items()]:
            yield self._evaluation(check, key, wrong)

    def _evaluation(self, check: str, key: str | None, wrong: Mapping[str, Any]) -> dg.AssetCheckEvaluation:
        if wrong:
            self.failing[check, key] = wrong
        return _evaluation(self.stage, check, key, wrong)

    def _metadata(self, made: Made) -> dict[str, Any]:
        """What Dagster shows of a partition."""
        shown: dict[str, Any] = {**made.shown, TALLY: json.dumps(vars(made.tally))}
        if self.stage.table is None:
            files = cast(Mapping[str, bytes], made.content)
            pages = [path for path in files if "/" not in path]
            paths = {path: dg.MetadataValue.path(str(self.workspace.reports / path)) for path in pages}
            return {"files": len(files)} | paths | shown
        count = "dagster/row_count" if self.stage.scheme is None else "dagster/partition_row_count"
        rows = preview(self.stage.table, made)
        return {count: len(made.content)} | ({"first rows": rows} if rows else {}) | shown

    # --- the end ------------------------------------------------------------------------------------------------------

    def _below(self) -> set[str]:
        """The stages of this run that are made directly from this one."""
        selected = self.context.run.asset_selection or self.context.job_def.asset_layer.executable_asset_keys
        return self.graph.below(self.stage.name) & {key.path[-1] for key in selected}

    def _raise_for_all(self) -> None:
        """Raises TrapsError, or BudgetReached, for all that this run has not made or whose checks do not pass, here and
        above: had the step above raised, Dagster would have made nothing below it, not even what is sound."""
        above = self.graph.above([self.stage.name])
        failed = dict[tuple[str, Node], dg.AssetCheckEvaluation]()
        of_type = dg.DagsterEventType.ASSET_CHECK_EVALUATION
        for entry in self.context.instance.all_logs(self.context.run_id, of_type=of_type):
            event = entry.get_dagster_event().asset_check_evaluation_data
            node = (event.asset_key.path[-1], event.partition)
            if node[0] in above and STILL not in event.metadata:
                failed[event.check_name, node] = event
        alike: dict[tuple[str, str], list[str]] = {}  # by stage and what is said: a reason is told once
        for (check, node), event in failed.items():
            for line in _lines(check, node, event):
                alike.setdefault((node[0], line.replace(name_of(node), "")), []).append(line)
        if alike:
            shown = [f"{first} (and {len(more)} more)" if more else first for first, *more in alike.values()]
            more = [f"... and {len(shown) - SHOWN} more"] if len(shown) > SHOWN else []
            reached = any(e.metadata[REACHED].value for e in failed.values() if REACHED in e.metadata)
            raise (BudgetReached if reached else TrapsError)("\n".join([*shown[:SHOWN], *more]))


def end_if_resumed(instance: dg.DagsterInstance, run_id: str, attempts: int) -> None:
    """End this process where its run was resumed elsewhere since it had been resumed so many times: its host was
    stopped and taken for dead. What it could not make another process makes, and it must not tell Dagster that the run
    failed, which both of them are."""
    if instance.count_resume_run_attempts(run_id) > attempts:
        os._exit(RESUMED_ELSEWHERE)


def to_make(
    lineage: Lineage, recorded: Mapping[str | None, str | None], name: str, key: str | None, *, existing: bool = False
) -> bool:
    """Whether a partition is missing, stale, or unknown to Dagster: a crash between a table and its event leaves such a
    table, which is made once more. existing: only what is there and made from what has changed since."""
    status = lineage.status(name, key)
    if existing or status.kind == "missing":
        return bool(status.outdated) if existing else True
    return status.kind == "stale" or recorded.get(key) != lineage.version(name, key)


def _evaluation(stage: Stage, check: str, key: str | None, wrong: Mapping[str, Any]) -> dg.AssetCheckEvaluation:
    return dg.AssetCheckEvaluation(
        asset_key=asset_key(stage.name),
        check_name=check,
        passed=not wrong,
        partition=key,
        metadata=visible_metadata(wrong),
    )


def _failed_calls(count: int) -> str:
    return f"{count} calls failed and can be asked again"


def _plain(problems: Any) -> Any:
    return json.loads(json.dumps(problems, default=str))


def _lines(check: str, node: Node, event: dg.AssetCheckEvaluation) -> Iterable[str]:
    """What a failed check says, a line each."""
    if event.passed:
        return
    values = {name: value.value for name, value in event.metadata.items() if name != REACHED}
    for name, value in values.items():
        if check != CURRENT:
            text = value if isinstance(value, str) else json.dumps(value)
            yield f"check {check} of {name_of(node)} does not pass: {text}"
        elif name == "not made":
            yield f"{name_of(node)} is not made: {value}"
        else:
            yield f"{name_of(node)}: {value}"
