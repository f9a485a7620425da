"""Read a call's token usage, believed only if it is complete and possible.

It is read from the raw answer, since litellm replaces missing counts by zeros. An unbelievable usage is unknown, and a
call with unknown tokens counts as its worst case (docs/models.md, "Money").
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

BYTES_A_TOKEN = 8  # bytes of text per token: the maximum of any provider's tokenizer, averaged over a text
TOKENS_A_FRAME = 8  # minimum
MAX_TOKENS = 10**9  # anything above is no count

# By dialect: prompt tokens, answer tokens, their sum, and parts of the answer (True) or of the prompt (False) that are
# counted separately. Anthropic gives no sum.
_FORMS: tuple[tuple[tuple[str, str, str], Mapping[str, bool]], ...] = (
    (("prompt_tokens", "completion_tokens", "total_tokens"), {}),
    (
        ("input_tokens", "output_tokens", "total_tokens"),
        {"cache_creation_input_tokens": False, "cache_read_input_tokens": False},
    ),
    (
        ("promptTokenCount", "candidatesTokenCount", "totalTokenCount"),
        {"thoughtsTokenCount": True, "toolUsePromptTokenCount": False},
    ),
)
_OF_PROMPT = {*(names[0] for names, _ in _FORMS), *(name for _, apart in _FORMS for name in apart if not apart[name])}
_OF_ANSWER = {*(names[1] for names, _ in _FORMS), *(name for _, apart in _FORMS for name in apart if apart[name])}
_REASONING = (
    ("completion_tokens_details", "reasoning_tokens"),
    ("output_tokens_details", "reasoning_tokens"),
    ("thoughtsTokenCount",),
)


@dataclass(frozen=True)
class Usage:
    """The tokens of a call; completion includes the reasoning, which may be unknown.

    believed: whether the counts are complete and possible; if not, they are the highest of any field.
    """

    prompt: int
    completion: int
    reasoning: int | None = None
    believed: bool = True


@dataclass(frozen=True)
class Sizes:
    """The size of a call as measured here: bytes of prompt text, frames, bytes of returned text."""

    prompt_bytes: int
    frames: int
    text_bytes: int

    def contradict(self, usage: Usage) -> bool:
        """Return whether a usage is below the minimum for these sizes, so not to be believed."""
        min_tokens = self.prompt_bytes // BYTES_A_TOKEN + self.frames * TOKENS_A_FRAME
        return usage.prompt < min_tokens or usage.completion < -(-self.text_bytes // BYTES_A_TOKEN)


def read_usage(fields: Mapping[str, Any], sizes: Sizes) -> Usage | None:
    """Return the usage in an answer's counts, not believed below our own count; None if they contain none."""
    for (prompt, completion, total), extra_fields in _FORMS:
        if prompt in fields:
            usage = _complete_usage(fields, prompt, completion, total, extra_fields)
            return usage if usage and not sizes.contradict(usage) else _highest_counts(fields)
    return _highest_counts(fields)


def _highest_counts(fields: Mapping[str, Any]) -> Usage | None:
    """Return the highest counts of a usage that is not believable as a whole."""
    counts = {name: value for name, value in fields.items() if _is_count(value)}
    prompt = sum(counts.get(name, 0) for name in _OF_PROMPT)
    completion = sum(counts.get(name, 0) for name in _OF_ANSWER)
    total = max(counts.get(names[2], 0) for names, _ in _FORMS)
    return Usage(prompt, max(completion, total - prompt), believed=False) if counts else None


def _complete_usage(
    fields: Mapping[str, Any], prompt: str, completion: str, total: str | None, apart: Mapping[str, bool]
) -> Usage | None:
    counts = {name: fields[name] for name in (prompt, completion, total, *apart) if name and name in fields}
    if prompt == "promptTokenCount":
        counts.setdefault(completion, 0)  # Gemini omits it if everything was thinking; its sum is always present
        if total not in counts:
            return None
    if prompt == "input_tokens":
        counts = {name: value for name, value in counts.items() if not (name in apart and value is None)}
    elif counts.get(str(total), 0) is None:
        del counts[str(total)]
    if completion not in counts and counts.get(str(total)) == counts[prompt]:
        counts[completion] = 0  # refused before anything was generated
    if completion not in counts or not all(map(_is_count, counts.values())):
        return None
    read_tokens = counts[prompt] + sum(counts.get(name, 0) for name, is_of_answer in apart.items() if not is_of_answer)
    completion_tokens = counts[completion] + sum(
        counts.get(name, 0) for name, is_of_answer in apart.items() if is_of_answer
    )
    if total in counts:
        if counts[total] < counts[prompt] + counts[completion]:
            return None
        completion_tokens = max(completion_tokens, counts[total] - read_tokens)  # some count reasoning only in the sum
    return Usage(read_tokens, completion_tokens, _reasoning(fields, completion_tokens))


def _reasoning(fields: Mapping[str, Any], most: int) -> int | None:
    for path in _REASONING:
        value: Any = fields
        for name in path:
            value = value.get(name) if isinstance(value, Mapping) else None
        if _is_count(value) and value <= most:
            return value
    return None


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value <= MAX_TOKENS
