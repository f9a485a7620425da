"""Each error of the package that names a remedy has a test that carries it out, or is listed here with the reason."""

from __future__ import annotations

import pytest

from tests.remedies.remedied import says
from tests.remedies.sentences import by_sentence, carried_out, remedies

# Sentences that tell nothing to do against an error, though they have words like it.
NO_REMEDIES: dict[str, str] = {
    "cli/release.py | fix a sampled benchmark before anybody sees it: write a commitment to publish, and a reveal to "
    "keep": "the help of a command",
    "report/leaderboard.py | Acc × max(0, J), from 0 to 1; computed per run, then averaged. J is clipped at 0 here, so "
    "chance alone lifts a random strategy slightly above 0; look at the column J, which is not clipped": (
        "what a column means"
    ),
    "scoring/contrasts.py | the two studies share no whole pair of the same model, regime and run": "run is a noun",
}


def test_many_errors_name_a_remedy() -> None:
    assert len(remedies()) > 200


def test_each_remedy_is_carried_out_by_a_test() -> None:
    listed = set(NO_REMEDIES)
    nobody = [one.where for one in remedies() if one not in by_sentence() and f"{one.file} | {one.text}" not in listed]
    assert not nobody, "no test carries out what these errors say (tests/remedies/remedied.py):\n" + "\n".join(nobody)


def test_what_is_listed_as_no_remedy_is_a_sentence_that_no_test_carries_out() -> None:
    there = {f"{one.file} | {one.text}": one for one in remedies()}
    gone = [line for line in NO_REMEDIES if line not in there]
    assert not gone, "the package no longer says these; take them off the list:\n" + "\n".join(gone)
    done = [line for line in NO_REMEDIES if there[line] in by_sentence()]
    assert not done, "a test carries these out; take them off the list:\n" + "\n".join(done)


def test_what_a_test_carries_out_is_a_sentence_of_the_package() -> None:
    wrong = {one.where: one.text for one in carried_out() if not one.finds()}
    assert not wrong, "the package says nothing like it"
    several = {one.where: [found.where for found in one.finds()] for one in carried_out() if len(one.finds()) > 1}
    assert not several, "more than one sentence has these words: say more of it, or `FILE.py | words`"


@pytest.mark.parametrize(
    ("sentence", "told", "said"),
    [
        ("{}: is empty; restore it", "a.txt: is empty; restore it from git", True),
        ("is empty ({}); restore it", "a.txt: is empty (0\nbytes); restore it from git", True),
        ("is empty; restore it", "a.txt: is empty; delete it", False),
    ],
)
def test_a_sentence_is_found_in_what_an_error_says(sentence: str, told: str, said: bool) -> None:
    assert says(sentence, told) is said
