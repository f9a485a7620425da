"""Models over the network: real HTTP to a provider that misbehaves, through the commands that people use."""

from __future__ import annotations

import json
import os
import random
import signal
import sys
import time
from collections import Counter
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from tests.build.network import ITEMS, ask, entry, experiment, responses, settled
from tests.conftest import SECRET, Checkout, forget_answers
from tests.providers.server import Provider

pytestmark = pytest.mark.slow

MANY = "TRAPS_MANY_CALLS" in os.environ  # 864 calls in the place of 288 and of 192, and five kills: for a release
TRANSIENT = {
    "rate_limited": 0.03,
    "rate_limited_bare": 0.03,
    "server_error": 0.03,
    "overloaded": 0.02,
    "hang": 0.004,  # each waits for its time-out
    "cut": 0.025,
    "wrong_content_type": 0.002,  # tried again once only
    "timeout_status": 0.01,
    "conflict": 0.01,
}
OUTCOMES = {"empty": "empty", "length": "truncated", "thinking_exhausted": "truncated", "content_filter": "refused"}
ENDINGS = dict.fromkeys(("empty", "length", "content_filter", "thinking_exhausted", "invalid_json"), 0.01)


def test_a_fifth_of_all_calls_fails_and_every_item_ends_rightly_without_a_trace_of_the_key(
    unasked: Checkout, provider: Provider
) -> None:
    provider.configure(faults=TRANSIENT | ENDINGS, only_first_attempts=3, latency_s=0.02, seed=1)
    runs, both = [1, 2, 3] if MANY else [1], [entry("video-model", "video"), entry("image-model", "images")]
    path = experiment(unasked, provider, both, regimes=["standard", "guided", "json"], runs=runs)
    finished = ask(unasked, path, "--budget-usd", "500").ok()
    rows, stats = responses(unasked), provider.stats()
    assert (
        len(rows) == len({(r["item_id"], r["model"], r["regime"], r["run"]) for r in rows}) == 2 * ITEMS * 3 * len(runs)
    )
    # Which calls end badly depends on the bytes of the clips: what was sent is what counts.
    outcomes, ends = Counter(row["outcome"] for row in rows), Counter[str]()
    for fault, count in stats["answered_by_fault"].items():
        ends[OUTCOMES.get(fault, "answer")] += count
    assert outcomes == ends and len(ends) > 2
    assert outcomes["answer"] > 0.9 * len(rows)
    for row in rows:
        assert (row["text"] is not None) == (row["outcome"] == "answer")
    texts = {row["text"] for row in rows if row["outcome"] == "answer"}
    said = ("The answer is: ", '{"', "Sure! Here is what I think: ")  # the last is no JSON, though the regime wants it
    assert not [text for text in texts if not text.startswith(said)]  # no failure is a text
    assert max(row["attempts"] for row in rows) <= 6
    # Every answer that the provider sent in full is in the ledger once, and nothing else is.
    assert stats["answered_in_full"] == len(settled(unasked)) == len(rows)
    assert len({row["key"] for row in settled(unasked)}) == len(rows)
    assert all(row["cost_usd"] > 0 for row in settled(unasked))
    for record in provider.requests(limit=10):
        body = record["body"]
        assert (body["temperature"], body["top_p"], body["max_tokens"]) == (0.8, 0.95, 8000)
        images = [part for part in body["messages"][1]["content"] if part["type"] == "image_url"]
        assert len(images) <= 25
    written = [file for file in unasked.workspace.rglob("*") if file.is_file() and not file.is_symlink()]
    assert len(written) > 100
    assert not [file for file in written if SECRET.encode() in file.read_bytes()]
    assert SECRET not in finished.out + finished.err


def test_a_filter_in_unknown_words_is_settled_in_one_run_and_the_study_is_whole(
    unasked: Checkout, provider: Provider
) -> None:
    path = experiment(unasked, provider, [entry("image-model", "images")], regimes=["standard"])
    files = [*(unasked.workspace / "tables" / "items").rglob("*.parquet")]
    questions = [{*row.values()} for file in files for row in pq.read_table(file, columns=["question"]).to_pylist()]
    (filtered,) = questions[0]
    n_filtered, n_cells = questions.count({filtered}), 2
    provider.configure(filtered=[filtered])
    unasked.traps("run", path, "--no-preflight", "--budget-usd", "50").ok()
    rows = responses(unasked)
    assert len(rows) == ITEMS and Counter((row["outcome"], row["error"]) for row in rows) == {
        ("answer", None): ITEMS - n_filtered,
        ("refused", "http_400"): n_filtered,
    }
    requests = provider.stats()["requests"]
    assert ITEMS + n_filtered < requests <= ITEMS + n_filtered + n_cells  # each again, and a control in each such cell
    unasked.traps("run", path, "--no-preflight").ok()
    assert provider.stats()["requests"] == requests
    (row,) = pq.read_table(next((unasked.workspace / "tables" / "leaderboard").rglob("*.parquet"))).to_pylist()[:1]
    assert row["n_errors"] == 0


@pytest.mark.promise
def test_the_cap_holds_and_the_next_run_goes_on(unasked: Checkout, provider: Provider) -> None:
    provider.configure(latency_s=0.05)
    model = entry("image-model", "images").replace("limits: {", "limits: {concurrency: 200, ")
    path = experiment(unasked, provider, [model])
    first = ask(unasked, path, "--budget-usd", "0.4")  # all answers cost about $0.70
    assert first.code == 4 and "$0.40" in first.err and "--budget-usd" in first.err, first.err
    spent = sum(row["cost_usd"] for row in settled(unasked))
    assert 0 < spent <= 0.4
    assert provider.stats()["answered_in_full"] == len(settled(unasked))
    again = ask(unasked, path)  # spend survives restarts
    assert again.code == 4
    assert sum(row["cost_usd"] for row in settled(unasked)) <= 0.4
    ask(unasked, path, "--budget-usd", "100").ok()
    assert provider.stats()["answered_in_full"] == len(settled(unasked)) == 2 * ITEMS


@pytest.mark.promise
def test_money_of_calls_that_a_kill_cut_off_is_released_and_the_study_goes_on(
    unasked: Checkout, provider: Provider
) -> None:
    provider.configure(latency_s=600.0)
    path = experiment(unasked, provider, [entry("image-model", "images")])
    command = ("run", str(path), "--no-preflight", "--until", "responses", "--budget-usd", "0.4")
    process = unasked.start(sys.executable, "-m", "traps_pipeline.cli", *command)
    in_flight = 0
    while not in_flight or provider.stats()["in_flight"] > in_flight:  # until no other call fits
        assert process.poll() is None, process.communicate()
        in_flight = provider.stats()["in_flight"]
        time.sleep(2 if in_flight else 0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    provider.configure(latency_s=0.0)
    blocked = ask(unasked, path)
    assert blocked.code == 4 and "$0.40" in blocked.err, blocked.err
    assert settled(unasked) == []
    listed = unasked.traps("study", "release-money")
    assert listed.code == 0 and "image-model" in listed.out
    release = ("study", "release-money", "--participant", "image-model", "--all-in-flight")
    assert unasked.traps(*release).code == 1  # a reason is wanted
    assert unasked.traps(*release, "--why", "the provider's bill has none of them").code == 0
    assert json.loads(unasked.traps("study", "release-money", "--json").ok().out) == {}
    assert ask(unasked, path).code == 4  # goes on, up to the same cap
    assert 0 < sum(row["cost_usd"] for row in settled(unasked)) <= 0.4


def test_paid_stages_want_a_budget_and_a_price_whoever_starts_them(unasked: Checkout, provider: Provider) -> None:
    path = experiment(unasked, provider, [entry("image-model", "images"), entry("no-price", "images", "runs: 1")])
    refused = ask(unasked, path)
    assert refused.code == 1
    told = refused.err.splitlines()
    assert any("image-model" in line and "`traps plan`" in line for line in told), refused.err
    assert any("no-price" in line and "--allow-unknown-prices" in line for line in told), refused.err
    partition = "occlusion|image-model__standard__run1"
    materialize = ("asset", "materialize", "-m", "traps_pipeline.definitions", "--select", "responses", "--partition")
    clicked = unasked.dagster(*materialize, partition)
    assert clicked.code != 0
    assert "`traps plan`" in clicked.out + clicked.err
    assert provider.stats()["requests"] == 0
    planned = unasked.traps("plan", path).out.splitlines()
    assert "no-price" in [line.rpartition(" ")[2] for line in planned]  # below the tables, whose lines end in figures


def test_a_model_that_only_fails_is_stopped_and_the_others_go_on(unasked: Checkout, provider: Provider) -> None:
    provider.configure(fault_by_model={"locked-out": "unauthorized"})
    path = experiment(unasked, provider, [entry("image-model", "images"), entry("locked-out", "images")])
    finished = ask(unasked, path, "--budget-usd", "10")
    assert finished.code == 1
    assert SECRET not in finished.out + finished.err
    answered = [row for row in responses(unasked) if row["outcome"] != "error"]
    assert len(answered) == 2 * ITEMS
    assert {row["model"] for row in answered} == {"image-model"}
    # 20 in a row, those in flight then, and no more; in no later batch either.
    assert provider.stats()["by_status"]["401"] < 20 + 24
    (stopped,) = (line for line in finished.err.splitlines() if "locked-out" in line and "(http_401)" in line)
    assert " 20 " in stopped


def test_only_what_decides_an_answer_is_asked_again(own_study: Checkout, provider: Provider) -> None:
    study, of = forget_answers(own_study), {"regimes": ["standard"], "datasets": ["chaotic", "chaotic_ill_posed"]}
    path = experiment(study, provider, [entry("image-model", "images")], **of)
    assert ask(study, path, "--budget-usd", "10").counts()["answers"] == ITEMS / 2
    quick = entry("image-model", "images").replace("timeout_s: 36", "timeout_s: 40, concurrency: 3")
    experiment(study, provider, [quick.replace("input: 1.0", "input: 2.0")], **of)
    assert ask(study, path).counts()["answers"] == 0
    study.correct("plinko-0001", question="In which numbered bucket, 1 to 7, does the ball end?")
    assert ask(study, path).counts()["answers"] == 3  # control and void, and the ill-posed pair's control
    other = quick.replace("temperature: 0.8", "temperature: 0.5") + "    waivers: {temperature: a test}\n"
    experiment(study, provider, [other], **of)
    assert ask(study, path).counts()["answers"] == ITEMS / 2


def test_kills_cost_no_more_than_what_was_in_flight(unasked: Checkout, provider: Provider) -> None:
    provider.configure(latency_s=0.1)
    both = [entry("video-model", "video"), entry("image-model", "images")]
    models, regimes = both[: 1 + MANY], ["standard", "json", "guided"][: 2 + MANY]
    path = experiment(unasked, provider, models, regimes=regimes, runs=[1, 2, 3][: 2 + MANY])
    wanted, kills = ITEMS * len(models) * len(regimes) * (2 + MANY), 5 if MANY else 3
    points = sorted(random.Random(1).sample(range(1, wanted * 7 // 8), kills))
    for point in points:
        command = ("run", str(path), "--no-preflight", "--until", "responses", "--budget-usd", "500")
        process = unasked.start(sys.executable, "-m", "traps_pipeline.cli", *command)
        while len(unasked.ledger_rows("answers")) < point:
            assert process.poll() is None, process.communicate()
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
    ask(unasked, path).ok()
    rows = settled(unasked)
    assert len(rows) == len({row["key"] for row in rows}) == wanted
    sent = provider.stats()["answered_in_full"]
    print(f"{wanted} wanted, killed at {points}: {sent} answers sent")
    assert sent <= wanted + kills * 24 * len(models)
    assert unasked.in_flight_usd() >= (sent - wanted) * min(
        row["cost_usd"] for row in rows
    )  # what nobody has is spent too


def test_a_stop_sends_nothing_more_and_keeps_what_comes_back(unasked: Checkout, provider: Provider) -> None:
    # Of a cell's 12 calls 8 go out at once. While the other four are out, for two seconds, the run is stopped.
    provider.configure(latency_s=2.0)
    model = entry("image-model", "images").replace("limits: {", "limits: {concurrency: 8, ")
    command = ("run", str(experiment(unasked, provider, [model])), "--no-preflight", "--budget-usd", "100")
    for stop in (signal.SIGTERM, signal.SIGHUP):
        before = len(settled(unasked))
        process = unasked.start(sys.executable, "-m", "traps_pipeline.cli", *command)
        # Once four have come back the last four are out, and the server has counted them.
        while len(settled(unasked)) < before + 4 or provider.stats()["requests"] < before + 12:
            assert process.poll() is None, process.communicate()
            time.sleep(0.05)
        process.send_signal(stop)
        said = b""
        assert process.stderr is not None
        while stop.name.encode() not in said:  # on a busy machine it may take a while until it knows of the signal
            part = os.read(process.stderr.fileno(), 65536)
            assert part, said  # it ended without a word
            said += part
        time.sleep(0.1)
        requests = provider.stats()["requests"]
        _, err = process.communicate(timeout=540)
        assert (process.returncode, "Traceback" in err) == (130, False), err
        assert " 30 s " in said.decode() + err  # as long it waits
        assert provider.stats()["requests"] == requests
        assert provider.stats()["answered_in_full"] == len(settled(unasked))  # nothing that came back is lost
        assert unasked.in_flight_usd() == 0
        assert not unasked.ledger_rows("votes")


def test_a_cluster_answers_in_the_models_stead(unasked: Checkout, provider: Provider, tmp_path: Path) -> None:
    both = [entry("video-model", "video"), entry("image-model", "images")]
    path = experiment(unasked, provider, both, regimes=["standard"], datasets=["occlusion"])
    unasked.traps("study", "export-requests", path, "--out", tmp_path / "batch").ok()
    lines = [json.loads(line) for line in (tmp_path / "batch" / "requests.jsonl").read_text().splitlines()]
    assert len(lines) == len({line["key"] for line in lines}) == 24
    for line in lines:
        file = tmp_path / "batch" / line["media"]["file"]
        assert file.stem == line["media"]["sha256"] and file.is_file()
        assert line["params"] == {"temperature": 0.8, "top_p": 0.95, "max_tokens": 8000}
    answers = [{"key": line["key"], "text": "The answer is: left.", "prompt_tokens": 9} for line in lines]
    answers[0] = {"key": lines[0]["key"], "outcome": "refused", "finish_reason": "content_filter"}
    given = tmp_path / "answers.jsonl"

    given.write_text("\n".join(json.dumps(answer) for answer in [*answers[:20], {"key": "0" * 64, "text": "x"}]))
    refused = unasked.traps("study", "import-answers", path, given)
    assert (refused.code, refused.raised) == (1, "exchange.answer_exchange.checked_answers")
    assert "answers.jsonl:21: " in refused.err and "0" * 16 in refused.err
    assert settled(unasked) == []

    for some, counts in ((answers[:20], {"new": 20, "known": 0}), (answers, {"new": 4, "known": 20})):
        given.write_text("\n".join(json.dumps(answer) for answer in some))
        imported = json.loads(unasked.traps("study", "import-answers", path, given, "--json").ok().out)
        assert imported == counts | {"failed": "", "dropped": 0, "scores": 2}
    finished = ask(unasked, path).ok()
    assert finished.counts()["answers"] == 0
    assert provider.stats()["requests"] == 0
    assert Counter(row["outcome"] for row in responses(unasked)) == {"answer": 23, "refused": 1}
