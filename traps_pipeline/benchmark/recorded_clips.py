"""Make the clips of a recorded pair (control, void by cut, cover or another clip, and twin), and find them again."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from traps_pipeline.base.digests import digest, file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_bytes
from traps_pipeline.benchmark.footage import FPS, Footage, UnusableFootage, read_footage
from traps_pipeline.benchmark.recorded_pairs import Board, RecordedPair
from traps_pipeline.protocol.two_events import CLIPS as LANE_CLIPS
from traps_pipeline.scenes.worlds.clip_notes import clip_note_path, read_clip
from traps_pipeline.video.encode import DamagedClip

FALL_S = 0.5  # in which a board comes, gaining speed evenly; the released boards fall for 0.39 to 0.61 s
EDGE_SHARE, EDGE_TONE = 0.04, 1.3  # of its height: its upper side, as a camera a little above sees it
BOARD_TONE = 0.86  # of its colour under the simulator's light


@dataclass(frozen=True)
class RecordedClips:
    """The frames (H, W, 3) of a recorded scenario's clips by side, how the void hides, evidence and remarks."""

    clips: dict[str, list[np.ndarray]]
    void: dict[str, Any]
    evidence: dict[str, Any]
    notes: list[str] = field(default_factory=list)


def make_clips(pair: RecordedPair, folder: Path) -> RecordedClips:
    """Return a recorded pair's clips, cut from its videos. Raises UnusableFootage naming a clip that cannot be made."""
    files = {side: name for side in ("control", "void", "twin") if (name := getattr(pair, side)) is not None}
    footage, originals, notes = dict[str, Footage](), dict[str, str](), list[str]()
    for side, name in files.items():
        try:
            path = video_path(folder, name)
            footage[side] = read_footage(path) if side == "void" else read_footage(path, pair.start_s, pair.end_s)
            originals[side] = file_digest(path)
        except UnusableFootage as error:
            raise UnusableFootage(f"{side} {name}: {error}") from error
        notes += [f"{side} {name}: {note}" for note in footage[side].notes]
    control, sides = footage["control"], {side: each.frames for side, each in footage.items()}
    evidence: dict[str, Any] = {"source": pair.source, "licence": pair.licence, "originals": originals}
    if pair.control_cover:
        evidence["control_cover"] = [_box(board, control) for board in pair.control_cover]
    if pair.void is not None:
        _require_alike(sides["control"], sides["void"], "void")
        hiding: dict[str, Any] = {"hidden_from_frame": 0}
    elif pair.cut_s is not None:
        cut = round((pair.cut_s - pair.start_s) * FPS)
        if not FPS // 2 <= cut <= len(control.frames) - FPS // 2:
            raise UnusableFootage(
                f"cut_s: leaves {cut / FPS:.1f} of {len(control.frames) / FPS:.1f} s; cut half a second or more from "
                "its ends"
            )
        sides["void"], hiding = control.frames[:cut], {"cut_frame": cut}
    elif pair.two_events:
        boards = {True: [[board] for board in pair.cover], False: [[board] for board in pair.control_cover] or [[], []]}
        for name, hidden in LANE_CLIPS.items():
            sides[name] = _covered(control, pair, [*boards[hidden[0]][0], *boards[hidden[1]][1]])
        del sides["control"]
        hides, stands = (
            [[_span(b, pair, control) for b in each] for each in boards[hidden]] for hidden in (True, False)
        )
        boxes = [_box(board, control) for board in pair.cover]
        return RecordedClips(sides, {"hides": hides, "stands": stands, "cover": boxes}, evidence, notes)
    else:
        (board,) = pair.cover
        hiding = {"hidden_from_frame": _span(board, pair, control)[0], "cover": _box(board, control)}
        sides["void"] = _covered(control, pair, pair.cover)
    if pair.twin is not None:
        evidence |= _twin_proof(pair, footage["twin"], hiding, sides["void"])
        differs = f"differs in {evidence['twin_px']:,} pixels of {len(sides['void'])} frames, by at most"
        notes.append(
            f"twin {pair.twin}: its void {differs} {evidence['twin_levels']} of 255"
            if evidence["twin_px"]
            else f"twin {pair.twin}: its void is the same byte for byte"
        )
    sides["control"] = _covered(control, pair, pair.control_cover)
    return RecordedClips(sides, hiding, evidence, notes)


def video_path(folder: Path, name: str) -> Path:
    """Return the path of a video below a folder. Raises UnusableFootage."""
    with suppress(OSError, RuntimeError):  # a name that is too long, or links in a circle
        path = (folder / name).resolve()
        if not path.is_relative_to(folder.resolve()):
            raise UnusableFootage("lies outside the folder; copy it into it")
        if path.is_file():
            return path
    raise UnusableFootage("is not there; correct its path, which begins in the folder")


def _require_alike(frames: Sequence[np.ndarray], others: Sequence[np.ndarray], side: str) -> None:
    if frames[0].shape != others[0].shape:
        (height, width, _), (other_height, other_width, _) = frames[0].shape, others[0].shape
        raise UnusableFootage(
            f"{side}: is shown as {other_width} x {other_height}, the control as {width} x {height}, which tells them "
            "apart; film both alike"
        )


def _box(board: Board, control: Footage) -> list[int]:
    """Return a board's place in the clip (px): x, y, width, height; no pixel that it covers stays in part."""
    (seen_width, seen_height), (height, width) = control.seen, control.frames[0].shape[:2]
    if board.x + board.width > seen_width or board.y + board.height > seen_height:
        raise UnusableFootage(f"cover: leaves the picture, which is {seen_width} x {seen_height} as it is seen")
    scale = np.array([width / seen_width, height / seen_height])
    left, top = np.floor(scale * (board.x, board.y)).astype(int).tolist()
    right, bottom = np.ceil(scale * (board.x + board.width, board.y + board.height)).astype(int).tolist()
    if right - left < 8 or bottom - top < 8:
        raise UnusableFootage(f"cover: is {right - left} x {bottom - top} pixels in the clip; cover 8 or more each way")
    return [left, top, right - left, bottom - top]


def _span(board: Board, pair: RecordedPair, control: Footage) -> tuple[int, int]:
    """Return the frames from and until which a board stands. Raises UnusableFootage."""
    first, last = (round(min(at_s - pair.start_s, len(control.frames) / FPS) * FPS) for at_s in board[:2])
    if first >= len(control.frames):
        raise UnusableFootage("cover: begins after the clip's end; its times are those of the original file")
    return first, last


def _covered(control: Footage, pair: RecordedPair, boards: Iterable[Board]) -> list[np.ndarray]:
    """Return frames over which boards stand between their times; each falls into the picture, and rises out of it.

    A board whose time begins with the clip stands from the first frame on; one whose time ends with it stays.
    """
    frames = [frame.copy() for frame in control.frames]
    for board in boards:
        (left, top, width, height), (first, last) = _box(board, control), _span(board, pair, control)
        panel = _panel(width, height, pair.id)
        for number, frame in enumerate(frames):
            away_s = max(first - number, number - last + 1 if last < len(frames) else 0, 0) / FPS
            share = min(away_s / FALL_S, 1.0)
            bottom = top + height - round((top + height) * (2 * share - share**2))  # as `coming_board` does
            if bottom > 0:
                visible = panel[-min(bottom, height) :]
                frame[bottom - len(visible) : bottom, left : left + width] = visible
    return frames


def _panel(width: int, height: int, name: str) -> np.ndarray:
    """Return a board's picture, in a colour of the simulated ones: slats under a paler upper edge."""
    from traps_pipeline.scenes.parts.look import LINE_SHARE, OCCLUDERS, occluder_texture  # takes long to import

    colours = [*OCCLUDERS.values()]
    colour = BOARD_TONE * np.array(colours[int(digest(name)[:8], 16) % len(colours)])
    down = np.arange(height) - height // 2
    panel = occluder_texture(colour, (down >= 0) & (down < max(1, round(LINE_SHARE * height / 2))))
    panel[: max(2, round(EDGE_SHARE * height))] = np.rint(255 * EDGE_TONE * colour)
    return np.repeat(panel[:, None], width, axis=1)


def _twin_proof(pair: RecordedPair, twin: Footage, hiding: dict[str, Any], void: list[np.ndarray]) -> dict[str, Any]:
    """Return how the void that the twin makes differs from the control's: both have one where nothing does."""
    _require_alike(void, twin.frames, "twin")
    frames = _covered(twin, pair, pair.cover)[: hiding.get("cut_frame")]
    if len(frames) != len(void):
        raise UnusableFootage(f"twin {pair.twin}: lasts {len(frames) / FPS:.1f} s, the void {len(void) / FPS:.1f} s")
    difference = np.abs(np.stack(frames).astype(np.int16) - np.stack(void))
    return {"twin_px": int(difference.any(axis=-1).sum()), "twin_levels": int(difference.max())}


# --- in the benchmark's folder ----------------------------------------------------------------------------------------


def clip_path(folder: Path, scenario_id: str, side: str) -> Path:
    """Return the path of a recorded clip below a folder of released records."""
    return folder / "clips" / scenario_id / f"{side}.mp4"


def is_whole(path: Path, sha256: str) -> bool:
    """Return whether a clip and its note exist, and it is the one that was imported."""
    with suppress(DamagedClip):
        return (clip := read_clip(path)) is not None and clip.file_sha256 == sha256
    return False


def copy_clips(released: Path, scenario_id: str, clips: Mapping[str, str], targets: Mapping[str, Path]) -> None:
    """Copy a scenario's clips, with their notes, to a study's files by side. Raises TrapsError for an altered clip.

    clips: their digests by side, as the record has them.
    """
    for side, target in targets.items():
        clip = clip_path(released, scenario_id, side)
        if not is_whole(clip, clips[side]):
            raise TrapsError(f"{clip}: is missing or not the clip that was imported; import the folder again")
        write_bytes(target, clip.read_bytes())
        write_bytes(clip_note_path(target), clip_note_path(clip).read_bytes())
