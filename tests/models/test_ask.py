"""Asking: wanted minus known, and nothing twice, whatever the provider, the disk or the user does meanwhile."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.build.asking import CELL, LEFT, ONE, QUICK, TEN, Answering, ask, kept, of_model, request, work
from tests.build.errors import raises
from tests.build.ledger import local
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.asking import participants
from traps_pipeline.models.asking.answers import answer_request
from traps_pipeline.models.asking.ask import Call, run_work, settle
from traps_pipeline.models.asking.draining import STOP_SIGNALS
from traps_pipeline.models.registry.accounts import Limits
from traps_pipeline.models.registry.entries import get_model
from traps_pipeline.models.request import Outcome, Request, TransientError
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace


def test_what_was_answered_is_not_asked_again(tmp_path: Path) -> None:
    backend = Answering()
    first = ask(tmp_path, backend, TEN)
    assert (first["tally"].asked, first["tally"].cached, len(backend.calls)) == (10, 0, 10)
    second = ask(tmp_path, backend, TEN)
    assert (second["tally"].asked, second["tally"].cached, len(backend.calls)) == (0, 10, 10)
    assert second["rows"] == first["rows"]
    assert len(local(tmp_path).reasoning("m__standard__run1")) == 10


def test_only_the_difference_is_asked(tmp_path: Path) -> None:
    ask(tmp_path, Answering(), TEN[:7])
    backend = Answering()
    finished = ask(tmp_path, backend, TEN)
    assert backend.calls == ["item-7", "item-8", "item-9"]
    assert [row["key"] for row in finished["rows"]] == [wanted.key for wanted in TEN]


def test_a_passing_failure_is_tried_again_and_leaves_no_trace_but_the_count(tmp_path: Path) -> None:
    twice_busy = Answering(lambda _, call: TransientError("rate_limited") if call <= 2 else LEFT)
    (row,) = ask(tmp_path, twice_busy)["rows"]
    assert (row["outcome"], row["text"], row["error"], row["attempts"]) == ("answer", "left", None, 3)


@pytest.mark.parametrize(
    ("failure", "kind"), [(TransientError("timeout"), "timeout"), (asyncio.CancelledError(), "cancelled")]
)
def test_a_lasting_failure_is_an_outcome_without_text_and_is_asked_again_next_time(
    tmp_path: Path, failure: BaseException, kind: str
) -> None:
    backend = Answering(lambda *_: failure)
    finished = ask(tmp_path, backend)
    (row,) = finished["rows"]
    assert (row["outcome"], row["text"], row["error"], row["attempts"]) == ("error", None, kind, 3)
    assert finished["tally"].errors == 1 and len(backend.calls) == 1 + QUICK.retries
    for asked in (1, 0):
        finished = ask(tmp_path, Answering())
        assert [row["outcome"] for row in finished["rows"]] == ["answer"]
        assert (finished["tally"].asked, finished["tally"].errors) == (asked, 0)


@pytest.mark.parametrize("kind", ["empty", "refused", "truncated"])
def test_what_a_model_would_not_say_is_an_answer_of_its_own_and_not_asked_again(tmp_path: Path, kind: Any) -> None:
    backend = Answering(lambda *_: Outcome(kind))
    finished = [ask(tmp_path, backend) for _ in range(2)]
    assert [row["outcome"] for row in finished[1]["rows"]] == [kind]
    assert len(backend.calls) == 1


def test_a_provider_that_asks_to_wait_is_not_called_sooner(tmp_path: Path) -> None:
    wait = TransientError("rate_limited", retry_after_s=0.2)
    backend = Answering(lambda _, call: wait if call == 1 else LEFT)
    ask(tmp_path, backend)
    assert backend.moments[1] - backend.moments[0] >= 0.2


def test_waits_grow_with_each_retry_and_are_drawn_below_their_bound(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bounds: list[float] = []
    monkeypatch.setattr(participants.random, "uniform", lambda low, high: bounds.append(high) or 0.0)
    limits = Limits(concurrency=1, retries=8, backoff_s=1.0)
    ask(tmp_path, Answering(lambda *_: TransientError("timeout")), limits=limits)
    assert bounds == [1, 2, 4, 8, 16, 32, 60, 60]


def test_a_model_that_fails_does_not_stop_another(tmp_path: Path) -> None:
    broken = Answering(lambda *_: ValueError("no such parameter: temprature"))
    job, done = work(tmp_path, {"m": broken, "n": Answering()}, ONE), []
    with raises(ValueError, "models.asking.participants._send"):
        done.extend(finished["cell"] for finished in run_work(job, [CELL, of_model("n")]))
    assert done == [of_model("n")]


def test_several_models_that_fail_are_named_together(tmp_path: Path) -> None:
    def broken(asked: Request, _: int) -> Exception:
        return TrapsError(f"{asked.participant}: no key; set one")

    backends = {"m": Answering(broken), "n": Answering(broken), "o": Answering()}
    with raises(TrapsError, "models.asking.ask._raise_together", "m: no key", "n: no key"):
        list(run_work(work(tmp_path, backends, ONE), [of_model(name) for name in backends]))
    assert backends["o"].calls == ["item-1"]


def test_closing_the_work_early_records_the_calls_in_flight(tmp_path: Path) -> None:
    backends = {"m": Answering(), "n": Answering(after_s=0.3)}
    running = run_work(work(tmp_path, backends, TEN), [CELL, of_model("n")])
    assert next(running)["cell"] == CELL
    running.close()  # type: ignore[attr-defined]
    assert len(kept(tmp_path, of_model("n"))) == len(backends["n"].calls) >= 4


def test_calls_in_flight_are_recorded_when_another_call_of_the_cell_fails(tmp_path: Path) -> None:
    cannot = ValueError("cannot be sent")
    backend = Answering(lambda asked, _: cannot if asked.about["item_id"] == "item-1" else LEFT, after_s=0.05)
    with raises(ValueError, "models.asking.participants._send"):
        ask(tmp_path, backend, TEN)
    assert backend.calls == ["item-0", "item-1", "item-2", "item-3"]  # four at once, none begun afterwards
    assert len(kept(tmp_path)) == 3


DATASETS = ("chaotic", "occlusion", "occlusion_ill_posed")  # in the order of their cells


def work_on_cells(root: Path, backend: Answering, items: Sequence[Sequence[int]]) -> Iterator[dict[str, Any]]:
    """A run of one evaluation whose cells want these items."""
    of_cell = dict(zip(DATASETS, items, strict=True))
    cells = [Cell(dataset, CELL.evaluation) for dataset in DATASETS]
    job = replace(work(root, {"m": backend}, []), calls=lambda cell: [Call(request(n)) for n in of_cell[cell.dataset]])
    return run_work(job, cells)


def test_a_cell_is_asked_while_the_last_call_of_the_one_before_is_in_flight(tmp_path: Path) -> None:
    backend = Answering()
    waits = {"item-0": "item-2", "item-2": "item-4"}  # answered once a call of the next cell has come

    async def ask(asked: Request) -> Outcome:
        item = str(asked.about["item_id"])
        backend.calls.append(item)
        async with asyncio.timeout(5):
            while waits.get(item, item) not in backend.calls:
                await asyncio.sleep(0.001)
        return LEFT

    backend.ask = ask  # type: ignore[method-assign]
    finished = list(work_on_cells(tmp_path, backend, [[0, 1], [2, 3], [4, 5]]))
    assert [one["cell"].dataset for one in finished] == [*DATASETS]
    assert {row["outcome"] for one in finished for row in one["rows"]} == {"answer"}
    assert sorted(backend.calls) == [f"item-{n}" for n in range(6)]


def test_a_call_that_two_cells_share_is_asked_once_though_the_first_is_in_flight(tmp_path: Path) -> None:
    backend = Answering(after_s=0.05)
    finished = list(work_on_cells(tmp_path, backend, [[0, 1], [1, 2], [2, 0]]))
    assert backend.calls == ["item-0", "item-1", "item-2"]
    assert [len(one["rows"]) for one in finished] == [2, 2, 2]


def test_after_a_failure_no_further_cell_is_asked_and_calls_in_flight_are_recorded(tmp_path: Path) -> None:
    cannot = ValueError("cannot be sent")
    backend = Answering(lambda asked, _: cannot if asked.about["item_id"] == "item-2" else LEFT, after_s=0.05)
    finished = list[dict[str, Any]]()
    with raises(ValueError, "models.asking.participants._send"):
        finished.extend(work_on_cells(tmp_path, backend, [[0, 1], [2, 3], [4, 5]]))
    assert [one["cell"].dataset for one in finished] == ["chaotic"]
    assert [*backend.calls] == ["item-0", "item-1", "item-2", "item-3"]
    assert {*kept(tmp_path)} == {"item-0", "item-1", "item-3"}


def drained(root: Path, backend: Answering, stop: asyncio.Event) -> list[Any]:
    """What is settled of ten requests while a stop may come."""

    async def drain() -> list[Any]:
        return [finished async for finished in settle(work(root, {"m": backend}, TEN), [CELL], stop)]

    return asyncio.run(asyncio.wait_for(drain(), 120))


def test_stopping_records_the_calls_in_flight_and_starts_no_new_one(tmp_path: Path) -> None:
    stop = asyncio.Event()

    def stopping(asked: Request, _: int) -> Outcome:
        if asked.about["item_id"] == "item-5":
            stop.set()
        return LEFT

    backend = Answering(stopping, after_s=0.02)
    assert drained(tmp_path, backend, stop) == []
    assert len({*backend.calls}) == len(backend.calls) and {*kept(tmp_path)} == {*backend.calls}
    assert 6 <= len(backend.calls) <= 8


def test_stopping_does_not_wait_for_a_provider_that_asked_for_an_hour(tmp_path: Path) -> None:
    stop = asyncio.Event()

    def in_an_hour(*_: Any) -> Exception:
        asyncio.get_running_loop().call_later(0.05, stop.set)
        return TransientError("rate_limited", retry_after_s=3600.0)

    backend = Answering(in_an_hour)
    assert drained(tmp_path, backend, stop) == [] and len(backend.calls) == 4


INTERRUPTED = """
import asyncio, sys
from pathlib import Path
from tests.build.asking import CELL, LEFT, request, work
from traps_pipeline.models.asking import ask
class Slow:
    asked = 0
    async def ask(self, request):
        Slow.asked += 1
        if Slow.asked == 6:
            print("six calls", flush=True)
        await asyncio.sleep(0.3)
        return LEFT
try:
    list(ask.run_work(work(Path(sys.argv[1]), {"m": Slow()}, [request(n) for n in range(40)]), [CELL]))
except KeyboardInterrupt:
    print(Slow.asked, "asked", flush=True)
    sys.exit(130)
"""


def interrupted(script: str, folder: Path) -> subprocess.Popen[str]:
    """The script when six of its calls were sent."""
    command = [sys.executable, "-c", script, str(folder)]
    run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert run.stdout is not None and run.stdout.readline() == "six calls\n"
    return run


@pytest.mark.slow
@pytest.mark.promise
@pytest.mark.parametrize("stop", STOP_SIGNALS)
def test_a_stop_waits_for_the_calls_in_flight_and_goes_on_later(tmp_path: Path, stop: signal.Signals) -> None:
    run = interrupted(INTERRUPTED, tmp_path)
    run.send_signal(stop)
    out, err = run.communicate(timeout=180)
    assert run.returncode == 130
    assert stop.name in err and ("Ctrl-C" if stop is signal.SIGINT else " 30 s ") in err and "Traceback" not in err
    rows = kept(tmp_path)
    assert 6 <= len(rows) <= 8  # four at once: the second four, or two of them, were in flight
    assert out == f"{len(rows)} asked\n"


@pytest.mark.slow
def test_what_ends_a_process_by_force_later_gets_a_grace_and_ctrl_c_none(tmp_path: Path) -> None:
    script = INTERRUPTED.replace("asyncio.sleep(0.3)", "asyncio.sleep(0.3 if Slow.asked < 6 else 60)")
    script = script.replace(
        "class Slow:", "from traps_pipeline.models.asking import draining\ndraining.GRACE_S = 1.0\nclass Slow:"
    )
    run = interrupted(script, tmp_path)
    run.send_signal(signal.SIGTERM)
    out, err = run.communicate(timeout=180)
    assert run.returncode == 130, err
    assert len(kept(tmp_path)) == 5 and out in ("6 asked\n", "7 asked\n", "8 asked\n", "9 asked\n")


@pytest.mark.slow
def test_a_second_ctrl_c_stops_at_once(tmp_path: Path) -> None:
    script = INTERRUPTED.replace("asyncio.sleep(0.3)", "asyncio.sleep(0.3 if Slow.asked < 5 else 60)")
    run = interrupted(script, tmp_path)
    run.send_signal(signal.SIGINT)
    time.sleep(0.3)
    assert run.poll() is None
    run.send_signal(signal.SIGINT)
    _, err = run.communicate(timeout=180)
    assert run.returncode == 130, err
    assert "Traceback" not in err
    assert len(kept(tmp_path)) == 4


@pytest.mark.parametrize(
    "change",
    [
        {"participant": "n"},
        {"endpoint": "other"},
        {"params": {"temperature": 0.8}},
        {"system": "another system prompt"},
        {"user": "another question?"},
        {"media_digest": "abc"},
        {"about": {"item_id": "item-2", "model": "m", "regime": "standard", "run": 1}},
        {"secret": {"side": "void"}},
    ],
    ids=lambda change: next(iter(change)),
)
def test_the_key_changes_with_each_thing_that_decides_the_answer(change: dict[str, Any]) -> None:
    assert replace(request(1), **change).key != request(1).key


def test_the_key_is_of_all_of_a_text_and_not_of_where_the_clip_lies_or_in_what_order_parameters_stand() -> None:
    one = request(1, params={"a": 1, "b": 2}, media=Path("/here/clip.mp4"), media_digest="abc")
    two = request(1, params={"b": 2, "a": 1}, media=Path("/there/clip.mp4"), media_digest="abc")
    assert one.key == two.key
    assert len({request(1, user=text).key for text in ("x" * 600, "x" * 601, "x" * 600 + "y")}) == 3


FIRST = Evaluation("random-50", "standard", 1)
ITEM = {
    "item_id": "occlusion:s-1:control",
    "side": "control",
    "question": "Left or right?",
    "labels": ["left", "right"],
    "ground_truth": "left",
    "commonest_answer": "right",
    "clip": "clips/s-1/control.mp4",
    "media_digest": "abc",
}


def test_the_key_holds_no_limits_but_run_regime_item_and_ground_truth(tmp_path: Path) -> None:
    workspace, entry = Workspace.create(tmp_path, Study()), get_model("random-50")

    def key(evaluation: Evaluation = FIRST, **changes: Any) -> str:
        return answer_request(workspace, entry, ITEM | changes, evaluation).key

    limited = entry.model_copy(update={"limits": Limits(concurrency=1, retries=0, backoff_s=9.0)})
    assert answer_request(workspace, limited, ITEM, FIRST).key == key()
    assert key(clip="clips/elsewhere.mp4") == key()
    evaluations = [
        Evaluation("random-50", regime, run) for regime in ("standard", "guided", "json") for run in (1, 2, 3)
    ]
    assert len({key(evaluation) for evaluation in evaluations}) == 9
    assert key(item_id="occlusion_ill_posed:s-1:control") != key()  # the same control in two datasets is two calls
    assert key(ground_truth="right") != key()
    assert key(commonest_answer="left") == key()  # only `prior` reads it


def test_the_ground_truth_of_a_pair_is_no_part_of_its_voids_key(tmp_path: Path) -> None:
    workspace, entry = Workspace.create(tmp_path, Study()), get_model("oracle")
    void = ITEM | {"side": "void", "ground_truth": None}
    request = answer_request(workspace, entry, void | {"control_answer": "left"}, Evaluation("oracle", "standard", 1))
    assert request.secret == {"side": "void", "labels": ["left", "right"]}
    assert "left" not in request.system and request.user == "Left or right?"


def test_a_variation_of_the_asking_changes_the_request_and_a_dataset_of_the_pairs_does_not(tmp_path: Path) -> None:
    workspace, entry = Workspace.create(tmp_path, Study()), get_model("gemini-2.5-flash")
    entry = entry.model_copy(update={"media": None})

    def asked(dataset: str, regime: str = "standard") -> Request:
        item = ITEM | {"item_id": f"{dataset}:s-1:control"}
        return answer_request(workspace, entry, item, Evaluation("gemini-2.5-flash", regime, 1))

    plain, json = asked("occlusion"), asked("occlusion", "json")
    reason, abstain = asked("schema_reason"), asked("schema_abstain")
    assert (reason.system, reason.params) == (json.system, json.params)  # the paper's own object
    assert asked("labels_two").system == asked("frames_few").system == plain.system
    assert "response_format" not in plain.params
    schema = abstain.params["response_format"]["json_schema"]["schema"]
    assert schema["required"] == ["reason", "abstain", "final_answer"]
    assert schema["properties"]["abstain"] == {"type": "boolean"}
    silent = entry.model_copy(update={"json_schema": False})  # an endpoint without structured output: the prompt alone
    item = ITEM | {"item_id": "schema_abstain:s-1:control"}
    told = answer_request(workspace, silent, item, Evaluation("gemini-2.5-flash", "standard", 1))
    assert "response_format" not in told.params and told.system == abstain.system


HTTP_400 = Outcome("error", error="http_400", cost_usd=0.0)


def outcomes(rows: list[Any]) -> list[tuple[str, str | None]]:
    return [(row["outcome"], row["error"]) for row in rows]


def test_calls_refused_twice_while_their_model_answers_are_refusals_and_not_asked_again(tmp_path: Path) -> None:
    backend = Answering(lambda wanted, _: HTTP_400 if wanted.about["item_id"] in ("item-3", "item-9") else LEFT)
    first = ask(tmp_path, backend, TEN)
    assert outcomes(first["rows"]) == [("refused", "http_400") if n in (3, 9) else ("answer", None) for n in range(10)]
    assert first["tally"].errors == 0 and len(backend.calls) == 10 + 2 + 1  # both again, and one that was answered
    second = ask(tmp_path, backend, TEN)
    assert second["rows"] == first["rows"] and len(backend.calls) == 13 and kept(tmp_path).count("item-3") == 1


@pytest.mark.parametrize(
    ("says", "calls"),
    [
        (lambda *_: HTTP_400, 4),  # nothing is answered
        (lambda wanted, call: HTTP_400 if wanted.about["item_id"] == "item-0" or call > 1 else LEFT, 6),  # nor now
        (lambda wanted, _: replace(HTTP_400, error="http_402") if wanted.about["item_id"] == "item-0" else LEFT, 4),
        (
            lambda wanted, call: (
                replace(HTTP_400, error=f"http_{421 + call}") if wanted.about["item_id"] == "item-0" else LEFT
            ),
            5,
        ),
    ],
    ids=["all", "until the control", "credit", "another error"],
)
def test_a_failure_that_may_be_the_accounts_stays_a_failure(tmp_path: Path, says: Any, calls: int) -> None:
    backend = Answering(says)
    finished = ask(tmp_path, backend, TEN[:4])
    assert finished["rows"][0]["outcome"] == "error" and finished["tally"].errors >= 1
    assert len(backend.calls) == calls


def test_a_call_that_is_answered_the_second_time_is_an_answer(tmp_path: Path) -> None:
    backend = Answering(lambda wanted, call: HTTP_400 if wanted.about["item_id"] == "item-0" and call == 1 else LEFT)
    finished = ask(tmp_path, backend, TEN[:4])
    assert outcomes(finished["rows"]) == [("answer", None)] * 4 and len(backend.calls) == 5


def test_calls_of_another_form_prove_nothing(tmp_path: Path) -> None:
    wanted = [request(0, params={"schema": True}), *TEN[1:4]]
    finished = ask(tmp_path, Answering(lambda one, _: HTTP_400 if one.params else LEFT), wanted)
    assert outcomes(finished["rows"])[0] == ("error", "http_400")


def test_many_refusals_in_a_row_at_their_second_asking_stop_no_model(tmp_path: Path) -> None:
    wanted = [request(n) for n in range(60)]
    backend = Answering(lambda one, _: HTTP_400 if int(str(one.about["item_id"])[5:]) % 2 else LEFT)
    finished = ask(tmp_path, backend, wanted)
    assert sum(row["outcome"] == "refused" for row in finished["rows"]) == 30 and len(backend.calls) == 60 + 30 + 1
