"""Register judges and panels (`assets/judges.yaml`), with prompts and schemas."""

import typing
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator
from typing_extensions import override

from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.paths import ASSETS
from traps_pipeline.base.plugins import Group
from traps_pipeline.base.suggestions import did_you_mean
from traps_pipeline.base.yamlfile import read_mapping
from traps_pipeline.models.reading.thinking import Marks
from traps_pipeline.models.registry.accounts import Limits
from traps_pipeline.models.registry.entries import (
    JUDGE_PROTOCOL,
    NETWORK,
    Entry,
    Protocol,
    is_reference,
    read_entries,
    user_registry,
    with_user_entries,
)
from traps_pipeline.models.registry.prompts import load_prompt
from traps_pipeline.models.registry.schemas import structured_output

JUDGES_FILE = ASSETS / "judges.yaml"
PANEL_SIZES = (1, 3)
RULE = "rule"  # the backend of the rule judges
RULES_VERSION = 7  # version of judging/rules.py; raise it to make rule judges vote again
RULES_PANEL = "rules"  # panels of this name, or `rules-..`, seat judges that ask no language model, and no others do
ONE_JUDGE = ".1"  # suffix of the id of a panel of one judge
BY_RULES = "judged by rules, not comparable"
Task = Literal["abstention", "correctness"]


# The schema that a network judge is asked for; `judging.panel` checks its answer all the same.
_ABSTENTION: Mapping[str, Any] = {
    "abstained": {"type": "boolean"},
    "confidence": {"type": "string", "enum": ["high", "medium", "low"]},
    "reasoning": {"type": "string"},
}
SCHEMAS: Mapping[Task, Mapping[str, Any]] = {
    "abstention": structured_output("abstention", **_ABSTENTION),
    "correctness": structured_output(
        "correctness",
        correct={"type": "boolean"},
        extracted_value={"anyOf": [{"type": "string"}, {"type": "number"}, {"type": "null"}]},
        reasoning={"type": "string"},
    ),
}


_WITH_PREMISE = structured_output("abstention", **_ABSTENTION, rejects_premise={"type": "boolean"})


class Judge(typing.Protocol):
    """The properties of a judge that decide its votes, whether of the registry or of a package."""

    @property
    def id(self) -> str:
        """The judge's name in tables and panels."""
        ...

    @property
    def backend(self) -> str:
        """The kind of backend that answers: over the network, by rules, or of an installed package."""
        ...

    @property
    def endpoint(self) -> str:
        """The model that answers, in the ledger key."""
        ...

    @property
    def params(self) -> Mapping[str, Any]:
        """The parameters sent besides the prompts."""
        ...

    @property
    def thinking(self) -> Marks | None:
        """The opening and closing mark around its thinking, which is split off a vote; None if it shows none."""
        ...

    @property
    def premise(self) -> bool:
        """Whether the judge also says if an answer rejects the question's premise."""
        ...


def vote_prompt(seat: Judge, task: Task) -> str:
    """Return a task's system prompt: the paper's, and ours about the premise if the judge is asked."""
    text = load_prompt(f"judge_{task}")
    return f"{text}\n\n{load_prompt('judge_premise_suffix')}" if seat.premise and task == "abstention" else text


def vote_schema(seat: Judge, task: Task) -> Mapping[str, Any]:
    """Return the JSON schema of a judge's vote on a task."""
    return _WITH_PREMISE if seat.premise and task == "abstention" else SCHEMAS[task]


class JudgeEntry(Entry):
    """One judge of `assets/judges.yaml`."""

    plugins: typing.ClassVar[Group] = "judges"
    own_backends: typing.ClassVar[tuple[str, ...]] = (RULE, NETWORK)
    backend: str = Field(description="rule (of this project), api (a server), or a package's name")
    premise: bool = Field(
        default=False, description="also ask if an answer rejects the question's premise; the paper's judges do not say"
    )
    limits: Limits = Field(default=Limits(concurrency=12), description="of its calls")

    @model_validator(mode="before")
    @classmethod
    def _votes_of_other_rules_are_other_votes(cls, data: Any) -> Any:
        is_rule = isinstance(data, dict) and data.get("backend") == RULE and "params" not in data
        return data | {"params": {"rules": RULES_VERSION}} if is_rule else data

    @override
    def protocol(self) -> Protocol:
        return JUDGE_PROTOCOL


@user_registry.clear_on_new_entries
@cache
def load_judges(path: Path = JUDGES_FILE) -> dict[str, JudgeEntry]:
    """Return judges by id. Raises TrapsError naming judge and field."""
    judges = read_entries(path, "judges", JudgeEntry)
    return with_user_entries(judges, "judges", JudgeEntry) if path == JUDGES_FILE else judges


def thinking_of(judge: str) -> Marks | None:
    """Return the opening and closing mark around a judge's thinking; None if it shows none."""
    entry = load_judges().get(judge)
    return entry.thinking if entry else None


@user_registry.clear_on_new_entries
@cache
def load_panel(name: str, path: Path = JUDGES_FILE) -> tuple[JudgeEntry, ...]:
    """Return a panel's judges (three, or one). Raises TrapsError naming the file."""
    panels, judges = load_panels(path), load_judges(path)
    if not name:
        raise TrapsError(f"no panel is named: {panel_advice(path)}")
    if name not in panels:
        place = "" if path == JUDGES_FILE else f"{path}: "  # an experiment names its own file and line
        raise TrapsError(f"{place}no panel {name!r}; there are {', '.join(panels)}{did_you_mean(name, panels)}")
    seats = panels[name]
    own_files = [file for file, own in user_registry.registries() if name in own.panels] if path == JUDGES_FILE else []
    path = own_files[-1] if own_files else path
    is_valid = isinstance(seats, list) and len(seats) == len(set(seats)) and len(seats) in PANEL_SIZES
    if not is_valid or any(seat not in judges for seat in seats):
        sizes = " or ".join(map(str, PANEL_SIZES))
        raise TrapsError(f"{path}: panel {name!r} must seat {sizes} different known judges, not {seats}")
    if {judges[seat].backend != "api" for seat in seats} != {is_of_rules(name)}:
        named = f"{RULES_PANEL!r}, or '{RULES_PANEL}-..', alone"
        raise TrapsError(f"{path}: panel {name!r}: judges that ask no language model sit in panels named {named}")
    return tuple(judges[seat] for seat in seats)


def is_of_rules(panel: str) -> bool:
    """Return whether no judge of a panel asks a language model, by the panel's name."""
    return panel.partition("-")[0] == RULES_PANEL


def load_panels(path: Path = JUDGES_FILE) -> dict[str, Any]:
    """Return each panel's judges by the panel's name, unchecked. Raises TrapsError without `panels:`."""
    panels = read_mapping(path).get("panels")
    if not isinstance(panels, dict):
        raise TrapsError(f"{path}: must hold a mapping `panels:`")
    return {**panels, **user_registry.all_additions().panels} if path == JUDGES_FILE else panels


def panel_advice(path: Path = JUDGES_FILE) -> str:
    """Return a sentence that says how to name a panel, for a command without one."""
    return (
        f"write `panel: NAME` into the experiment, or say --panel NAME; {path} has {', '.join(load_panels(path))} "
        f"({RULES_PANEL} is for reference strategies)"
    )


def require_panel(panel: str, models: Iterable[str], *, judged_by_rules: bool) -> None:
    """Raise TrapsError unless the panel is known, and allowed for these models (rules: if the user says so)."""
    load_panel(panel)
    other_models = [model for model in models if not is_reference(model)]
    if is_of_rules(panel) and other_models and not judged_by_rules:
        verb = " and others are" if len(other_models) > 5 else " are" if len(other_models) > 1 else " is"
        raise TrapsError(
            f"panel {panel} is made for reference strategies, and {', '.join(other_models[:5])}{verb} none: "
            "name a panel of language models, or say --judged-by-rules (`judged_by_rules: true` in the experiment); "
            f"every table and page then says `{BY_RULES}`"
        )


def panel_version(panel: str) -> str:
    """Return the version of a panel's judges, prompts and schemas, which decide votes."""
    return version_of_judges(load_panel(panel)) if panel else "no panel is named"


def version_of_judges(seats: Iterable[Judge]) -> str:
    """Return the version of these judges, with their prompts and schemas."""
    judges = list[list[Any]]()
    for seat in seats:
        premise_parts = [vote_prompt(seat, "abstention"), vote_schema(seat, "abstention")] if seat.premise else []
        judges.append([seat.id, seat.endpoint, dict(seat.params), SCHEMAS, *(seat.thinking or ()), *premise_parts])
    return digest([judges, load_prompt("judge_abstention"), load_prompt("judge_correctness")])[:16]


def panel_id(panel: str) -> str:
    """Return a panel's id in rows: name, judges' version, and a mark for one judge."""
    return id_of_judges(panel, load_panel(panel)) if panel else f"@{panel_version(panel)[:8]}"


def id_of_judges(name: str, seats: Sequence[Judge]) -> str:
    """Return the id of a panel of this name and these judges."""
    return f"{name}@{version_of_judges(seats)[:8]}{ONE_JUDGE if len(seats) == 1 else ''}"


def panel_names(panels: str) -> list[str]:
    """Return the names of the panels in a column of joined panel ids."""
    return [panel_id.partition("@")[0] for panel_id in panels.split("+") if panel_id]


def is_judged_by_rules(panels: str, model: str) -> bool:
    """Return whether rules judged a model, by its rows' `panel` column."""
    return any(map(is_of_rules, panel_names(panels))) and not is_reference(model)
