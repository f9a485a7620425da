"""List the finish reasons that providers document, and the meaning of each.

An unlisted reason is never an answer. Gateways pass on the reasons of other providers, in any case, so one list serves
all dialects.
"""

from collections.abc import Mapping
from typing import Literal

Ending = Literal["complete", "truncated", "refused", "transient", "unknown"]
_REASONS: Mapping[Ending, tuple[str, ...]] = {
    "complete": (
        "stop",  # OpenAI, Gemini
        "completed",  # OpenAI Responses
        *("end_turn", "stop_sequence"),  # Anthropic
        *("eos", "eos_token"),  # Together, TGI
        "complete",  # Cohere
    ),
    "truncated": (
        "length",  # OpenAI
        "max_output_tokens",  # OpenAI Responses
        "max_tokens",  # Anthropic, Gemini
        *("model_context_window_exceeded", "pause_turn"),  # Anthropic
        "model_length",  # Mistral
        "time_limit",  # watsonx
        "repetition",  # vLLM stops a text that repeats itself
    ),
    "refused": (
        "content_filter",  # OpenAI
        "refusal",  # Anthropic
        *("safety", "recitation", "language", "blocklist", "prohibited_content", "spii"),  # Gemini
        *("image_safety", "image_prohibited_content", "image_recitation"),  # Gemini
        "sensitive",  # Zhipu
    ),
    "transient": (
        "error",  # Mistral, OpenRouter, vLLM
        "abort",  # vLLM, SGLang
        *("failed", "cancelled", "in_progress", "queued"),  # OpenAI Responses
        "insufficient_system_resource",  # DeepSeek
        "network_error",  # Zhipu
        "malformed_response",  # Gemini
    ),
}
_ENDINGS: Mapping[str, Ending] = {reason: ending for ending, reasons in _REASONS.items() for reason in reasons}


def ending_of(reason: str | None) -> Ending:
    """Return the kind of ending that a finish reason means; `unknown` for an undocumented one."""
    return _ENDINGS.get((reason or "").strip().lower(), "unknown")
