"""Compare an entry's request with its declaration (`traps models check`).

Client libraries silently rename, add and drop fields. So each entry is asked one question through the backend that
studies use, the request is recorded on this machine, and its body must consist of prompt, clip, question, declared
parameters, and nothing else. No key is needed, and nothing leaves the machine.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from traps_pipeline.base.digests import file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.wording import count_noun
from traps_pipeline.checks.loopback import PLACEHOLDER_KEY, sent_bodies
from traps_pipeline.checks.wire_body import (
    ENDPOINTS,
    SCHEMAS,
    UNKNOWN_FORM,
    ClipPart,
    WireBody,
    declared_fields,
    flat,
    read_body,
)
from traps_pipeline.judging.confabulation import label_request
from traps_pipeline.judging.confabulation_protocol import load_protocol
from traps_pipeline.judging.panel import tasks_for, vote_request
from traps_pipeline.models.registry.entries import NETWORK, Entry, ModelEntry, effective_params, load_models
from traps_pipeline.models.registry.judges import JudgeEntry, load_judges
from traps_pipeline.models.registry.prompts import system_prompt
from traps_pipeline.models.request import Request
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.protocol.regimes import BY_NAME, REGIMES
from traps_pipeline.storage.media import Media, MediaSpec, MediaStore, pick_frames
from traps_pipeline.video.encode import encode

_MIMES = {"video": "video/mp4", "images": "image/jpeg"}
_QUESTION = 'Does the square stop at the right edge, "yes" or "no"? (1 % of clips: déjà vu)'
_CLIP_FPS, _CLIP_FRAMES, _CLIP_SIZE = 10, 50, (480, 360)
_PROTOCOL_FRAMES = 25  # 5 a second of the clip's 5 s, docs/spec.md 3.1


# --- the question that is asked ---------------------------------------------------------------------------------------


class SyntheticClip:
    """A synthetic clip, in a folder that exists until this process ends."""

    def __init__(self, frames: Sequence[np.ndarray], fps: int) -> None:
        self._folder = TemporaryDirectory(prefix="traps-check-")
        self.clip = Path(self._folder.name) / "clip.mp4"
        encode(frames, self.clip, fps)
        self._media = MediaStore(Path(self._folder.name) / "media")

    def prepare(self, spec: MediaSpec) -> Media:
        """Return the clip as it is sent to a model."""
        return self._media.prepare(self.clip, file_digest(self.clip), spec)


@cache
def _studio() -> SyntheticClip:
    """Render a square that moves over a gradient."""
    width, height = _CLIP_SIZE
    ground = np.linspace(60, 200, width, dtype=np.uint8)[None, :, None].repeat(height, axis=0).repeat(3, axis=2)
    frames = []
    for i in range(_CLIP_FRAMES):
        frame = ground.copy()
        frame[150:210, 8 * i : 8 * i + 60] = (220, 40, 40)
        frames.append(frame)
    return SyntheticClip(frames, _CLIP_FPS)


def requests_of(entry: Entry) -> dict[str, Request]:
    """Return one request of every form: by regime, or by task and label for a judge."""
    if isinstance(entry, ModelEntry):
        media = _studio().prepare(entry.media) if entry.media else None
        return {regime: question(entry, regime, _QUESTION, media, {"regime": regime}) for regime in REGIMES}
    assert isinstance(entry, JudgeEntry)
    cell, item = Cell("occlusion", Evaluation("oracle", "standard", 1)), {"item_id": "none", "question": _QUESTION}
    control_item = item | {"ground_truth": "yes"}
    requests = {str(task): vote_request(entry, task, cell, control_item, "Yes.") for task in tasks_for("control")}
    if entry.id in load_protocol().judges.values():
        requests["confabulation"] = label_request(entry, cell, item, "Yes.", "Perhaps.")
    return requests


def question(entry: ModelEntry, regime: str, text: str, sent: Media | None, about: Mapping[str, Any]) -> Request:
    """Return a study's request that asks a model a question about a clip."""
    return Request(
        participant=entry.id,
        endpoint=entry.endpoint,
        params=effective_params(entry, regime),
        system=system_prompt(regime),
        user=text,
        about=about,
        sent=sent,
        media_digest=sent.sha256 if sent else "",
    )


# --- comparing the sent with the declared request ---------------------------------------------------------------------


def _field_problems(declared: Mapping[str, Any], sent: Mapping[str, Any]) -> Iterator[str]:
    for name, value in declared.items():
        if name not in sent:
            yield f"{name}: {_short(value)} is declared and not sent"
        elif sent[name] != value:
            yield f"{name}: {_short(value)} is declared, {_short(sent[name])} is sent"
    for name in sent.keys() - declared.keys():
        yield f"{name}: {_short(sent[name])} is sent and not declared"


def _short(value: Any) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _turn_problems(turns: Sequence[tuple[str, list[str | ClipPart | None]]], request: Request) -> Iterator[str]:
    """Yield problems unless the turns hold prompt, clip and question verbatim."""
    roles = [role for role, _ in turns]
    if roles != ["system", "user"]:
        yield f"the turns are {roles}, not system and user"
        return
    (_, system), (_, user) = turns
    if system != [request.system]:
        yield "the system prompt does not arrive verbatim"
    if not user or user[-1] != request.user:
        yield "the question does not arrive verbatim, as the last part"
    clips = [part for part in user if isinstance(part, ClipPart)]
    others = ["a part of unknown form" if p is None else p for p in user[:-1] if not isinstance(p, ClipPart)]
    if others:
        yield f"something other than clip and question arrives: {_short(others)}"
    if request.sent is not None:
        yield from _clip_problems(clips, request.sent)


def _clip_problems(clips: Sequence[ClipPart], media: Media) -> Iterator[str]:
    expected = media.n_frames if media.profile == "images" else 1
    if len(clips) != expected:
        yield f"media: {len(clips)} of {expected} {'images' if media.profile == 'images' else 'videos'} arrive"
        return
    hasher = hashlib.sha256()
    for clip in clips:
        hasher.update(clip.data)
    if hasher.hexdigest() != media.sha256:
        yield "media: the bytes that arrive are not those that were prepared"
    for name, actual, declared_value in (
        ("type", {clip.mime for clip in clips}, _MIMES[media.profile]),
        ("fps", {clip.fps for clip in clips}, media.fps),
    ):
        if actual != {declared_value}:
            yield f"media.{name}: {declared_value} is declared, {', '.join(map(str, actual))} arrives"


def _wire_problems(entry: Entry, request: Request, wire: WireBody) -> Iterator[str]:
    if wire.api is None:
        yield f"{wire.method} {wire.path} belongs to no API that can be checked ({', '.join(ENDPOINTS)})"
        return
    if PLACEHOLDER_KEY.encode() in wire.raw or PLACEHOLDER_KEY in wire.path:
        yield "the API key is in the body or the address"
    if not any(PLACEHOLDER_KEY in value for value in wire.headers.values()):
        yield "the API key is in no header"
    try:
        body = read_body(wire)
    except UNKNOWN_FORM as error:
        yield f"the body has an unknown form ({type(error).__name__}: {error})"
        return
    if body.model != model_name(entry):
        yield f"model: {model_name(entry)} is declared, {body.model} is sent"
    yield from _turn_problems(body.turns, request)
    yield from _field_problems(declared_fields(wire.api, request.params), body.fields)


def model_name(entry: Entry) -> str:
    """Return the provider's own name of a model: litellm's name without the route."""
    return str(entry.provider_id).split("/", 1)[1].removeprefix("responses/")


# --- entries ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CheckedEntry:
    """An entry, a line about its request, and the problems of the request."""

    entry: Entry
    line: str
    problems: list[str]


def examine(entry: Entry) -> CheckedEntry:
    """Compare what a model or judge is sent, caught on this machine, with what its entry declares."""
    if entry.backend == NETWORK:
        return _examine_network(entry)
    if isinstance(entry, ModelEntry) and entry.media is not None:
        return _examine_local(entry, entry.media)
    return CheckedEntry(entry, f"{entry.id:<24} nothing is sent anywhere", [])


def _examine_network(entry: Entry) -> CheckedEntry:
    requests = requests_of(entry)
    bodies = dict(zip(requests, sent_bodies(entry, list(requests.values())), strict=True))
    problems: dict[str, list[str]] = {}
    for form, body in bodies.items():
        messages = [body] if isinstance(body, str) else _wire_problems(entry, requests[form], body)
        for problem in messages:
            problems.setdefault(problem, []).append(form)
    problem_lines = [p if len(forms) == len(bodies) else f"{' and '.join(forms)}: {p}" for p, forms in problems.items()]
    if isinstance(entry, ModelEntry):
        problem_lines += _protocol_problems(entry, requests)
    first = next(iter(requests))
    return CheckedEntry(entry, _line(entry, bodies[first], requests[first].sent), problem_lines)


def _protocol_problems(entry: ModelEntry, requests: Mapping[str, Request]) -> Iterator[str]:
    """Yield departures from the protocol, which applies whatever the entry says."""
    for regime, request in requests.items():
        if ("response_format" in request.params) != (entry.json_schema and bool(BY_NAME[regime].fields)):
            yield f"{regime}: structured output is for regimes that ask for an object, where the entry has json_schema"
    frame_counts = {request.sent.n_frames for request in requests.values() if request.sent}
    if "media" not in entry.waivers and frame_counts != {_PROTOCOL_FRAMES}:
        yield f"media: {frame_counts} frames of a 5 s clip are sent, the protocol has {_PROTOCOL_FRAMES} (5 a second)"


def _line(entry: Entry, wire: WireBody | str, media: Media | None) -> str:
    if isinstance(wire, str):
        return f"{entry.id:<24} nothing caught"
    clip = f"{media.profile} {count_noun(media.n_frames, 'frame')} {media.size_bytes:,} bytes" if media else "no clip"
    try:
        fields = read_body(wire).fields
    except UNKNOWN_FORM:
        fields = {}
    return f"{entry.id:<24} {wire.path}  {clip}  {_fields(fields)}"


def _fields(fields: Mapping[str, Any]) -> str:
    words = {name: "schema" if name in SCHEMAS else _short(value) for name, value in fields.items()}
    return " ".join(f"{name.removeprefix('generationConfig.')}={value}" for name, value in words.items())


def _examine_local(entry: ModelEntry, spec: MediaSpec) -> CheckedEntry:
    """Check the frames that a local model is shown; nothing is sent."""
    frames = pick_frames(_studio().clip, spec)
    count, (height, width) = len(frames.frames), frames.frames.shape[1:3]
    times = " ".join(f"{time:g}" for time in frames.times_s[:3])
    line = f"{entry.id:<24} local  {count_noun(count, 'frame')} of {width} x {height} "
    line += f"at {times} ... {frames.times_s[-1]:g} s"
    problems = list(_local_problems(frames.times_s, (width, height), spec))
    return CheckedEntry(entry, f"{line}  {_fields(flat(entry.params))}", problems)


def _local_problems(times_s: np.ndarray, size: tuple[int, int], spec: MediaSpec) -> Iterator[str]:
    last = (_CLIP_FRAMES - 1) / _CLIP_FPS
    if spec.uniform is not None:
        expected = np.linspace(0, last, min(spec.uniform, _CLIP_FRAMES))
    else:
        expected = (np.arange(_CLIP_FRAMES) / (spec.fps or 1))[: spec.most]
        expected = expected[expected <= last + 1e-6]
    if len(times_s) != len(expected):
        yield f"media: {count_noun(len(times_s), 'frame')} shown, {len(expected)} declared"
    elif np.abs(times_s - expected).max() > 0.5 / _CLIP_FPS + 1e-6:
        yield "media: the frames are not those nearest to the declared times"
    if size != (spec.size or _CLIP_SIZE):
        yield f"media: frames are {size}, {spec.size or _CLIP_SIZE} is declared"


def participants() -> dict[str, Entry]:
    """Return the network and local models and judges, by id."""
    return {**load_models(), **load_judges()}


def check_named(names: Sequence[str]) -> Iterator[CheckedEntry]:
    """Check what models and judges are sent (default: all). Raises TrapsError for an unknown id."""
    entries = participants()
    if unknown := [name for name in names if name not in entries]:
        raise TrapsError(f"unknown model or judge {', '.join(unknown)}; known: {', '.join(entries)}")
    for name, entry in entries.items():
        if name in names or (not names and entry.backend in (NETWORK, "local")):
            yield examine(entry)
