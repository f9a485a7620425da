"""What a benchmark can be passed by, other than by seeing: measured on its records, and on a study of its arms.

From the records (two frames of each are drawn, about three minutes on two cores): how many controls the family's own
observer answers from the last shown frame alone, and how many nobody can, since an occluder hides the outcome there
(certificate `closing`); what of a void's pixels over which anything moves its occluder covers, and whether all that the
question names shows there (certificate `referents`); when outcomes settle, and until when they are in view; how many
records of a family have a neighbour whose first frame looks like theirs; how far each seesaw turns; how well the state
at the cut predicts the outcome of a chaotic record, beside always saying the commonest outcome. With --observer also
what the observer reads of each whole control, encoded and decoded (eight minutes more). From a study of `traps run
arms`: PECS, figures of two events, and inference of the shortcut rules and of the observer.
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

os.environ.setdefault("MUJOCO_GL", "osmesa")

import mujoco
import numpy as np
import pandas as pd

from bench.quick import parse
from traps_pipeline.base.paths import RELEASED
from traps_pipeline.benchmark.outcome_leakage import outcome_leakage
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.scenes.certification.certificates import CLOSING, REFERENTS, Certificate, stored_evidence
from traps_pipeline.scenes.certification.certify_record import state_at_cut
from traps_pipeline.scenes.certification.evidence import Claim
from traps_pipeline.scenes.draw.likeness import NEAR_BITS, perceptual_hash
from traps_pipeline.scenes.observe import observe
from traps_pipeline.scenes.picture.checks import closing_frames
from traps_pipeline.scenes.worlds.spec import SceneSpec, load_trajectory
from traps_pipeline.scenes.worlds.world import World
from traps_pipeline.scoring.score_rows import LEADERBOARD, TWO_WAY
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.video.encode import encode

STEP = 2  # every second frame is shown: 5 of 10 a second
TURN_DEG = 10.0
SETTLED = 0.3, 0.8  # wanted: outcomes settle between these shares of the clip


@dataclass(frozen=True)
class Measured:
    """What is measured of one record. settled, in_view_until: shares of the clip."""

    scenario_id: str
    family: str
    taxonomy: str
    truth: str
    settled: float
    in_view_until: float
    hidden_at_end: bool
    last_frame_answer: str | None
    looks: int
    turned_deg: float | None
    at_cut: np.ndarray | None
    covers: float | None
    referents: bool | None
    whole_clip_answer: str | None = None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--per-family", type=int, help="the first so many records of each family; default: all")
    parser.add_argument("--specs", type=Path, default=RELEASED, help="folder of the released records")
    parser.add_argument("--workspace", type=Path, help="a study that asked the arms; without one they are not reported")
    parser.add_argument("--observer", action="store_true", help="let the observer read each whole control, too")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    arguments = parse(parser, per_family=1, workers=1)
    chosen = first_of_each(load_released(arguments.specs), arguments.per_family)
    with ProcessPoolExecutor(arguments.workers, mp_context=get_context("spawn")) as pool:
        found = list(pool.map(partial(measure, folder=arguments.specs, whole=arguments.observer), chosen, chunksize=4))
    print(f"{len(found)} records of {len({one.family for one in found})} families")
    print_last_frame(found)
    if arguments.observer:
        print_observer(found)
    print_hidden(found)
    print_voids(found)
    print_times(found)
    print_looks(found)
    print_seesaws(found)
    print_states(found)
    if arguments.workspace is None:
        print("\nArms: not run; name a study of assets/experiments/arms.yaml with --workspace")
    else:
        print_rules(Workspace.open(arguments.workspace))


def first_of_each(specs: dict[str, SceneSpec], most: int | None) -> list[SceneSpec]:
    """Return the records, at most so many of each family."""
    frame = pd.DataFrame({"id": list(specs), "family": [spec.family for spec in specs.values()]})
    ids = frame["id"] if most is None else frame.groupby("family")["id"].head(most)
    return [specs[scenario_id] for scenario_id in ids]


def measure(spec: SceneSpec, folder: Path, whole: bool = False) -> Measured:
    """Draw the first frame and the last shown one, of which the observer sees a still clip; read the trajectory. whole:
    show the observer the whole control, too."""
    qpos = load_trajectory(folder / "trajectories" / f"{spec.scenario_id}.npz", spec.trajectory_sha256)
    world = World.of_record(spec, qpos)
    shown = range(0, len(qpos), STEP)
    with world.closed_renderer() as renderer:
        (first,) = renderer.frames(qpos[:1])
        (last,) = renderer.frames(qpos[[shown[-1]]], occluder=world.open_frames <= shown[-1])
    see = world.family.observe
    answer = see(np.stack([last] * len(shown)), spec.question) if see is not None else None
    return Measured(
        scenario_id=spec.scenario_id,
        family=spec.family,
        taxonomy=spec.taxonomy,
        truth=spec.ground_truth,
        settled=spec.evidence["commit_s"] * world.physics.fps / len(qpos),
        in_view_until=world.open_frames / len(qpos),
        hidden_at_end=spec.control is not None and given(CLOSING, spec),
        last_frame_answer=answer,
        looks=perceptual_hash(first),
        turned_deg=turned_deg(world.model, qpos) if spec.family == "seesaw_sorter" else None,
        at_cut=state_at_cut(qpos, spec.void["cut_frame"]) if spec.void_kind == "truncation" else None,
        covers=spec.evidence.get("panel_covers"),
        referents=given(REFERENTS, spec) if spec.void_kind == "occluder" else None,
        whole_clip_answer=read_whole(world, spec, qpos) if whole else None,
    )


def given(certificate: Certificate, spec: SceneSpec) -> bool:
    """Return whether the record's own evidence carries a certificate; `traps benchmark certify` measures it again."""
    return certificate.failure(stored_evidence(spec), Claim.of_record(spec)) is None


def read_whole(world: World, spec: SceneSpec, qpos: np.ndarray) -> str | None:
    """Return what the observer answers from the control's clip, as a model is shown it."""
    with world.closed_renderer() as renderer, TemporaryDirectory() as folder:
        clip = Path(folder) / "control.mp4"
        encode(list(closing_frames(renderer, qpos, world.board)), clip, world.physics.fps)
        return observe(clip, spec.question)


def turned_deg(model: mujoco.MjModel, qpos: np.ndarray) -> float:
    """Return how far the hinge that turns most turns between its extremes."""
    hinges = model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE]
    return math.degrees(float(np.ptp(qpos[:, hinges], axis=0).max()))


def by_family(found: Sequence[Measured]) -> dict[str, list[Measured]]:
    families: dict[str, list[Measured]] = {}
    for one in found:
        families.setdefault(one.family, []).append(one)
    return families


def print_last_frame(found: Sequence[Measured]) -> None:
    print("\nControls answered rightly from the last shown frame alone (right, answered at all, of)")
    rows = {
        family: (sum(one.last_frame_answer == one.truth for one in ones), answered(ones), len(ones))
        for family, ones in by_family(found).items()
    }
    for family, (right, any_answer, n) in sorted(rows.items(), key=lambda row: row[1][0] / row[1][2]):
        print(f"  {family:20} {right / n:6.3f} {any_answer / n:6.3f} {n:4d}")
    right, any_answer, n = np.sum(list(rows.values()), axis=0)
    print(f"  {'all':20} {right / n:6.3f} {any_answer / n:6.3f} {n:4d}")


def print_observer(found: Sequence[Measured]) -> None:
    """The ceiling of what classical vision reads; a control that it reads wrongly is named."""
    print("\nControls answered rightly from the whole clip (right, answered at all, of)")
    for name, ones in [*by_taxonomy(found).items(), ("all", found)]:
        right = np.mean([one.whole_clip_answer == one.truth for one in ones])
        some = np.mean([one.whole_clip_answer is not None for one in ones])
        print(f"  {name:20} {right:6.3f} {some:6.3f} {len(ones):4d}")
    wrong = [one for one in found if one.whole_clip_answer != one.truth]
    print("  not right:", ", ".join(f"{one.scenario_id} ({one.whole_clip_answer})" for one in wrong) or "none")


def print_voids(found: Sequence[Measured]) -> None:
    covers = [one.covers for one in found if one.covers is not None]
    shown = [one.referents for one in found if one.referents is not None]
    if covers:
        spread = " ".join(f"{value:5.2f}" for value in np.quantile(covers, (0, 0.25, 0.5, 0.75, 1)))
        print(
            f"\nPixels over which anything moves that the occluder covers, as shares (least, quartiles, most): {spread}"
        )
        print(f"Voids in which all that the question names shows, or was seen moving: {sum(shown)} of {len(shown)}")


def print_hidden(found: Sequence[Measured]) -> None:
    """How clever a reader is does not matter here: two worlds with different answers end in the same frames."""
    print("\nControls that nobody can answer from the last shown frame: certified hidden there (share, of)")
    for name, ones in [*by_family(found).items(), *by_taxonomy(found).items(), ("all", found)]:
        print(f"  {name:20} {np.mean([one.hidden_at_end for one in ones]):6.3f} {len(ones):4d}")


def print_times(found: Sequence[Measured]) -> None:
    low, high = SETTLED
    print(f"\nTimes as shares of the clip (least, quartiles, most; share from {low:g} to {high:g})")
    for name, ones in [*by_taxonomy(found).items(), ("all", found)]:
        for what in ("settled", "in_view_until"):
            times = np.array([getattr(one, what) for one in ones])
            spread = " ".join(f"{value:5.2f}" for value in np.quantile(times, (0, 0.25, 0.5, 0.75, 1)))
            within = np.mean((times >= low - 1e-9) & (times <= high + 1e-9))
            print(f"  {name:10} {what:14} {spread}  {within:6.3f}")


def by_taxonomy(found: Sequence[Measured]) -> dict[str, list[Measured]]:
    return {name: [one for one in found if one.taxonomy == name] for name in ("occlusion", "chaotic")}


def answered(ones: Sequence[Measured]) -> int:
    return sum(one.last_frame_answer is not None for one in ones)


def print_looks(found: Sequence[Measured]) -> None:
    print(
        f"\nRecords whose first frame has a neighbour within {NEAR_BITS} of 64 bits in the family (share, median, of)"
    )
    for family, ones in sorted(by_family(found).items()):
        if len(ones) > 1:
            nearest = np.array([min((a.looks ^ b.looks).bit_count() for b in ones if b is not a) for a in ones])
            print(f"  {family:20} {(nearest <= NEAR_BITS).mean():6.3f} {np.median(nearest):6.1f} {len(ones):4d}")


def print_seesaws(found: Sequence[Measured]) -> None:
    turns = np.array([one.turned_deg for one in found if one.turned_deg is not None])
    if len(turns):
        moved = int((turns >= TURN_DEG).sum())
        print(f"\nSeesaws that turn by at least {TURN_DEG:g} degrees: {moved} of {len(turns)}")
        print(f"  degrees: least {turns.min():.1f}, median {np.median(turns):.1f}, most {turns.max():.1f}")


def print_states(found: Sequence[Measured]) -> None:
    print("\nOutcome predicted from the state at the cut (best of two readers, commonest outcome, difference, of)")
    for family, ones in sorted(by_family(found).items()):
        states = [one.at_cut for one in ones if one.at_cut is not None]
        told = outcome_leakage(states, [one.truth for one in ones]) if states else None
        if told is not None:
            print(f"  {family:20} {told.best:6.3f} {told.prior:6.3f} {told.gain:+6.3f} {len(ones):4d}")


def print_rules(workspace: Workspace) -> None:
    board = workspace.tables.read(LEADERBOARD, {}).query("dataset == 'overall'")
    both = board.merge(workspace.tables.read(TWO_WAY, {}), on=["model", "regime"], suffixes=("", "_lanes")).sort_values(
        "model"
    )
    figures = ("pecs", "conjunction", "specificity", "inference_acc")
    print(f"\n{', '.join(figures)}")
    for row in both.to_dict("records"):
        print(f"  {row['model']:20} {row['regime']:9}", *(f"{row[name]:6.3f}" for name in figures))


if __name__ == "__main__":
    main()
