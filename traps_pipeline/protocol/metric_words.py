"""Declare the leaderboard's metrics and counts: the tables, the intervals, the legend and the explorer read them here.

`scoring.metrics` computes them, `scoring.bootstrap` resamples them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import numpy as np

Formula = Callable[["np.ndarray", "np.ndarray", "np.ndarray"], "np.ndarray"]


@dataclass(frozen=True)
class Metric:
    """A number of the leaderboard; `side` is the side whose items it counts ("" for both)."""

    name: str
    heading: str
    meaning: str
    formula: Formula
    """The metric from Acc, FalseAbs and AbsRec, (..) each."""
    side: str = ""
    lowest: float = 0.0
    less_is_better: bool = False
    low_formula: Formula | None = None
    """The formula of the lower end of its interval, where that is another one."""

    @property
    def is_share(self) -> bool:
        """Whether it is a share of the items of one side, printed in percent."""
        return bool(self.side)

    @property
    def unit(self) -> Literal["percent", "fraction"]:
        """How the number is printed: as a percentage or a fraction."""
        return "percent" if self.is_share else "fraction"

    def ends(self, acc: np.ndarray, false_abs: np.ndarray, abs_rec: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return its lower and upper end from those of the three shares, (2, ..) each.

        It must rise in Acc and AbsRec and fall in FalseAbs, or, if less is better, rise in FalseAbs.
        """
        worst, best = (0, 1) if self.less_is_better else (1, 0)
        low = self.low_formula or self.formula
        return low(acc[0], false_abs[worst], abs_rec[0]), self.formula(acc[1], false_abs[best], abs_rec[1])


# In the order in which metrics of one entry are printed.
METRIC_WORDS: Mapping[str, Metric] = {
    metric.name: metric
    for metric in (
        Metric(
            "pecs", "PECS",
            "Acc × max(0, J), from 0 to 1; computed per run, then averaged. J is clipped at 0 here, so chance alone "
            "lifts a random strategy slightly above 0; look at the column J, which is not clipped",
            lambda acc, false_abs, abs_rec: acc * (abs_rec - false_abs).clip(0.0),
            # At J = 0 the clipped J of every cell and run is above 0 by chance, and so would be the lower end of their
            # mean. `bootstrap.interval` clips the mean.
            low_formula=lambda acc, false_abs, abs_rec: acc * (abs_rec - false_abs),
        ),
        Metric("acc", "Acc %", "share of control items answered correctly", lambda acc, *_: acc, side="control"),
        Metric(
            "abs_rec", "AbsRec %",
            "abstention recall: share of void items, which cannot be answered, that the model abstains on",
            lambda acc, false_abs, abs_rec: abs_rec, side="void",
        ),
        Metric(
            "false_abs", "FalseAbs %", "share of control items, which can be answered, that the model abstains on",
            lambda acc, false_abs, abs_rec: false_abs, side="control", less_is_better=True,
        ),
        Metric(
            "j", "J",
            "AbsRec − FalseAbs, from −1 to 1; 0 for every strategy that does not distinguish void from control",
            lambda acc, false_abs, abs_rec: abs_rec - false_abs, lowest=-1.0,
        ),
    )
}  # fmt: skip
SHARES = tuple(name for name, metric in METRIC_WORDS.items() if metric.is_share)


@dataclass(frozen=True)
class Count:
    """A count of items, or of voids with a decision that not every panel is asked for."""

    name: str
    heading: str
    """That of its column on the leaderboard, which is there if the count is not 0; empty if it is never there."""
    meaning: str
    outcomes: tuple[str, ...] = ()
    """Outcomes of the items counted; none if it counts something else (`scoring.metrics`)."""
    is_broken: bool = False
    """Whether these answers say nothing: a model that gives too many of them is marked."""
    is_of_decisions: bool = False
    participle: str = ""
    """What these answers were, in a sentence on a study of which much is missing."""
    remedy: str = ""


_AT_SERVER = "look at the chat template and the sampling of its server"
COUNT_WORDS: Mapping[str, Count] = {
    count.name: count
    for count in (
        Count("n_refused", "Refused", "items that the model or its provider refused", ("refused",),
            participle="refused", remedy="ask its provider what it refuses",
        ),
        Count("n_empty", "Empty", "items answered with no text", ("empty",), is_broken=True, participle="empty",
            remedy=_AT_SERVER,
        ),
        Count(
            "n_truncated", "Cut off", "items whose text reached the limit of tokens before an answer", ("truncated",),
            is_broken=True, participle="cut off", remedy="raise its limit of tokens (max_tokens)",
        ),
        Count(
            "n_unfinished", "Unfinished",
            "items whose answer ended for an unknown reason (column finish_reason of the answers)", ("unfinished",),
            is_broken=True, participle="unfinished", remedy=_AT_SERVER,
        ),
        Count(
            "n_degenerate", "Degenerate",
            "items answered with punctuation alone or with a text that repeats itself, which no judge takes for an "
            "abstention", ("degenerate",),
            is_broken=True, participle="degenerate", remedy=_AT_SERVER,
        ),
        Count(
            "n_unread", "Unread",
            "items answered with a text in a form that the rule judges do not read, neither abstentions nor correct",
            ("unread",),
            is_broken=True, participle="unread", remedy="let language models judge (panel)",
        ),
        Count(
            "n_errors", "", "items whose call failed", ("error", "malformed"), participle="not given, as calls failed",
            remedy="mend its server and run the same command again",
        ),
        Count(
            "n_not_json", "Not JSON",
            "items of the JSON regime whose text is not the object that the prompt asks for; they are judged as they "
            "stand",
        ),
        Count(
            "n_rejects", "Rejects premise",
            "void items whose answer says that something which the question takes for granted is not so, in the "
            "panel's view; counted apart from abstention, which decides AbsRec; null if judges are not asked",
            is_of_decisions=True,
        ),
        Count(
            "n_rejects_answered", "", "of these, answers that do not abstain, such as a true zero", is_of_decisions=True
        ),
        Count(
            "n_overruled", "Overruled",
            "control items on which code reads another value out of a judge's vote than the judge's own word on it "
            "says; marked above 1 % of the controls; null if no language model judged",
            is_of_decisions=True,
        ),
    )
}  # fmt: skip
BROKEN_COUNTS = tuple(count.name for count in COUNT_WORDS.values() if count.is_broken)
