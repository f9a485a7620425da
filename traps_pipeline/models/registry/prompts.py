"""Read regimes' and judges' system prompts, verbatim (docs/spec.md 3.3)."""

from collections.abc import Iterable
from functools import cache

from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.paths import ASSETS
from traps_pipeline.protocol.regimes import BY_NAME

PROMPTS = ASSETS / "prompts"
_SCHEMA_PARTS = {
    "schema_answer": "json_answer_suffix",
    "schema_reason": "json_suffix",
    "schema_abstain": "json_abstain_suffix",
}


@cache
def load_prompt(name: str) -> str:
    """Return the text of `assets/prompts/<name>.txt`, stripped."""
    path = PROMPTS / f"{name}.txt"
    try:
        text = path.read_text(encoding="utf-8").strip()
    except OSError as error:
        raise TrapsError(f"{path}: cannot be read ({error.strerror}); restore it from git") from error
    if not text:
        raise TrapsError(f"{path}: is empty; restore it from git")
    return text


@cache
def system_prompt(regime: str, dataset: str = "") -> str:
    """Return a regime's system prompt, which a dataset may vary."""
    variation = (_SCHEMA_PARTS[dataset],) if dataset in _SCHEMA_PARTS else ()
    return "\n\n".join(load_prompt(part) for part in (*BY_NAME[regime].texts, *variation))


@cache
def vqa_prompt(name: str) -> str:
    """Return the text of a prompt of VQA_PROMPTS, used for hidden states (docs/spec.md 7.1)."""
    return "\n\n".join(load_prompt(part) for part in BY_NAME[name].states)


def prompt_version(regime: str, datasets: Iterable[str] = ()) -> str:
    """Return the version of a regime's prompt and of its variations in datasets."""
    variations = [system_prompt(regime, dataset) for dataset in sorted({*datasets} & {*_SCHEMA_PARTS})]
    return digest([system_prompt(regime), *variations] if variations else system_prompt(regime))[:16]


def states_prompt(system: str, name: str) -> str:
    """Return the system prompt for hidden states: the benchmark's, or a VQA prompt."""
    return system_prompt(name) if system == "benchmark" else vqa_prompt(name)
