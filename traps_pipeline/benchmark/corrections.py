"""Apply corrections to released records; together they are a benchmark version.

`scene_specs/corrections/*.jsonl` is append-only, one decision a line, read in the order of file names and lines:

    {"scenario_id": "plinko-0003", "action": "correct", "question": "...",
     "who": "jd", "when": "2026-11-21", "why": "..."}     (on one line)

keep: reviewed, nothing changes. correct: any of question, labels, aliases, answer, ill_posed_question,
answerable_question, params. discard: the pair leaves the benchmark (its answers stay in the ledger). add: a new
scenario of a known family with `family` and `params`; words that are not given are drawn from the family. restore: a
released scenario is again as it was released; all earlier decisions about it are taken back.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.paths import CORRECTIONS, OWN_SPECS, SCENE_SPECS, SPECS_VARIABLE
from traps_pipeline.base.suggestions import did_you_mean
from traps_pipeline.base.yamlfile import faults_of, read_lines
from traps_pipeline.benchmark.records import ReleasedLine, load_release, released_lines, two_events_lines
from traps_pipeline.protocol.datasets import ALL_CATEGORIES, RECORDED
from traps_pipeline.scenes.family_registry import family_names, get_family
from traps_pipeline.scenes.worlds.spec import Answerable, SceneSpec, Slug
from traps_pipeline.storage.study import Study

if TYPE_CHECKING:
    from traps_pipeline.scenes.worlds.lane_records import TwoEventsSpec

WORDS = ("question", "labels", "aliases", "ill_posed_question", "answerable_question")
LANE_WORDS = WORDS[:3]  # of scenarios of two events


class Correction(BaseModel):
    """A reviewer's decision about one scenario, as a line of a corrections file."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    scenario_id: str = Field(pattern=Slug, max_length=80, description="family and number")
    action: Literal["keep", "correct", "discard", "add", "restore"] = Field(description="what happens to the scenario")
    family: str | None = Field(default=None, description="of an added scenario")
    params: dict[str, Any] | None = Field(default=None, description="of the scene; those left out stay")
    question: str | None = Field(default=None, description="of both clips, with its choices")
    labels: list[str] | None = Field(default=None, description="closed set of answers")
    aliases: dict[str, str] | None = Field(default=None, description="other words for a label")
    answer: str | None = Field(default=None, description="right answer to the control")
    ill_posed_question: str | None = Field(default=None, description="question that no clip answers")
    answerable_question: Answerable | None = Field(default=None, description="question that both clips answer")
    who: str = Field(min_length=1, description="who decided")
    when: date = Field(description="day of the decision")
    why: str = Field(min_length=1, description="reason")

    def changes(self) -> dict[str, Any]:
        """Return the fields that the decision rewrites: words, answer, params."""
        fields = (*WORDS, "answer", "params")
        return {f: v for f, v in self.model_dump(mode="json", include=set(fields)).items() if v is not None}


@dataclass(frozen=True)
class Scenario:
    """A scenario of a pair with its corrections; `record` is the released one, None if added.

    `params` is not None if the scene itself must be resolved again; the scene_specs stage does that.
    """

    scenario_id: str
    family: str
    category: str
    record: SceneSpec | ReleasedLine[SceneSpec] | None
    words: Mapping[str, Any] = field(default_factory=dict)
    params: Mapping[str, Any] | None = None
    where: str = ""

    @property
    def released(self) -> SceneSpec | None:
        """The released record, None if added. Raises TrapsError for an invalid line."""
        return self.record.spec if isinstance(self.record, ReleasedLine) else self.record

    @property
    def version(self) -> str:
        """Digest of the released record and every effective change."""
        base = self.released.spec_hash if self.released else self.family
        return digest([base, dict(self.words), dict(self.params) if self.params is not None else None])[:16]

    def changed_words(self) -> SceneSpec:
        """Return the record with corrected words. Raises TrapsError for a bad correction."""
        if self.released is None:
            raise ValueError(f"{self.scenario_id} was added; it has no released record")
        return apply_words(self.released, self.words, self.where)


class _HasFamily(Protocol):
    @property
    def family(self) -> str: ...


_OfFamily = TypeVar("_OfFamily", bound=_HasFamily)


@dataclass(frozen=True)
class LaneScenario:
    """A scenario of two events, each in a lane of one picture, with its corrections."""

    record: ReleasedLine[TwoEventsSpec]
    words: Mapping[str, Any] = field(default_factory=dict)
    where: str = ""

    @property
    def family(self) -> str:
        """The family of both events."""
        return self.record.family

    @property
    def category(self) -> str:
        """The category of both events."""
        return self.record.category

    @property
    def version(self) -> str:
        """Digest of the released record and every effective change."""
        return digest([self.record.line, dict(self.words)])[:16]

    @cached_property
    def spec(self) -> TwoEventsSpec:
        """The corrected record. Raises TrapsError if the words do not fit."""
        return apply_words(self.record.spec, self.words, self.where)


_Spec = TypeVar("_Spec", SceneSpec, "TwoEventsSpec")


def apply_words(spec: _Spec, words: Mapping[str, Any], where: str) -> _Spec:
    """Return a record with corrected words. Raises TrapsError if labels do not fit."""
    if not words:
        return spec
    record = spec.model_dump(mode="json") | {name: value for name, value in words.items() if name != "answer"}
    if "answer" in words:
        record["ground_truth"] = words["answer"]
        record["evidence"] = record["evidence"] | {"answer_from": "correction"}
    try:
        return type(spec).model_validate(record)
    except ValidationError as error:
        raise TrapsError(f"{where}: {spec.scenario_id}: {faults_of(error)}; correct that line") from error


def read_corrections(folder: Path = CORRECTIONS) -> list[tuple[str, Correction]]:
    """Return all decisions, each with its place `file:line`. Raises TrapsError naming the line."""
    corrections = []
    for path in sorted(folder.glob("*.jsonl")):
        for number, line in read_lines(path):
            location = f"{path}:{number}"
            try:
                corrections.append((location, Correction.model_validate(json.loads(line))))
            except ValidationError as error:
                raise TrapsError(
                    f"{location}: not a valid correction ({faults_of(error, Correction)}); correct that line"
                ) from error
            except ValueError as error:
                raise TrapsError(f"{location}: not JSON ({error}); correct that line") from error
    return corrections


def apply_corrections(
    released: Mapping[str, SceneSpec | ReleasedLine[SceneSpec]], corrections: Sequence[tuple[str, Correction]]
) -> dict[str, Scenario]:
    """Return scenarios by id after all decisions. Raises TrapsError with `file:line`."""
    scenarios = {
        id_: Scenario(id_, spec.family, spec.category, spec, where="released") for id_, spec in released.items()
    }
    for location, correction in corrections:
        scenario = scenarios.get(correction.scenario_id)
        if correction.action == "add":
            if scenario is not None or correction.scenario_id in released:
                raise TrapsError(
                    f"{location}: cannot add {correction.scenario_id!r}: the id is taken; choose a free number"
                )
            scenarios[correction.scenario_id] = _add(location, correction)
            continue
        _check_decision(location, correction, scenarios, released)
        if correction.action == "restore":
            scenarios[correction.scenario_id] = _restore(location, correction.scenario_id, released)
        elif correction.action == "discard":
            del scenarios[correction.scenario_id]
        elif correction.action == "correct":
            scenarios[correction.scenario_id] = _correct(location, scenarios[correction.scenario_id], correction)
    return dict(sorted(scenarios.items()))


def _check_decision(
    where: str, correction: Correction, scenarios: Mapping[str, Any], released: Mapping[str, Any]
) -> None:
    """Raise TrapsError for changes where none are made, and for a scenario that is not there."""
    if correction.action != "correct" and correction.changes():
        raise TrapsError(
            f"{where}: `{correction.action}` changes nothing, yet gives {sorted(correction.changes())}; use `correct`"
        )
    if correction.action != "restore" and correction.scenario_id not in scenarios:
        state = "was discarded" if correction.scenario_id in released else "is unknown"
        raise TrapsError(f"{where}: scenario {correction.scenario_id!r} {state}; name a scenario of the benchmark")


def apply_to_lanes(
    released: Mapping[str, ReleasedLine[TwoEventsSpec]], corrections: Sequence[tuple[str, Correction]]
) -> dict[str, LaneScenario]:
    """Return scenarios of two events by id after all decisions about them. Raises TrapsError with `file:line`."""
    scenarios = {id_: LaneScenario(line) for id_, line in released.items()}
    for location, correction in corrections:
        id_, changes = correction.scenario_id, correction.changes()
        if id_ not in released:
            continue
        if correction.action == "add" or changes.keys() - {*LANE_WORDS}:
            raise TrapsError(
                f"{location}: {id_} is a scenario of two events, of which {', '.join(LANE_WORDS)} may be corrected; "
                "discard it where anything else is wrong"
            )
        _check_decision(location, correction, scenarios, released)
        if correction.action == "discard":
            del scenarios[id_]
        elif correction.action == "restore":
            scenarios[id_] = LaneScenario(released[id_])
        elif correction.action == "correct":
            if not changes:
                raise TrapsError(f"{location}: `correct` gives no change; give words, or use `keep`")
            scenarios[id_] = LaneScenario(released[id_], dict(scenarios[id_].words) | changes, location)
            _ = scenarios[id_].spec  # an unknown label is an error of this line, found before anything runs
    return scenarios


def _restore(where: str, scenario_id: str, released: Mapping[str, SceneSpec | ReleasedLine[SceneSpec]]) -> Scenario:
    spec = released.get(scenario_id)
    if spec is None:
        raise TrapsError(f"{where}: scenario {scenario_id!r} was never released; `discard` takes back an added one")
    return Scenario(scenario_id, spec.family, spec.category, spec, where="released")


def _correct(where: str, prior: Scenario, correction: Correction) -> Scenario:
    changes = correction.changes()
    if correction.family not in (None, prior.family):
        raise TrapsError(f"{where}: {prior.scenario_id} is of the family {prior.family}; a correction cannot change it")
    if not changes:
        raise TrapsError(f"{where}: `correct` gives no change; give words, answer or params, or use `keep`")
    params = prior.params
    if "params" in changes and prior.family == RECORDED:
        raise TrapsError(
            f"{where}: {prior.scenario_id}: recorded pairs have no parameters; change its line and import it again"
        )
    if "params" in changes:
        base = params if params is not None else (prior.released.params if prior.released else {})
        unknown = sorted(set(changes["params"]) - set(base))
        if unknown:
            raise TrapsError(f"{where}: family {prior.family} has no parameters {unknown}; it has {sorted(base)}")
        params = dict(base) | changes.pop("params")
    words = dict(prior.words) | changes
    scenario = Scenario(prior.scenario_id, prior.family, prior.category, prior.record, words, params, where)
    if scenario.released is not None and params is None:
        scenario.changed_words()  # an unknown label is an error of this line, found before anything runs
    return scenario


def _add(where: str, correction: Correction) -> Scenario:
    changes = correction.changes()
    if correction.family not in family_names() or "params" not in changes:
        raise TrapsError(
            f"{where}: `add` needs params and a known family, not {correction.family!r}; "
            f"known: {', '.join(family_names())}"
        )
    family = get_family(str(correction.family))
    try:
        family.params_from(changes["params"])
    except (ValueError, TypeError) as error:
        raise TrapsError(f"{where}: {error}") from error
    params = changes.pop("params")
    return Scenario(correction.scenario_id, family.name, family.category, None, changes, params, where)


def load_scenarios(study: Study) -> dict[str, Scenario]:
    """Return by id the scenarios of a study, after corrections. Raises TrapsError for unknown ones."""
    check_benchmark(study)
    return of_study(corrected_scenarios(), study)


def current_benchmark() -> str:
    """Return the name of the benchmark whose records this process reads."""
    return "released" if SCENE_SPECS == OWN_SPECS else load_release().name


def check_benchmark(study: Study) -> None:
    """Raise TrapsError unless the records that are read are of the study's benchmark."""
    current = current_benchmark()
    if study.benchmark != current:
        raise TrapsError(
            f"the benchmark of the study is {study.benchmark!r}, the records in {SCENE_SPECS} are {current!r}; "
            f"{_records_advice(study.benchmark)}, or write `benchmark: {current}` into a new workspace's experiment"
        )


def _records_advice(benchmark: str) -> str:
    """Return where to look for the records of a benchmark, as an instruction."""
    is_released = benchmark == "released"
    return f"unset {SPECS_VARIABLE}" if is_released else f"set {SPECS_VARIABLE} to the folder of {benchmark!r}"


@cache
def corrected_scenarios() -> dict[str, Scenario]:
    """Return the released scenarios of pairs by id, after all corrections."""
    return apply_corrections(released_lines(), of_pairs(read_corrections()))


def of_pairs(corrections: Iterable[tuple[str, Correction]]) -> list[tuple[str, Correction]]:
    """Return the decisions about scenarios of pairs: all but those of two events."""
    lanes = two_events_lines()
    return [(where, correction) for where, correction in corrections if correction.scenario_id not in lanes]


@cache
def corrected_two_events() -> dict[str, LaneScenario]:
    """Return the released scenarios of two events by id, after all corrections."""
    return apply_to_lanes(two_events_lines(), read_corrections())


def load_two_events(study: Study) -> dict[str, LaneScenario]:
    """Return by id the scenarios of two events of a study, after corrections."""
    check_benchmark(study)
    return of_study(corrected_two_events(), study, two_events_lines())


def of_study(
    scenarios: Mapping[str, _OfFamily], study: Study, released: Mapping[str, ReleasedLine[Any]] | None = None
) -> dict[str, _OfFamily]:
    """Return the study's named scenarios, or the first n per family, or all. released: by default those of pairs.

    Discarded scenarios are left out without replacement.
    """
    if study.scenarios is not None:
        unknown = sorted(set(study.scenarios) - set(scenarios) - _all_ids())
        if unknown:
            hint = did_you_mean(unknown[0], scenarios) or "; `ls scene_specs/released` shows the families"
            raise TrapsError(f"the study's `scenarios` name unknown ones, {unknown}{hint}")
        return {id_: scenarios[id_] for id_ in sorted(study.scenarios) if id_ in scenarios}
    if study.per_family is None:
        return dict(scenarios)
    families = {id_: line.family for id_, line in (released_lines() if released is None else released).items()}
    families |= {id_: scenario.family for id_, scenario in scenarios.items()}
    ids_by_family: dict[str, list[str]] = {}
    for id_, family in sorted(families.items()):
        ids_by_family.setdefault(family, []).append(id_)
    scenario_ids = {id_ for ids in ids_by_family.values() for id_ in ids[: study.per_family]}
    return {id_: scenario for id_, scenario in scenarios.items() if id_ in scenario_ids}


def _all_ids() -> set[str]:
    """Return ids that are or were in the benchmark: released, added, discarded."""
    return {*released_lines(), *two_events_lines()} | {correction.scenario_id for _, correction in read_corrections()}


def categories_of(scenarios: Mapping[str, Scenario | LaneScenario]) -> list[str]:
    """Return the categories that have scenarios, in their fixed order."""
    categories = {scenario.category for scenario in scenarios.values()}
    return [category for category in ALL_CATEGORIES if category in categories]
