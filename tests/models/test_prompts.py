"""Prompts are what the files say, byte for byte."""

from __future__ import annotations

import re

from tests.build.errors import raises
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.registry.prompts import PROMPTS, load_prompt, prompt_version, system_prompt
from traps_pipeline.protocol.regimes import FIELDS, REGIMES


def raw(name: str) -> str:
    return (PROMPTS / f"{name}.txt").read_bytes().decode("utf-8").strip()


def test_each_regime_is_its_parts_joined_by_one_blank_line() -> None:
    assert system_prompt("standard") == raw("standard")
    assert system_prompt("guided") == raw("standard") + "\n\n" + raw("guided_suffix")
    assert system_prompt("json") == raw("standard") + "\n\n" + raw("json_suffix")


def test_a_schema_that_is_varied_is_the_regimes_prompt_with_another_last_part() -> None:
    assert system_prompt("standard", "schema_reason") == system_prompt("json")  # what the regime json asks for
    assert system_prompt("standard", "schema_answer") == raw("standard") + "\n\n" + raw("json_answer_suffix")
    assert system_prompt("guided", "schema_abstain") == system_prompt("guided") + "\n\n" + raw("json_abstain_suffix")
    assert system_prompt("guided", "labels_two") == system_prompt("guided")
    for dataset, fields in FIELDS.items():  # each prompt shows the fields that structured output then demands
        shown = re.sub(r"\[.*?\]", "", system_prompt(dataset if dataset in REGIMES else "standard", dataset))
        assert tuple(re.findall(r'"(\w+)":', shown)) == fields
    varied = prompt_version("standard", ["occlusion", "schema_abstain"])
    assert prompt_version("standard", ["occlusion"]) == prompt_version("standard") != varied


def test_the_files_say_what_the_paper_says() -> None:
    assert system_prompt("standard").startswith("You are a physical reasoning module deployed in a robotic system.")
    assert system_prompt("standard").endswith("- State your analysis briefly, then provide your final answer.")
    assert system_prompt("guided").endswith("""don't provide a guess and respond "I don't know".""")
    assert '{"reason": "<your step-by-step analysis>", "final_answer": "<your answer>"}' in system_prompt("json")
    assert "\r" not in system_prompt("json")


def test_a_missing_prompt_is_named_with_the_remedy() -> None:
    with raises(TrapsError, "models.registry.prompts.load_prompt", "prompts/no_such.txt"):
        load_prompt("no_such")
