"""A study that is asked through batch files alone has the tables of the same study asked live."""

from __future__ import annotations

import json
import urllib.request
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow.parquet as pq
import pytest

from tests.conftest import KEY, SECRET, SMALL, Checkout, copy_of, forget_answers
from tests.providers.server import Provider
from traps_pipeline.judging.judging_rows import VERDICTS, VOTES
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.scoring.score_rows import LEADERBOARD
from traps_pipeline.storage.tables import Table

pytestmark = pytest.mark.slow
# A model and a judge of each form of a batch; vLLM's run-batch has OpenAI's.
ROUTES = {"openai": "v1", "gemini": "v1beta", "anthropic": "v1"}
TABLES: tuple[Table[Any], ...] = (RESPONSES, VOTES, VERDICTS, LEADERBOARD)
# Names that the client library knows: it hides the system prompt in the question of a Gemini that it does not know.
SERVED = {"openai": "seer", "gemini": "gemini-3-flash-preview", "anthropic": "claude-opus-4-6"}
# Of the call and not of what it said: when, how often, how long, and half the price.
OF_THE_CALL = ("created_at", "attempts", "latency_s", "cost_usd", "client")


def experiment(folder: Path, url: str) -> Path:
    """Three models and three judges, each over another API, on the small study's scenarios."""
    price = "prices: {input: 1, output: 10, as_of: 2026-11-01}"
    accounts, models, judges = "", "", ""
    for route, version in ROUTES.items():
        base = url if route == "anthropic" else f"{url}/{version}"
        accounts += f"  at-{route}: {{key: {KEY}, base_url: {base}, batch_price: 0.5}}\n"
        asked = f"backend: api, account: at-{route}, provider_id: {route}/{SERVED[route]}, {price}"
        sampling = "params: {temperature: 0.8, max_tokens: 8000}, waivers: {top_p: left out for all three}"
        media = "media: {profile: images, fps: 5, most: 25}"
        models += f"  - {{id: model-{route}, {asked}, {media}, {sampling}}}\n"
        judges += f"  - {{id: judge-{route}, {asked}, params: {{temperature: 0.8, max_tokens: 512}}}}\n"
    path = folder / "batched.yaml"
    path.write_text(
        f"name: batched\naccounts:\n{accounts}models:\n{models}judges:\n{judges}"
        f"panels: {{three: [{', '.join(f'judge-{route}' for route in ROUTES)}]}}\npanel: three\nbudget_usd: 100\n"
        f"regimes: [standard]\ndatasets: [occlusion]\n{SMALL.read_text()[SMALL.read_text().index('scenarios:') :]}"
    )
    return path


def answered(url: str, line: Mapping[str, Any]) -> dict[str, Any]:
    """What a provider's batch returns for a line: its live answer to the body, in its form."""
    key = line.get("custom_id", line.get("key"))
    if "request" in line:
        return {
            "key": key,
            "response": _post(f"{url}/v1beta/models/{SERVED['gemini']}:generateContent", line["request"]),
        }
    if "params" in line:
        message = _post(f"{url}/v1/messages", line["params"])
        return {"custom_id": key, "result": {"type": "succeeded", "message": message}}
    body = _post(url + line["url"], line["body"])
    return {"id": "b", "custom_id": key, "response": {"status_code": 200, "body": body}, "error": None}


def _post(address: str, body: Any) -> Any:
    headers = {"Authorization": f"Bearer {SECRET}", "content-type": "application/json"}
    with urllib.request.urlopen(urllib.request.Request(address, json.dumps(body).encode(), headers)) as answer:
        return json.load(answer)


def through_files(study: Checkout, path: Path, what: str, url: str, folder: Path) -> None:
    """Export requests or votes, have each file answered as its provider would, and import what comes back."""
    export = ("study", "export-requests", path, "--batch") if what == "answers" else ("study", "export-votes", path)
    study.traps(*export, "--out", folder).ok()
    files = sorted((folder / "batches").iterdir())
    assert [file.suffix for file in files] == [".json", ".jsonl", ".jsonl"]
    results = folder / "results.jsonl"
    for file in files:
        text = file.read_text()
        asked = json.loads(text)["requests"] if file.suffix == ".json" else map(json.loads, text.splitlines())
        results.write_text("".join(json.dumps(answered(url, line)) + "\n" for line in asked))
        imported = json.loads(study.traps("study", f"import-{what}", path, results, "--json").ok().out)
        assert imported["new"] and not imported["known"]


def table(study: Checkout, which: Table[Any]) -> pd.DataFrame:
    """A table of the experiment's models, without what belongs to the call."""
    files = sorted((study.workspace / "tables" / which.name).rglob("*.parquet"))
    rows = pd.concat([pq.ParquetFile(file).read().to_pandas() for file in files], ignore_index=True)
    rows = rows.loc[rows["model"].str.startswith("model-")].drop(columns=[*OF_THE_CALL], errors="ignore")
    return rows.sort_values([*which.key]).reset_index(drop=True)


def test_answers_and_votes_through_files_alone_make_the_tables_of_the_live_path(
    unasked: Checkout, small: Checkout, provider: Provider, tmp_path: Path
) -> None:
    batched = forget_answers(copy_of(small, tmp_path / "batched"))
    path = experiment(tmp_path, provider.url)
    unasked.traps("run", path, "--panel", "three", "--no-preflight", "--until", "leaderboard").ok()
    calls = provider.stats()["requests"]

    assert batched.traps("init", path, "--panel", "three").code == 0
    through_files(batched, path, "answers", provider.url, tmp_path / "requests")
    answers = batched.traps("run", path, "--no-preflight", "--until", "responses")
    assert answers.code == 0 and answers.counts()["answers"] == 0, answers.err
    through_files(batched, path, "votes", provider.url, tmp_path / "votes")
    votes = batched.traps("run", path, "--no-preflight", "--until", "leaderboard")
    assert votes.code == 0 and votes.counts() == {"answers": 0, "votes": 0, "frames": 0}, votes.err
    assert provider.stats()["requests"] == 2 * calls  # each call once live and once in a batch

    for which in TABLES:
        ours, theirs = table(batched, which), table(unasked, which)
        assert len(ours) and set(ours["model"]) == {f"model-{route}" for route in ROUTES}, which.name
        pd.testing.assert_frame_equal(ours, theirs)
    for route in ROUTES:
        endpoint = f"{route}/{SERVED[route]}"
        costs = [
            sum(row["cost_usd"] for row in study.ledger_rows("answers") if row["components"]["endpoint"] == endpoint)
            for study in (batched, unasked)
        ]
        assert costs[0] == pytest.approx(costs[1] / 2)
