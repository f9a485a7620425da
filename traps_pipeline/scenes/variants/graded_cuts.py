"""Cut controls where the commonest answer has a set probability (graded cuts).

The void of a pair is cut where nobody can know, an arm where everybody should. Here the cuts of a family spread over
all that is between, and the certificate is the distribution over answers itself.
"""

from collections import Counter
from typing import Any

from traps_pipeline.base.digests import digest
from traps_pipeline.protocol.datasets import GRADED
from traps_pipeline.scenes.certification.certificates import earliest_cut, futures_of
from traps_pipeline.scenes.certification.ensemble import READ_OVER_S, UNSEEN_PX
from traps_pipeline.scenes.picture import checks
from traps_pipeline.scenes.variants.arms import Arm, Scenario, Take, questions_to_answer
from traps_pipeline.scenes.worlds.outcome import Rejected
from traps_pipeline.scenes.worlds.spec import SceneSpec
from traps_pipeline.scenes.worlds.world import World

MIN_PROBABILITY = 0.4  # the probability of the commonest answer that is wanted is spread evenly from here to 1
SEARCH_FUTURES = 16  # futures by which a cut is sought
FUTURES = 72  # others, from which probabilities are measured at the cut: none is chosen by its own noise
BEYOND_S = 2.0  # after the clip, in which what is undecided at its end may settle
MIN_DECIDED = 0.9  # the share of these that must end in an answer
_GOLDEN = (5**0.5 - 1) / 2  # multiples of it, modulo 1, fill [0, 1) evenly however many there are


def target_probability(spec: SceneSpec) -> float:
    """Return the commonest answer's probability at which a scenario is to be cut."""
    number = int(spec.scenario_id.rpartition("-")[2])
    start = int(digest(spec.family)[:13], 16) / 16**13  # or the first scenarios of all families would want the same
    return MIN_PROBABILITY + (1 - MIN_PROBABILITY) * ((start + number * _GOLDEN) % 1)


def probabilities(counts: Counter[str | None]) -> dict[str, float]:
    """Return by answer its share among decided futures, the commonest first."""
    answers = {label: n for label, n in counts.most_common() if label is not None}
    return {label: n / sum(answers.values()) for label, n in answers.items()}


def graded_cut(spec: SceneSpec, control: World) -> tuple[int, dict[str, Any]]:
    """Return the frame and evidence of the cut nearest to the target probability. Raises Rejected.

    A cut ends with a frame that 5 frames a second show, not after the outcome is settled. The later it is, the more
    futures agree, so it is sought by halving.
    """
    if not control.same_physics:
        raise Rejected("simulating here does not give the frozen trajectory, so that its futures are not known")
    fps = control.physics.fps
    extra_frames = round(BEYOND_S * fps)
    futures, step = futures_of(control, spec.seed), fps // checks.SAMPLED_FPS
    commit, shares = control.outcome.commit_frame, dict[int, float]()
    cuts = [frame for frame in range(earliest_cut(control.physics), commit + 1) if (frame - 1) % step == 0]
    if not cuts:
        raise Rejected(f"the outcome is settled at {commit / fps:.1f} s, before the earliest cut")
    while cuts:
        middle = cuts[len(cuts) // 2]
        shares[middle] = max(
            probabilities(futures.after(middle, SEARCH_FUTURES, beyond=extra_frames)).values(), default=0.0
        )
        is_early = shares[middle] < target_probability(spec)
        cuts = [frame for frame in cuts if (frame > middle if is_early else frame < middle)]
    frame = min(shares, key=lambda cut: (abs(shares[cut] - target_probability(spec)), cut))
    counts = futures.after(frame, FUTURES, beyond=extra_frames)
    n_decided = FUTURES - counts[None]
    if n_decided < MIN_DECIDED * FUTURES:
        raise Rejected(f"{n_decided} of {FUTURES} futures end in an answer, {MIN_DECIDED:.0%} are wanted")
    evidence = {"cut_s": frame / fps, "settled_s": commit / fps, "wanted": target_probability(spec), "futures": FUTURES}
    return frame, evidence | {"decided": n_decided, "posterior": probabilities(counts)}


def _film(scenario: Scenario) -> Take:
    frame, evidence = graded_cut(scenario.spec, scenario.control)
    with scenario.control.renderer() as renderer:
        return Take(list(renderer.frames(scenario.control.qpos[:frame])), evidence)


GRADED_CUT = Arm(
    GRADED,
    "one threshold serves every cut",
    f"of {FUTURES} states at the cut that no viewer tells apart (places differ by {UNSEEN_PX} px, speeds by what that "
    f"is over {READ_OVER_S} s, one standard deviation) at least {MIN_DECIDED:.0%} end in an answer within {BEYOND_S:g} "
    "s after the clip; their shares are the answers' probabilities",
    questions_to_answer,
    _film,
)
