"""A local model goes the whole way of an API model: request, outcome, ledger; requests that wait share a batch."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from math import exp
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.build.errors import raises
from tests.local_models import QUESTIONS, SIX_FRAMES, SYSTEM, checkpoint, clip, entry, model
from tools.tiny_checkpoints import build_tiny
from traps_pipeline.base.digests import file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.cli import main
from traps_pipeline.mechanism.adapter_checks import CHECKS
from traps_pipeline.mechanism.probing_versions import loaded_params
from traps_pipeline.models.asking.backends import make_backend
from traps_pipeline.models.local.adapter import LocalModel, load_local_model
from traps_pipeline.models.local.backend import LocalBackend, local_outcome, seeds, worker
from traps_pipeline.models.registry import entries as registry
from traps_pipeline.models.registry.accounts import Limits
from traps_pipeline.models.registry.entries import ModelEntry, effective_params, load_models
from traps_pipeline.models.request import Outcome, Request
from traps_pipeline.storage.media import MediaStore, pick_frames

pytestmark = pytest.mark.slow

SAMPLED = {"do_sample": True, "temperature": 0.8, "top_p": 0.95}


def request(of: ModelEntry, media: MediaStore, question: str, run: int = 1, regime: str = "standard") -> Request:
    """What the responses stage would ask."""
    sent = media.prepare(clip(), file_digest(clip()), SIX_FRAMES)
    about = {"item_id": question, "model": of.id, "regime": regime, "run": run}
    params = effective_params(of, regime)
    return Request(of.id, of.backend, params, SYSTEM, question, about, clip(), sent, sent.sha256)


def answers(of: ModelEntry, requests: Sequence[Request]) -> list[Outcome]:
    async def all_at_once() -> list[Outcome]:
        backend = make_backend(of)
        return await asyncio.gather(*(backend.ask(one) for one in requests))

    return asyncio.run(all_at_once())


@pytest.fixture
def batches(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many prompts each call of `generate` got."""
    sizes: list[int] = []
    whole = LocalModel.generate

    def counting(self: LocalModel, prompts: Sequence[Any], *rest: Any, **more: Any) -> Any:
        sizes.append(len(prompts))
        return whole(self, prompts, *rest, **more)

    monkeypatch.setattr(LocalModel, "generate", counting)
    return sizes


def test_requests_that_wait_are_answered_together_as_they_would_be_alone(tmp_path: Path, batches: list[int]) -> None:
    of, media = entry("gemma-4", **SAMPLED), MediaStore(tmp_path)
    requests = [request(of, media, question) for question in QUESTIONS]
    together = answers(of, requests)
    assert batches == [3]
    assert together == [answers(of, [one])[0] for one in requests]
    assert {one.kind for one in together} <= {"answer", "truncated", "empty"}
    for one in together:
        assert one.served_model == model("gemma-4").served_model
        assert one.cost_usd == 0
        assert one.prompt_tokens
        assert one.completion_tokens


def test_runs_differ_and_the_same_call_does_not(tmp_path: Path) -> None:
    of, media = entry("qwen3-vl", **SAMPLED), MediaStore(tmp_path)
    first, second = (request(of, media, QUESTIONS[0], run) for run in (1, 2))
    assert seeds([first]) != seeds([second])
    one, again, two = (answers(of, [each])[0] for each in (first, first, second))
    assert one == again
    assert one.text != two.text


def test_the_probabilities_of_the_first_token_are_those_of_its_logits_whatever_is_drawn(tmp_path: Path) -> None:
    media, given = MediaStore(tmp_path), {}
    for name, sampled in (("greedy", {}), ("sampled", SAMPLED)):
        of = entry("qwen3-vl", **sampled)
        asked = [request(of, media, QUESTIONS[0], regime=regime) for regime in ("logprobs", "standard")]
        (kept, other), loaded = answers(of, asked), load_local_model(of)
        assert other.first_token is None
        given[name] = json.loads(str(kept.first_token))
    seen = pick_frames(clip(), SIX_FRAMES)
    prompt = loaded.prompt(SYSTEM, QUESTIONS[0], seen.frames, seen.times_s)
    with torch.inference_mode():
        values, tokens = loaded.network(**loaded.placed(prompt.inputs)).logits[0, -1].softmax(-1).topk(20)
    likeliest = Counter[str]()
    for token, value in zip(tokens.tolist(), values.tolist(), strict=True):
        likeliest[loaded.processor.tokenizer.decode([token])] += value
    assert given["greedy"] == given["sampled"]
    kept = {token: exp(logprob) for token, logprob in given["greedy"].items()}
    off = sum(kept.values()) / sum(likeliest.values())  # tokens that are never generated have none of it
    assert kept == pytest.approx({token: value * off for token, value in likeliest.items()}, rel=1e-4)
    assert 1 <= off < 1.02


def test_an_answer_cut_off_is_truncated_and_nothing_is_empty() -> None:
    def kind(text: str, finish: str) -> tuple[str, str | None]:
        made = local_outcome(text, finish, 10, 3, "m")
        return made.kind, made.text

    assert kind(" left ", "stop") == ("answer", "left")
    assert kind("left or", "length") == ("truncated", "left or")
    assert kind(" \n", "stop") == ("empty", None)
    assert kind("", "length") == ("empty", None)


def test_other_weights_in_the_same_folder_are_other_calls(tmp_path: Path) -> None:
    folder = Path(shutil.copytree(checkpoint("llava-next-video"), tmp_path / "model"))
    of, media = entry("llava-next-video", folder), MediaStore(tmp_path / "media")
    before = request(of, media, QUESTIONS[0])
    build_tiny("llava-next-video", folder, seed=9)
    after = request(of, media, QUESTIONS[0])
    assert before.key != after.key
    assert before.components["params"]["checkpoint_digest"] != after.components["params"]["checkpoint_digest"]


def downloaded(cache: Path, commit: str) -> None:
    """What `hf download some/model` leaves in the hub's cache."""
    of_model = cache / "models--some--model"
    shutil.copytree(checkpoint("llava-next-video"), of_model / "snapshots" / commit)
    (of_model / "refs").mkdir(exist_ok=True)
    (of_model / "refs" / "main").write_text(commit)


def test_another_commit_of_a_hub_id_without_a_revision_is_another_call(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    of, pinned = (entry("llava-next-video", "some/model", **given) for given in ({}, {"revision": "1" * 40}))
    media = MediaStore(tmp_path / "media")
    found = {}
    for commit in ("1" * 40, "2" * 40):
        planned, fixed = request(of, media, QUESTIONS[0]), request(pinned, media, QUESTIONS[0])
        downloaded(tmp_path, commit)
        asked = request(of, media, QUESTIONS[0])
        assert asked.params["checkpoint_digest"] == commit == load_local_model(of).checkpoint.digest
        assert asked.key != planned.key and request(pinned, media, QUESTIONS[0]).key == fixed.key
        found[commit] = asked.key, loaded_params(of)
    assert found["1" * 40] != found["2" * 40]  # what is looked into is another model, too


def test_another_registry_is_named_by_a_variable(tmp_path: Path) -> None:
    shipped = registry.MODELS_FILE.read_text()
    (tmp_path / "mine.yaml").write_text(shipped.replace("assets/pocket/weights", str(checkpoint("llava-next-video"))))
    ask = "from traps_pipeline.models.registry import entries; print(entries.get_model('pocket').params['checkpoint'])"
    mine = os.environ | {registry.MODELS_VARIABLE: str(tmp_path / "mine.yaml")}
    done = subprocess.run([sys.executable, "-c", ask], env=mine, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == str(checkpoint("llava-next-video"))


def test_missing_weights_are_told_before_anything_is_asked(tmp_path: Path) -> None:
    with raises(TrapsError, "models.registry.checkpoint.find_checkpoint", "`hf download nobody/nothing`"):
        make_backend(entry("qwen3-vl", "nobody/nothing"))
    with raises(TrapsError, "models.registry.checkpoint._require_whole", str(tmp_path / "gone" / "config.json")):
        request(entry("qwen3-vl", tmp_path / "gone"), MediaStore(tmp_path), QUESTIONS[0])


def test_a_failure_is_raised_by_every_call_of_the_batch(tmp_path: Path) -> None:
    of, media = entry("llava-next-video"), MediaStore(tmp_path)
    gone = replace(request(of, media, QUESTIONS[0]), media=tmp_path / "gone.mp4")

    async def both() -> list[Any]:
        backend = LocalBackend(of)
        failed = await asyncio.gather(backend.ask(gone), backend.ask(gone), return_exceptions=True)
        return [*failed, await backend.ask(request(of, media, QUESTIONS[0]))]

    first, second, later = asyncio.run(both())
    assert isinstance(first, TrapsError)
    assert str(first) == str(second)
    assert "gone.mp4" in str(first)
    assert isinstance(later, Outcome)  # the backend works on


def test_a_batch_that_nobody_waits_for_any_more_ends_early(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    of, media = entry("llava-next-video", max_new_tokens=2000), MediaStore(tmp_path)
    asked, seen = request(of, media, QUESTIONS[0]), []
    whole = LocalModel.generate

    def watched(self: LocalModel, *rest: Any, **named: Any) -> Any:
        seen.extend(whole(self, *rest, **named))
        return seen

    monkeypatch.setattr(LocalModel, "generate", watched)

    async def given_up() -> None:
        backend = LocalBackend(of)
        call = asyncio.create_task(backend.ask(asked))
        await asyncio.sleep(0.3)
        call.cancel()
        assert backend._running is not None
        await backend._running

    asyncio.run(given_up())
    assert len(seen[0].tokens) < 2000


# --- entries ----------------------------------------------------------------------------------------------------------

PARAMS = "checkpoint: a/b, dtype: float32, quantisation: none, do_sample: false, max_new_tokens: 4"


def local(params: str = PARAMS, device: str = ", device: cpu", more: str = "") -> str:
    """An entry of a local model without its id."""
    return f"backend: local, media: {{profile: frames, uniform: 4}}{device}, params: {{{params}}}{more}"


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (local(device=""), ["device: ", "cpu, cuda"]),
        (local(device=", device: gpu"), ["device: must be of the form"]),
        (local(PARAMS.replace(", quantisation: none", "")), ["params: quantisation: is missing"]),
        (local(f"{PARAMS}, top_k: 5"), ["params: top_k: "]),
        (local(f"{PARAMS}, temperature: 0.8"), ["params: ", "do_sample: false", "temperature"]),
        (local(PARAMS.replace("false", "true")), ["params: ", "do_sample: true", "temperature", "top_p"]),
        (local(f"{PARAMS}, nf4_skip: [lm_head]"), ["params: ", "nf4_skip", "quantisation: nf4"]),
        ("backend: reference, device: cpu, params: {strategy: oracle}", ["device, mechanism, size: ", "local"]),
        (local(more=", mechanism: {nf4_skip: [lm_head]}"), ["mechanism: ", "nf4_skip", "quantisation: nf4"]),
    ],
)
def test_a_wrong_entry_is_named_with_its_field(tmp_path: Path, text: str, named: list[str]) -> None:
    path = tmp_path / "models.yaml"
    path.write_text(f"models:\n  - {{id: m, {text}}}\n")
    with raises(TrapsError, "base.yamlfile.parse_yaml_model", str(path), "model 1 (m): ", *named):
        load_models(path)


def test_a_request_that_waits_for_its_batch_is_not_given_up() -> None:
    def limits(**given: Any) -> Limits:
        return ModelEntry.model_validate(entry("qwen3-vl").model_dump(exclude={"limits"}) | given).limits

    assert limits().timeout_s >= 24 * 3600
    assert limits(limits={"concurrency": 3}).timeout_s >= 24 * 3600
    assert limits(limits={"timeout_s": 5}).timeout_s == 5
    assert registry.get_model("qwen3-vl-think").limits.timeout_s == 600


def test_the_papers_three_local_models_are_asked_as_the_paper_has_it() -> None:
    """docs/spec.md 3.1."""
    entries = {name: registry.get_model(name) for name in ("qwen3-vl-8b", "gemma-4-e4b", "llava-next-video-7b")}
    params = {name: one.local_params() for name, one in entries.items()}
    assert {one.dtype for one in params.values()} == {"bfloat16"}
    assert {one.quantisation for one in params.values()} == {"none"}
    qwen, *others = params.values()
    assert (qwen.do_sample, qwen.max_new_tokens) == (False, 1024)
    for one in others:
        assert (one.temperature, one.top_p, one.max_new_tokens) == (0.8, 0.95, 512)
        assert one.attn_implementation == "sdpa"
    spec = entries["qwen3-vl-8b"].mechanism
    assert spec is not None
    assert spec.quantisation == "nf4"  # docs/spec.md 7.1


def test_the_doctor_tries_the_shipped_model_and_says_what_is_not_here(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--local", "--json"]) == 0
    found = {finding["what"]: finding["detail"] for finding in json.loads(capsys.readouterr().out)}
    assert found.keys() == {"devices", "nf4", "checkpoints", *(f"pocket, {check.name}" for check in CHECKS)}
    assert found["pocket, states"].endswith("bit for bit") and "NF4" in found["nf4"]
    assert found["devices"].startswith(f"torch {torch.__version__}") and "qwen3-vl-8b" in found["checkpoints"]


def test_models_of_one_device_share_a_worker_and_each_device_has_its_own() -> None:
    made = {device: LocalBackend(entry("qwen3-vl").model_copy(update={"device": device}))._worker
            for device in ("cpu", "cuda", "cuda:0", "cuda:1")}  # fmt: skip
    assert made["cuda"] is made["cuda:0"] is worker("cuda:0")
    assert len({id(each) for each in made.values()}) == 3
