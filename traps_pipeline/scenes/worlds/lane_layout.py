"""Place two lanes in one picture: scenes side by side, each with its bench, boards, strip and doubles.

Camera, benches and boards are fitted to each other and to both worlds of each lane, in no order.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from traps_pipeline.scenes.physics.kit import Box, Vec3
from traps_pipeline.scenes.picture.camera import Camera, Occluder, WideCamera, fit_camera, fit_occluder
from traps_pipeline.scenes.worlds.lane_event import LaneEvent, middle_of
from traps_pipeline.scenes.worlds.shot import box_around
from traps_pipeline.scenes.worlds.timetable import WINDOW_S, Timetable

SIDES = (-1, 1)  # of the world's middle, on which the left and the right lane are
GAP_M = 0.14  # between the lanes
CLEAR_PX = 5.0  # between a lane's scene and its bench, in the picture
BENCH_M, BENCH_DEPTH_M = 0.04, 0.16  # thickness and least depth of a bench
BENCH_EDGE_M = 0.05  # that a board reaches beyond what it hides of a bench, on each side
STRIP_M, STRIP_GAP_M = 0.09, 0.05  # depth of a lane's strip, and what is behind it
CLEAR_M = 0.03  # between doubles, and around them
SLIDE_M = (0.06, 0.4)  # how far doubles slide that are behind the board from the start, at least and at most
ROUNDS = 24  # in which all is fitted to each other
DAMPING = 0.5  # or benches and camera would chase each other

Path = tuple[tuple[float, float], ...]  # along and above the bench's middle, in each frame (m)


@dataclass(frozen=True)
class Lane:
    """The drawn settings of a lane, one of two strips of the picture that each show an event.

    strip: its colour. bench_above: whether the bench is above the scene in the picture. bench_at: where it is along the
    lane, 0 to 1. mirrored: whether doubles come from the other side than what they are doubles of. rests_at: how far
    they get, 0 to 1. sets_out_s: when those set out that are behind the board from the start. size: of doubles, 1 for
    that of the things themselves. boards: widths of those before scene and bench, 1 for the least. timetable: of
    the board that comes and goes. window_s: for how long that shows the settled outcome, at least.
    """

    strip: str
    bench_above: bool
    bench_at: float
    mirrored: bool
    rests_at: float
    sets_out_s: float
    size: float
    boards: tuple[float, float]
    timetable: Timetable
    window_s: float = WINDOW_S


@dataclass(frozen=True)
class Layout:
    """The places of a lane's parts in the world.

    shift: of the family's own scene. bench: the middle of the bench's upper face. bench_half: across, and in depth.
    boards: before the scene, and before the bench. paths: of the middle of each double's foot.
    """

    shift: Vec3
    bench: Vec3
    bench_half: tuple[float, float]
    strip: Box
    boards: tuple[Occluder, Occluder]
    paths: tuple[Path, ...]

    @property
    def corners(self) -> np.ndarray:
        """Points (N, 3) that the camera must see: strip, boards, and bench up to the highest double."""
        (x, y, z), (across, deep) = self.bench, self.bench_half
        high = max(above for path in self.paths for _, above in path)
        bench = Box((x - across, y - deep, z - BENCH_M), (x + across, y + deep, z + high + CLEAR_M))
        return np.concatenate([part.corners() for part in (bench, self.strip, *self.boards)])


def fit_lanes(lanes: Sequence[Lane], worlds: Sequence[Sequence[LaneEvent]]) -> tuple[Camera, tuple[Layout, ...]]:
    """Return the nearest camera with both lanes in frame, and where everything stands.

    worlds: of each lane the event and its twin.
    """
    points = [np.concatenate([event.points for event in events]) for events in worlds]
    covers = [box_around([event.cover.corners() for event in events]).corners() for events in worlds]
    view = replace(worlds[0][0].scene.view, azimuth_deg=90.0)
    down = np.radians(-view.elevation_deg)
    moves = [min(events, key=lambda event: event.outcome.answer) for events in worlds]  # whichever of both is shown
    benches = [_first_bench(lane.bench_above, shown, down) for lane, shown in zip(lanes, points, strict=True)]
    half = max(float(np.ptp(shown[:, 0])) for shown in points) / 2 + GAP_M / 2
    layouts: list[Layout] = []
    while True:
        shifts = [(side * half - middle_of(p[:, 0]), 0.0, 0.0) for side, p in zip(SIDES, points, strict=True)]
        shown = [p + shift for p, shift in zip(points, shifts, strict=True)]
        everything = np.concatenate([*shown, *(layout.corners for layout in layouts[-2:])])
        camera = fit_camera(view, np.concatenate([everything, everything * (-1, 1, 1)]), WideCamera)
        for k, lane in enumerate(lanes):
            board = fit_occluder(camera, box_around([covers[k] + shifts[k]]))
            layouts.append(_layout(camera, lane, shown[k], board, shifts[k], benches[k], moves[k]))
            benches[k] = _moved_apart(camera, lane.bench_above, shown[k], layouts[-1], down)
        if len(layouts) == ROUNDS * len(SIDES):
            return camera, tuple(layouts[-2:])
        reach = [
            np.abs(layout.corners[:, 0] - side * half).max() for side, layout in zip(SIDES, layouts[-2:], strict=True)
        ]
        half = max(half, float(max(reach)) + GAP_M / 2)


def _first_bench(is_above: bool, shown: np.ndarray, down: float) -> tuple[float, float]:
    """Return a bench's depth and height: behind and over all that is shown, or in front of it."""
    if not is_above:
        return float(shown[:, 1].min()) - 0.5, BENCH_M
    back = float(shown[:, 1].max()) + BENCH_DEPTH_M
    top = float((shown[:, 2] * np.cos(down) + shown[:, 1] * np.sin(down)).max())
    return back, max(BENCH_M, (top - back * float(np.sin(down))) / float(np.cos(down)))


def _moved_apart(camera: Camera, is_above: bool, shown: np.ndarray, layout: Layout, down: float) -> tuple[float, float]:
    """Return a bench's place so that its board and the scene come apart in the picture."""
    scene = camera.project(np.concatenate([shown, layout.boards[0].corners()]))[:, 1]
    bench = camera.project(layout.boards[1].corners())[:, 1]
    _, y, z = layout.bench
    metres = DAMPING * camera.metres_a_pixel(np.array(layout.bench))
    if is_above:
        return y, max(BENCH_M, z + metres * float((bench.max() + CLEAR_PX - scene.min()) / np.cos(down)))
    return y - metres * float((scene.max() + CLEAR_PX - bench.min()) / np.sin(down)), z


def _layout(
    camera: Camera,
    lane: Lane,
    shown: np.ndarray,
    board: Occluder,
    shift: Vec3,
    bench: tuple[float, float],
    event: LaneEvent,
) -> Layout:
    """Return a lane's layout. Both boards have one size in the picture, so that each hides what is behind either."""
    (y, z), doubles = bench, event.doubles(lane.size)
    sizes = np.array([np.ptp(span, axis=0) for span in doubles.values()])
    deep = max(BENCH_DEPTH_M, float(sizes[:, 1].max()) + CLEAR_M)
    front = y - deep / 2 - board.half[1]
    place = np.array([board.centre[0], front, z + board.half[2]])
    scale = camera.metres_a_pixel(place) / camera.metres_a_pixel(np.array(board.centre))
    hides = float(sizes[:, 2].max()) + deep * float(np.tan(np.radians(-camera.elevation_deg))) + CLEAR_M
    width = float((sizes[:, 0] + CLEAR_M).sum()) + SLIDE_M[0]
    across, thick = max(board.half[0], (width / 2 + BENCH_EDGE_M) / scale), board.half[1]
    up = max(board.half[2], hides / 2 / scale)
    board = replace(board, half=(across, thick, up), centre=(*board.centre[:2], up))
    paths = _double_paths(lane, event, doubles, board, shift, scale)
    inner = across * scale - BENCH_EDGE_M
    ends = [(path[:, 0].min() - w / 2, path[:, 0].max() + w / 2) for path, w in zip(paths, sizes[:, 0], strict=True)]
    low, high = float(min(-inner, *(end[0] for end in ends))), float(max(inner, *(end[1] for end in ends)))
    left_m, right_m = float(shown[:, 0].min()), float(shown[:, 0].max())
    x = (left_m + right_m) / 2 + (lane.bench_at - 0.5) * max(0.0, right_m - left_m - (high - low))
    board_x = x - (low + high) / 2
    bench_board = Occluder((board_x, front, z + up * scale), (across * scale, thick, up * scale), board.yaw_deg)
    board, bench_board = (_wider(each, size) for each, size in zip((board, bench_board), lane.boards, strict=True))
    near = min(float(shown[:, 1].min()), board.centre[1] - thick, y - deep) - STRIP_GAP_M
    strip = Box((left_m, near - STRIP_M, 0.0), (right_m, near, 0.004))
    on_bench = [np.round(path - ((low + high) / 2, 0.0), 4).tolist() for path in paths]
    rows = tuple(tuple((along, above) for along, above in path) for path in on_bench)
    return Layout(shift, (x, y, z), ((high - low) / 2, deep / 2), strip, (board, bench_board), rows)


def _wider(board: Occluder, size: float) -> Occluder:
    """Return a wider board; a higher one would hide the flags of what the question names."""
    across, thick, up = board.half
    return replace(board, half=(size * across, thick, up))


def _double_paths(
    lane: Lane, event: LaneEvent, doubles: Mapping[str, np.ndarray], board: Occluder, shift: Vec3, scale: float
) -> list[np.ndarray]:
    """Return where doubles are, along the bench from its board's middle and above it, (F, 2) each.

    A double is before its board as long as what it is a double of, and comes as that does: along, or down from above.
    Behind the board its path is its own, so that it tells nothing of an outcome.
    """
    fps, frames, mirror = event.physics.fps, np.arange(event.physics.n_frames), -1 if lane.mirrored else 1
    inner, top, paths = board.half[0] * scale - BENCH_EDGE_M, 2 * board.half[2] * scale, list[np.ndarray]()
    total = sum(float(np.ptp(span[:, 0])) + CLEAR_M for span in doubles.values())
    used = -total / 2
    starts = [event.motion.pos(body)[0, 0] + shift[0] - board.centre[0] for body in doubles]
    are_facing = min(starts) < 0 < max(starts)
    for n, (body, span) in enumerate(doubles.items()):
        width, _, tall = (float(size) for size in np.ptp(span, axis=0))
        place = event.motion.pos(body) + np.array(shift) + (middle_of(span[:, 0]), 0.0, span[:, 2].min())
        along, above = (place[:, 0] - board.centre[0]) * scale * mirror, np.clip(place[:, 2] * scale, 0.0, top + tall)
        room, path = max(0.0, inner - width / 2), np.zeros((len(frames), 2))
        is_over = above + tall > top
        if abs(along[0]) > room + CLEAR_M:  # it comes along
            first = int((np.abs(along) <= room).argmax())
            speed = max(abs(along[first] - along[first - 1]), 0.004)
            far, side = 2 * room * (0.2 + 0.6 * lane.rests_at) - n * (width + CLEAR_M), float(np.sign(along[0]))
            if are_facing:  # they come to lie beside each other, and none passes through another
                far = side * (along[first] - room * (lane.rests_at - 0.5)) - (width + CLEAR_M) / 2
            path[:, 0] = np.where(frames < first, along, along[first] - side * _slowing(frames - first, far, speed))
        elif is_over[0]:  # it comes down
            first = int((~is_over).argmax())
            fallen = (above[first - 1] - above[first]) * (frames - first) + 4.9 * ((frames - first) / fps) ** 2
            path[:, 0] = along[0]
            path[:, 1] = np.where(frames < first, above, np.maximum(above[first] - fallen, 0.0))
        else:
            far = min(SLIDE_M[1], max(0.0, inner - total / 2)) * (0.4 + 0.6 * lane.rests_at)
            slide = _slowing(frames - round(lane.sets_out_s * fps), far, far / 5)
            path[:, 0] = mirror * (used + (width + CLEAR_M) / 2 - far / 2 + slide)
        used += width + CLEAR_M
        paths.append(path)
    return paths


def _slowing(frames: np.ndarray, far: float, speed: float) -> np.ndarray:
    """Return how far a thing has come, in frames from when it sets out, that slows down from a speed to rest."""
    far = max(far, CLEAR_M)
    return far * (1 - np.exp(-np.maximum(frames, 0) * speed / far))
