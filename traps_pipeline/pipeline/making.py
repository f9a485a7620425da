"""Build a stage's partitions in one run, alone or concurrently with other runs."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.progress import Tally
from traps_pipeline.base.workers import keep_workers
from traps_pipeline.pipeline.graph import ConcurrentBuild, Stage
from traps_pipeline.pipeline.history import History
from traps_pipeline.pipeline.lineage import Lineage
from traps_pipeline.storage.leases import hold_lease
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.workspace import Workspace

Inputs = Mapping[str | None, Mapping[str, str]]  # versions of each partition's inputs


class PartitionMaker:
    """Builds partitions of a stage, and yields each as soon as it is done.

    unmade: partitions that failed, with the reason; the others are built all the same. taken: partitions that another
    run finished meanwhile, with their version and the work done for them here.
    """

    def __init__(self, workspace: Workspace, stage: Stage, history: History) -> None:
        self._workspace, self._stage, self._history = workspace, stage, history
        self.unmade: dict[str | None, TrapsError] = {}
        self.taken: dict[str | None, tuple[str, Tally]] = {}
        self._made_at: dict[str | None, int] = {}

    def make(self, inputs: Inputs) -> Iterator[tuple[str | None, StageOutput]]:
        """Yield each key of `inputs` with its new partition; `inputs` must be read before any data."""
        if self._stage.side_by_side:
            yield from self._side_by_side([*inputs])
        elif self._stage.shared is None:
            for key in inputs:
                yield from self._make_partition(key, Tally())
        else:
            yield from self._make_concurrently(self._stage.shared, inputs)

    def _side_by_side(self, keys: Sequence[str | None]) -> Iterator[tuple[str | None, StageOutput]]:
        pending = [*keys]
        try:
            for key, output in self._stage.make(self._workspace, [str(key) for key in keys]) if keys else ():
                pending.remove(key)
                if isinstance(output, TrapsError):
                    self.unmade[key] = output
                else:
                    yield key, output
        except TrapsError as error:
            self.unmade |= dict.fromkeys(pending, error)

    def _make_partition(self, key: str | None, tally: Tally) -> Iterator[tuple[str | None, StageOutput]]:
        """Build one partition. tally: the work that was done for it before."""
        try:
            output = self._stage.make(self._workspace, key)
        except TrapsError as error:
            self.unmade[key] = error
            return
        output.tally.add(tally)
        yield key, output

    # --- beside other runs --------------------------------------------------------------------------------------------

    def _make_concurrently(self, shared: ConcurrentBuild, inputs: Inputs) -> Iterator[tuple[str | None, StageOutput]]:
        """Make files beside other runs, then build the partition as its lease holder."""
        store, postponed, lineage = self._workspace.store, dict[str | None, Tally](), Lineage(self._workspace)
        self._made_at = {key: lineage.made_at(self._stage.name, key) for key in inputs}
        with keep_workers():
            for key in inputs:
                tally = Tally()
                is_whole = self._make_files(shared, key, tally, wait=False)
                lease = store.lease(f"{self._stage.name}/{key}") if is_whole else None
                if lease is None:
                    postponed[key] = tally
                    continue
                with closing(lease):
                    if not self._adopt(key, inputs[key], tally):
                        yield from self._make_partition(key, tally)
            for key, tally in postponed.items():
                if key not in self.unmade and self._make_files(shared, key, tally, wait=True):
                    with hold_lease(store, f"{self._stage.name}/{key}"):
                        if not self._adopt(key, inputs[key], tally):
                            yield from self._make_partition(key, tally)

    def _make_files(self, shared: ConcurrentBuild, key: str | None, tally: Tally, *, wait: bool) -> bool:
        """Make a partition's files, add the work to the tally, return whether all exist."""
        try:
            count, is_whole = shared.files(self._workspace, key, wait)
        except TrapsError as error:
            self.unmade[key] = error
            return False
        tally.add(count)
        return is_whole

    def _adopt(self, key: str | None, inputs: Mapping[str, str], tally: Tally) -> bool:
        """Return whether another run built and reported a partition of equal inputs."""
        stage, lineage = self._stage, Lineage(self._workspace)
        state = lineage.state(stage.name, key)
        if state is None or lineage.made_at(stage.name, key) == self._made_at[key]:
            return False
        is_told = self._history.recorded(stage.name).get(key) == state.version
        if is_told and state.inputs == inputs and state.code == stage.code and not state.failed:
            self.taken[key] = state.version, tally
        return key in self.taken
