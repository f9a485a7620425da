"""Define certificates: numbers measured on a pair, and a rule that judges them.

Measuring needs the pair. Judging is a pure function of numbers and of what the record claims, so that fresh evidence
and stored evidence are judged alike.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from traps_pipeline.scenes.certification.ensemble import Futures
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.physics.kit import Family, Physics
from traps_pipeline.scenes.worlds.outcome import Rejected
from traps_pipeline.scenes.worlds.spec import SceneSpec
from traps_pipeline.scenes.worlds.world import World

Evidence = Mapping[str, Any]
VoidKind = Literal["occluder", "truncation"]
About = Literal["control", "void", "twin", "worlds", "words"]
Failures = Iterator[str]  # the failures, in words


@dataclass(frozen=True)
class Claim:
    """A record's statements about its pair, against which its evidence is judged besides thresholds.

    end_s: time of the control's last frame. labels: how many answers the question offers. seed: what is drawn of the
    pair follows from it.
    """

    family: Family
    end_s: float
    labels: int
    answer: str | None
    twin_answer: str | None = None
    question: str = ""
    ill_posed_question: str = ""
    seed: int = 0

    @staticmethod
    def of_record(spec: SceneSpec) -> Claim:
        """Return the claim of a record, to be proved by its certificates."""
        physics = Physics(**spec.physics)
        return Claim(
            family=get_family(spec.family),
            end_s=(physics.n_frames - 1) / physics.fps,
            labels=len(spec.labels),
            answer=spec.ground_truth,
            twin_answer=spec.twin.ground_truth,
            question=spec.question,
            ill_posed_question=spec.ill_posed_question,
            seed=spec.seed,
        )


@dataclass(frozen=True, eq=False)
class Pair:
    """A pair to certify; in a draw, void and twin are missing until they are chosen.

    futures: those of perturbed starts of the control. void_frame: the first frame that shows nothing decisive, the
    first hidden frame, or the cut. rollout: which of the futures the twin is (chaotic).
    """

    control: World
    claim: Claim
    futures: Futures
    void_frame: int | None = None
    twin: World | None = None
    rollout: int | None = None

    @property
    def void_from(self) -> int:
        """The index of the frame `void_frame`. Raises Rejected while there is no void."""
        if self.void_frame is None:
            raise Rejected("the pair has no void")
        return self.void_frame

    @property
    def other_world(self) -> World:
        """The world of the twin. Raises Rejected while there is none."""
        if self.twin is None:
            raise Rejected("the pair has no twin")
        return self.twin

    @property
    def exchanged(self) -> Pair:
        """The pair with control and twin exchanged. Raises Rejected without a twin."""
        claim = replace(self.claim, answer=self.claim.twin_answer, twin_answer=self.claim.answer)
        return replace(self, control=self.other_world, twin=self.control, claim=claim)


@dataclass(frozen=True)
class Number:
    """A piece of evidence, rounded to `decimals` and, if `kept`, stored in the record.

    compared: measured again it must equal what is stored, which another OpenGL may draw otherwise. of_futures: it
    depends on the last bit of arithmetic, so it is compared only where that is the record's.
    """

    name: str
    decimals: int | None = None
    kept: bool = True
    compared: bool = True
    of_futures: bool = False

    def stored(self, value: Any) -> Any:
        """Return the value as a record stores it."""
        return value if self.decimals is None else round(value, self.decimals)

    def is_stored(self, value: Any, stored: Any, *, exact: bool) -> bool:
        """Return whether a value is the stored one, within a last digit if not exact."""
        if exact or self.decimals is None:
            return self.stored(value) == stored
        return abs(self.stored(value) - stored) < 1.5 * 10**-self.decimals


@dataclass(frozen=True)
class Certificate:
    """A statement about a pair that measurements prove: evidence, threshold and sentence.

    about: what must be there to measure it; words come last, after a draw has its place in its family.
    measure(pair): all its `numbers`. judge(evidence, claim): what is wrong with the evidence, gravest first; a number
    that records do not keep may be missing, and is then not judged (it was when the record was drawn, and is by
    `certify`).
    promises, does_not_promise: for the table in `docs/scenes.md`. kinds: the kinds of void that it is for.
    """

    name: str
    about: About
    promises: str
    does_not_promise: str
    numbers: tuple[Number, ...]
    measure: Callable[[Pair], Evidence]
    judge: Callable[[Evidence, Claim], Failures]
    kinds: tuple[VoidKind, ...] = ("occluder", "truncation")

    def measured(self, pair: Pair) -> Evidence:
        """Return the evidence of a pair. Raises Rejected if it has none."""
        evidence = self.measure(pair)
        if list(evidence) != [number.name for number in self.numbers]:
            raise TypeError(f"certificate {self.name}: measures {list(evidence)}, not what its `numbers` say")
        return evidence

    def failure(self, evidence: Evidence, claim: Claim) -> str | None:
        """Return in words why evidence does not earn the certificate, None if it does."""
        try:
            return next(self.judge(evidence, claim), None)
        except KeyError as missing:
            return f"no evidence {missing}"

    def contradiction(self, evidence: Evidence, stored: Evidence, *, exact: bool) -> str | None:
        """Return in words how new evidence contradicts the stored evidence; None if it does not.

        exact: this machine's arithmetic is that of the one which stored it, so that not even the last digit may differ.
        """
        for number in self.numbers:
            if not (number.kept and number.compared and number.name in evidence):
                continue
            if number.of_futures and not exact:
                continue
            if number.name not in stored:
                return f"the record has no evidence {number.name!r}"
            if not number.is_stored(evidence[number.name], stored[number.name], exact=exact):
                return f"{number.name} is {evidence[number.name]}, the record says {stored[number.name]}"
        return None

    def kept(self, evidence: Evidence) -> dict[str, Any]:
        """Return the part of the evidence that a record stores."""
        return {n.name: n.stored(evidence[n.name]) for n in self.numbers if n.kept and n.name in evidence}


def require_certificates(certificates: Iterable[Certificate], pair: Pair, evidence_so_far: Evidence) -> dict[str, Any]:
    """Return evidence extended by some certificates. Raises Rejected if one fails."""
    evidence = dict(evidence_so_far)
    for certificate in certificates:
        evidence |= certificate.measured(pair)
        failure = certificate.failure(evidence, pair.claim)
        if failure is not None:
            raise Rejected(failure)
    return evidence
