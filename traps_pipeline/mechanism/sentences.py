"""Score whole sentences: a model's likelihood of abstentions and its own answer.

The output margin covers only the first answer token, and shows nothing for a model that begins every answer with "The".
Here every sentence of a set, and the model's own answer, follows the benchmark's prompt (teacher forcing), and the
log-probabilities of its tokens are averaged, so that long and short sentences are comparable. The prompt is read once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from traps_pipeline.base import progress
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.control_rows import SentenceRow
from traps_pipeline.mechanism.margin import head_logits
from traps_pipeline.mechanism.mechanism_rows import PROBE_ITEMS
from traps_pipeline.mechanism.probing_versions import joined_models
from traps_pipeline.mechanism.stages import probed_item
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.models.local.sidepaths import cache_argument
from traps_pipeline.models.registry.entries import ModelEntry, get_model
from traps_pipeline.models.registry.prompts import system_prompt
from traps_pipeline.protocol.cells import Cell, Evaluation, Extraction
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    from traps_pipeline.models.local.adapter import LocalModel, Prompt

OWN_TOKENS = 64  # tokens of the model's own answer, from its beginning


def sentence_rows(workspace: Workspace, entry: ModelEntry, extraction: Extraction) -> list[SentenceRow]:
    """Return SENTENCES rows: for every item of the pairs, the log-probabilities of an abstention and of the answer.

    The prompt is the benchmark's of the extraction's name. Raises TrapsError for a model that was not evaluated under
    it.
    """
    from traps_pipeline.models.local.adapter import load_local_model

    assert entry.media is not None, "local entries have media"
    model, regime, rows = load_local_model(entry, inside=True), extraction.prompt, list[SentenceRow]()
    joined = {**extraction.partition, "joins": joined_models(get_model(entry.id), workspace.mechanism)}
    sentences = {text: answer_tokens(model, text) for text in workspace.mechanism.sentences}
    for dataset in DATASETS:
        cell = Cell(dataset, Evaluation(entry.id, regime, 1))
        if workspace.tables.state(RESPONSES, cell.partition) is None:
            continue
        texts = workspace.tables.read(RESPONSES, cell.partition).set_index("item_id")["text"].to_dict()
        items = workspace.tables.read(PROBE_ITEMS, {"dataset": dataset}).to_dict("records")
        for number, item in enumerate(items, start=1):
            progress.current().tick("sentences", f"items of {cell.key}", number, len(items))
            item_columns = {str(name): value for name, value in item.items()}
            prompt = probed_item(workspace, model, entry.media, item_columns, system_prompt(regime)).prompt()
            text = texts.get(item_columns["item_id"])
            answer_ids = answer_tokens(model, text)[:OWN_TOKENS] if isinstance(text, str) and text else []
            with model.caching_clips():
                values = mean_log_probabilities(
                    model, prompt, [*sentences.values(), *([answer_ids] if answer_ids else [])]
                )
            log_probability_of = dict(zip(sentences, values, strict=False))
            best = max(log_probability_of, key=lambda name: log_probability_of[name])
            rows.append(
                SentenceRow(
                    **joined,
                    **{name: item_columns[name] for name in ("item_id", "dataset", "scenario_id", "side")},
                    sentence=best,
                    abstention=log_probability_of[best],
                    own=values[-1] if answer_ids else None,
                    own_tokens=len(answer_ids),
                )
            )
    if not rows:
        raise TrapsError(
            f"sentences {extraction.key}: {entry.id} was not asked under {regime} in run 1; ask it, or set "
            "`mechanism.sentences: []` in the experiment and in study.yaml"
        )
    return rows


def answer_tokens(model: LocalModel, text: str) -> list[int]:
    """Return the token ids of a text as a model's answer contains them: without special tokens around it."""
    return model.processor.tokenizer(text, add_special_tokens=False).input_ids


def mean_log_probabilities(model: LocalModel, prompt: Prompt, answers: Sequence[Sequence[int]]) -> list[float]:
    """Return the mean log-probability (nats) of each answer's tokens after a prompt.

    The prompt is read once; then all answers in one pass, which reads its keys and values. Shorter answers are filled
    up on the right, where no token of theirs looks.
    """
    import torch

    width = max(len(tokens) for tokens in answers)
    rows = torch.tensor([[*tokens, *[0] * (width - len(tokens))] for tokens in answers], device=model.inputs_device)
    with torch.inference_mode():
        output = model.network.base_model(**model.placed(prompt.inputs), use_cache=True)
        output.past_key_values.batch_repeat_interleave(len(answers))
        read = {cache_argument(model.network.base_model): output.past_key_values}
        behind = model.network.base_model(input_ids=rows, **read)
        ends = output.last_hidden_state[:, -1:].expand(len(answers), -1, -1)
        states = torch.cat([ends, behind.last_hidden_state[:, :-1].to(ends.device)], dim=1)
        chances = head_logits(model, states).log_softmax(-1).gather(-1, rows[..., None].to(ends.device))[..., 0]
        return [float(row[: len(tokens)].mean()) for row, tokens in zip(chances, answers, strict=True)]
