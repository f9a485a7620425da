"""Draw scenarios of two events: two draws of a family that differ in nothing but shape, place and outcome."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from traps_pipeline.scenes.certification.lane_certificates import certify_lanes, decisive_pixels, double_pixels
from traps_pipeline.scenes.draw.resolve import plain
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.parts.look import Look, draw_look
from traps_pipeline.scenes.physics.kit import COLOURS, LOOK_ALIKE, Family, Physics, Wording, params_to_dict, uniform
from traps_pipeline.scenes.worlds.lane_records import DRAWN, LaneRecord, LaneTwin, TwoEventsSpec, layout_record
from traps_pipeline.scenes.worlds.lanes import Event, Lane, TwoLanes, fit_lanes
from traps_pipeline.scenes.worlds.outcome import Rejected
from traps_pipeline.scenes.worlds.spec import physics_record, trajectory_digest
from traps_pipeline.scenes.worlds.timetable import draw_timetable

LOOKS = ("pale-floor", "light")  # parts of the look that vary
STRIPS = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")
SETTLES_S = (0.5, 3.6)  # when both worlds of a lane have settled
ELEVATION_DEG = (-40.0, -22.0)  # of the camera: a bench below the scene needs it to look down
ALIKE = (0.8, 1.25)  # size of doubles, as a share of that at which they have as many pixels as the things
SIZES = (0.6, 1.2)  # least and most, as a share of the things' own
EVENTS = 30  # draws of a lane's event before a scenario is given up
TRIES = 60  # draws of a scenario

# Families without lanes, and why.
LEFT_OUT: Mapping[str, str] = {
    "hidden_race": "it asks which came first, which no settled outcome shows",
    "ramp_race": "it asks which came first, which no settled outcome shows",
}


@dataclass(frozen=True)
class Drawn:
    """A record and the trajectories of its worlds: itself, and with the left or right lane's twin."""

    spec: TwoEventsSpec
    worlds: Mapping[str, np.ndarray]


def draw_two_events(family_name: str, number: int, seed: int) -> Iterator[Drawn | Rejected]:
    """Yield why draws are rejected, and at last the scenario, if there is one."""
    family = get_family(family_name)
    for attempt in range(TRIES):
        rng = np.random.default_rng([seed, *family_name.encode(), number, attempt])
        try:
            yield _scenario(family, f"{family_name}-e{number:03d}", rng, seed)
        except Rejected as failure:
            yield failure
        else:
            return


def _scenario(family: Family, scenario_id: str, rng: np.random.Generator, seed: int) -> Drawn:
    physics = family.physics
    first = _event(family, physics, rng, None)
    second = _event(family, physics, rng, first[0].params)
    pairs = [first, second] if rng.integers(2) else [second, first]
    word_seed = int(rng.integers(2**31))
    wordings = [family.word(event.params, np.random.default_rng(word_seed)) for event, _ in pairs]
    if wordings[0].question != wordings[1].question or wordings[0].labels != wordings[1].labels:
        raise Rejected("the lanes have no question in common")
    strips = _strips(wordings[0], [event.scene.inventory.colours for pair in pairs for event in pair], rng)
    lanes = [_lane(pair, strip, rng) for pair, strip in zip(pairs, strips, strict=True)]
    look = draw_look(rng, LOOKS)
    assert look is not None
    lanes = _alike(lanes, pairs, rng, look)
    camera, layouts = fit_lanes(lanes, pairs)
    world = TwoLanes((lanes[0], lanes[1]), (pairs[0][0], pairs[1][0]), camera, layouts, look)
    twins = [world.with_event(k, pair[1]) for k, pair in enumerate(pairs)]
    evidence = certify_lanes(world, twins)
    records = [
        LaneRecord(
            params=plain(params_to_dict(lane.params)),
            **{name: getattr(lane, name) for name in DRAWN},
            spans=list(lane.timetable.spans),
            layout=plain(layout_record(layout)),
            ground_truth=world.outcome(k).answer,
            twin=LaneTwin(
                params=plain(params_to_dict(twin.events[k].params)),
                ground_truth=twin.outcome(k).answer,
                trajectory_sha256=trajectory_digest(twin.qpos),
            ),
        )
        for k, (lane, layout, twin) in enumerate(zip(lanes, layouts, twins, strict=True))
    ]
    spec = TwoEventsSpec(
        scenario_id=scenario_id,
        category=family.category,
        family=family.name,
        seed=seed,
        physics=physics_record(physics),
        camera=plain(asdict(camera)),
        look=plain(asdict(look)),
        lanes=records,
        question=wordings[0].question,
        labels=list(wordings[0].labels),
        aliases=dict(wordings[0].aliases),
        answer_type=family.answer_type,
        trajectory_sha256=trajectory_digest(world.qpos),
        evidence=plain(evidence),
    )
    return Drawn(spec, {"qpos": world.qpos, "left": twins[0].qpos, "right": twins[1].qpos})


def _alike(lanes: list[Lane], pairs: list[tuple[Event, Event]], rng: np.random.Generator, look: Look) -> list[Lane]:
    """Return the lanes with doubles of about the size in the picture that the things have in the end.

    The size is that of the mean of both worlds, so that it tells nothing of the outcome.
    """
    camera, layouts = fit_lanes(lanes, pairs)
    events = zip(*pairs, strict=True)
    worlds = [TwoLanes((lanes[0], lanes[1]), (left, right), camera, layouts, look) for left, right in events]
    wanted = [np.mean([decisive_pixels(world, k) for world in worlds]) for k in range(len(lanes))]
    shown = [double_pixels(worlds[0], k) for k in range(len(lanes))]
    sizes = [float(np.sqrt(w / max(s, 1.0)) * rng.uniform(*ALIKE)) for w, s in zip(wanted, shown, strict=True)]
    return [replace(lane, size=round(float(np.clip(s, *SIZES)), 3)) for lane, s in zip(lanes, sizes, strict=True)]


def _event(family: Family, physics: Physics, rng: np.random.Generator, like: Any) -> tuple[Event, Event]:
    """Return an event and its twin; like: the other lane's parameters, whose colours and view it takes."""
    assert family.twins is not None, f"{family.name}: an occlusion family needs twins"
    for _ in range(EVENTS):
        params = replace(family.draw(rng), azimuth_deg=90.0)
        elevation = float(np.clip(params.elevation_deg, *ELEVATION_DEG))
        params = replace(params, elevation_deg=elevation if like is None else like.elevation_deg)
        if like is not None:
            params = replace(
                params, **{m.name: value for m in fields(like) if _is_colour(value := getattr(like, m.name))}
            )
        event = Event(family, params, physics)
        twins = [Event(family, twin, physics) for twin in family.twins(params)]
        try:
            if not _settles(event):
                continue
            others = [twin for twin in twins if _settles(twin) and twin.outcome.label != event.outcome.label]
        except Rejected:
            continue
        if others:
            return event, others[int(rng.integers(len(others)))]
    raise Rejected("no draw settles in time, with a twin that ends otherwise")


def _settles(event: Event) -> bool:
    early, late = (round(second * event.physics.fps) for second in SETTLES_S)
    return event.outcome.label is not None and early <= event.outcome.commit_frame <= late


def _is_colour(value: Any) -> bool:
    values = value if isinstance(value, tuple) else (value,)
    return bool(values) and all(isinstance(name, str) and name in COLOURS for name in values)


def _strips(wording: Wording, in_view: list[tuple[str, ...]], rng: np.random.Generator) -> list[str]:
    """Return two colours of strips that no thing has, or, where there are too few, that the question does not name."""
    taken = {colour for colours in in_view for colour in colours}
    named = {name for name in STRIPS if name in wording.question.lower().replace(",", " ").replace("?", " ").split()}
    for avoided in (taken | named, named):
        free = [str(name) for name in rng.permutation([name for name in STRIPS if name not in avoided])]
        pairs = [[a, b] for a in free for b in free if a != b and {a, b} not in LOOK_ALIKE]
        if pairs:
            return pairs[0]
    raise Rejected("no two colours are left for the strips")


def _lane(pair: tuple[Event, Event], strip: str, rng: np.random.Generator) -> Lane:
    event, twin = pair
    physics, settled = event.physics, max(event.outcome.commit_frame, twin.outcome.commit_frame)
    timetable = draw_timetable(rng, settled, physics.n_frames, physics.fps)
    if timetable is None:
        raise Rejected("no timetable shows the settled outcome")
    return Lane(
        params=event.params,
        strip=strip,
        bench_above=bool(rng.integers(2)),
        bench_at=uniform(rng, 0, 1),
        mirrored=bool(rng.integers(2)),
        rests_at=uniform(rng, 0, 1),
        sets_out_s=uniform(rng, 0, 2.5),
        size=1.0,
        timetable=timetable,
    )
