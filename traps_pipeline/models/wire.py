"""What an entry of the registry really sends, against what it declares: `traps models check`.

Client libraries rename, add and leave out without a word. So each entry is asked one question through the backend that
studies use, the request is caught on this machine, and everything in its body is accounted for: prompt, clip, question,
declared parameters, and nothing else. No key is needed, and nothing leaves the machine.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache, cached_property
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread
from typing import TYPE_CHECKING, Any, Literal
from urllib.parse import urlsplit

import numpy as np

from traps_pipeline.digests import file_digest
from traps_pipeline.errors import TrapsError
from traps_pipeline.models.api import ApiBackend
from traps_pipeline.models.prompts import system_prompt
from traps_pipeline.models.registry import NETWORK, Account, Entry, ModelEntry, effective_params, load_accounts
from traps_pipeline.models.request import Request, TransientError
from traps_pipeline.partitions import REGIMES, Cell, Evaluation
from traps_pipeline.progress import Progress, reporting
from traps_pipeline.scenes.encode import encode
from traps_pipeline.storage.media import Media, MediaSpec, MediaStore, sample

if TYPE_CHECKING:
    from traps_pipeline.models.judges import JudgeEntry

Api = Literal["chat", "responses", "gemini", "anthropic"]
_ENDPOINTS: dict[str, Api] = {
    "/chat/completions": "chat",
    "/responses": "responses",
    ":generateContent": "gemini",
    "/v1/messages": "anthropic",
}
# A parameter's name in the body, where it is another than in the entry.
_NAMES: dict[Api, dict[str, str]] = {
    "chat": {},
    "responses": {"max_tokens": "max_output_tokens", "max_completion_tokens": "max_output_tokens"},
    "gemini": {"top_p": "topP", "top_k": "topK", "max_tokens": "maxOutputTokens"},
    "anthropic": {},
}
UNKNOWN_FORM = (ValueError, KeyError, TypeError, AttributeError)
_SCHEMAS = ("response_format", "text.format", "generationConfig.responseJsonSchema", "output_format")  # kept whole
_MIMES = {"video": "video/mp4", "images": "image/jpeg"}
_KEY = "placeholder-of-a-key"
_QUESTION = 'Does the square stop at the right edge, "yes" or "no"? (1 % of clips: déjà vu)'
_CLIP_FPS, _CLIP_FRAMES, _CLIP_SIZE = 10, 50, (480, 360)
_PROTOCOL_FRAMES = 25  # 5 a second of the clip's 5 s, docs/spec.md 3.1


# --- the request that is caught ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class WireBody:
    """One HTTP request as a provider would get it."""

    method: str
    path: str
    headers: Mapping[str, str]
    raw: bytes

    @cached_property
    def body(self) -> dict[str, Any]:
        """The parsed JSON."""
        return json.loads(self.raw)

    @property
    def api(self) -> Api | None:
        """Which API the path belongs to."""
        return next((api for ending, api in _ENDPOINTS.items() if self.path.endswith(ending)), None)


class _Loopback(Account):
    """An account whose provider is this machine."""

    def secret(self) -> str | None:
        """A key that opens nothing."""
        return _KEY


@dataclass
class _Notes(Progress):
    """Keeps what a backend would tell a person: why a client library refused to send."""

    texts: list[str] = field(default_factory=list)

    def note(self, text: str) -> None:
        """See `Progress.note`."""
        self.texts.append(text)


@contextmanager
def _listening() -> Iterator[tuple[str, list[WireBody]]]:
    """A server on this machine: its address and the requests that reach it. Each is answered with a final 400."""
    caught: list[WireBody] = []

    class Catcher(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            raw = self.rfile.read(int(self.headers.get("content-length") or 0))
            caught.append(WireBody(self.command, self.path, dict(self.headers), raw))
            answer = b'{"error": {"message": "caught", "type": "invalid_request_error", "code": 400}}'
            self.send_response(400)
            self.send_header("content-type", "application/json")
            self.send_header("content-length", str(len(answer)))
            self.end_headers()
            self.wfile.write(answer)

        def log_message(self, format: str, *args: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Catcher)
    Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    try:
        with _no_proxy("127.0.0.1"):
            yield f"http://127.0.0.1:{server.server_port}", caught
    finally:
        server.shutdown()
        server.server_close()


@contextmanager
def _no_proxy(host: str) -> Iterator[None]:
    """Clients ask a host directly, whatever proxy the environment names."""
    names = ("no_proxy", "NO_PROXY")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update({name: ",".join(filter(None, (before[name], host))) for name in names})
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def render(entry: Entry, requests: Sequence[Request]) -> list[WireBody | str]:
    """The body of each request, or why none was sent."""
    account, notes = load_accounts()[str(entry.account)], _Notes()
    with _listening() as (address, caught), reporting(notes):
        loopback = _Loopback(base_url=address + urlsplit(account.base_url or "").path)

        async def ask_all() -> list[WireBody | str]:
            return [await _ask(entry, loopback, request, caught, notes) for request in requests]

        return asyncio.run(ask_all())


async def _ask(
    entry: Entry, account: Account, request: Request, caught: list[WireBody], notes: _Notes
) -> WireBody | str:
    caught.clear()
    backend = ApiBackend(entry, account)  # a new one each time: it tells a failure of a kind once
    with suppress(TransientError):
        await backend.ask(request)
    return caught[0] if len(caught) == 1 else f"{len(caught)} requests were sent, not one ({notes.texts[-1:]})"


# --- the question that is asked ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Studio:
    """A clip without a scene, and where what is sent of it is kept until this process ends."""

    folder: TemporaryDirectory[str]
    clip: Path
    media: MediaStore

    def prepare(self, spec: MediaSpec) -> Media:
        return self.media.prepare(self.clip, file_digest(self.clip), spec)


@cache
def _studio() -> _Studio:
    folder = TemporaryDirectory(prefix="traps-wire-")
    clip = Path(folder.name) / "clip.mp4"
    encode(_frames(), clip, _CLIP_FPS)
    return _Studio(folder, clip, MediaStore(Path(folder.name) / "media"))


def _frames() -> list[np.ndarray]:
    """A square that moves over a gradient."""
    width, height = _CLIP_SIZE
    ground = np.linspace(60, 200, width, dtype=np.uint8)[None, :, None].repeat(height, axis=0).repeat(3, axis=2)
    frames = []
    for i in range(_CLIP_FRAMES):
        frame = ground.copy()
        frame[150:210, 8 * i : 8 * i + 60] = (220, 40, 40)
        frames.append(frame)
    return frames


def requests_of(entry: Entry) -> dict[str, Request]:
    """One request of every form that a study makes of an entry: a model's by regime, a judge's by task (and a label of
    confabulation, where it gives those)."""
    if isinstance(entry, ModelEntry):
        return {regime: _answer_request(entry, regime) for regime in REGIMES}
    from traps_pipeline.judging.confabulation import load_protocol
    from traps_pipeline.judging.panel import tasks_for

    assert isinstance(entry, JudgeEntry)
    votes = {str(task): _vote_request(entry, task) for task in tasks_for("control")}
    return votes | ({"confabulation": _label_request(entry)} if entry.id in load_protocol().judges.values() else {})


def _answer_request(entry: ModelEntry, regime: str) -> Request:
    sent = _studio().prepare(entry.media) if entry.media else None
    return Request(
        participant=entry.id,
        endpoint=entry.endpoint,
        params=effective_params(entry, regime),
        system=system_prompt(regime),
        user=_QUESTION,
        about={"regime": regime},
        sent=sent,
        media_digest=sent.sha256 if sent else "",
    )


def _label_request(entry: JudgeEntry) -> Request:
    from traps_pipeline.judging.confabulation import label_request

    cell = Cell("occlusion", Evaluation("oracle", "standard", 1))
    return label_request(entry, cell, {"item_id": "none", "question": _QUESTION}, "Yes.", "Perhaps.")


def _vote_request(entry: JudgeEntry, task: Literal["abstention", "correctness"]) -> Request:
    from traps_pipeline.judging.panel import vote_request

    cell = Cell("occlusion", Evaluation("oracle", "standard", 1))
    return vote_request(entry, task, cell, {"item_id": "none", "question": _QUESTION, "ground_truth": "yes"}, "Yes.")


# --- what a body says -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Clip:
    """A video or an image in a body. fps: as the body says it."""

    mime: str
    data: bytes
    fps: float | None = None


@dataclass(frozen=True)
class Said:
    """A body in one form for all APIs. turns: role and parts, each a text, a clip, or None for anything else.

    fields: by dotted name, whatever is neither model nor turn; a schema is kept whole.
    """

    model: str
    turns: list[tuple[str, list[str | Clip | None]]]
    fields: dict[str, Any]


def read_body(wire: WireBody) -> Said:
    """What a body says. Raises one of `UNKNOWN_FORM`."""
    body = _camel(wire.body) if wire.api == "gemini" else dict(wire.body)
    model = body.pop("model", None) or wire.path.rsplit("/", 1)[-1].removesuffix(":generateContent")
    match wire.api:
        case "gemini":
            turns = [{"role": "system", **body.pop("systemInstruction")}, *body.pop("contents")]
        case "responses":
            turns = [{"role": "system", "content": body.pop("instructions")}, *body.pop("input")]
        case "anthropic":
            turns = [{"role": "system", "content": body.pop("system")}, *body.pop("messages")]
        case _:
            turns = body.pop("messages")
    return Said(model, [_turn(turn) for turn in turns], _flat(body))


def _turn(turn: Mapping[str, Any]) -> tuple[str, list[str | Clip | None]]:
    content = turn["parts"] if "parts" in turn else turn["content"]
    return turn["role"], [content] if isinstance(content, str) else [_part(part) for part in content]


def _part(part: Mapping[str, Any]) -> str | Clip | None:
    """A part of a turn, in the words of any of the APIs; None for what is none of ours."""
    match part:
        case {"text": str(text), **rest} if rest.keys() <= {"type"}:
            return text
        case {"image_url": {"url": str(uri), **more}, **rest} if not more and rest.keys() <= {"type"}:
            return _clip(uri)
        case {"image_url": str(uri), **rest} if rest == {"type": "input_image", "detail": "auto"}:
            return _clip(uri)  # litellm adds the detail; auto is the provider's default
        case {"video_url": {"url": str(uri), **more}, **rest} if not more and rest.keys() <= {"type", "fps"}:
            return _clip(uri, rest.get("fps"))
        case {"inlineData": {"mimeType": str(mime), "data": str(data)}, **rest} if rest.keys() <= {"videoMetadata"}:
            return _clip(f"data:{mime};base64,{data}", **rest.get("videoMetadata", {}))
    return None


def _clip(uri: str, fps: float | None = None) -> Clip:
    head, data = uri.split(",", 1)
    return Clip(head.removeprefix("data:").removesuffix(";base64"), base64.b64decode(data, validate=True), fps)


def _camel(value: Any) -> Any:
    """Gemini's names in one spelling: it reads snake_case and camelCase alike, and litellm mixes them."""
    if isinstance(value, list):
        return [_camel(one) for one in value]
    if not isinstance(value, dict):
        return value
    renamed = {_camel_name(name): one for name, one in value.items()}
    return {name: one if name == "responseJsonSchema" else _camel(one) for name, one in renamed.items()}


def _camel_name(name: str) -> str:
    head, *others = name.split("_")
    return head + "".join(word.capitalize() for word in others)


def _flat(value: Any, name: str = "") -> dict[str, Any]:
    """Leaves of nested mappings by dotted name."""
    if not isinstance(value, dict) or not value or name in _SCHEMAS:
        return {name: value}
    leaves: dict[str, Any] = {}
    for key, one in value.items():
        leaves |= _flat(one, f"{name}.{key}" if name else key)
    return leaves


# --- against what is declared -----------------------------------------------------------------------------------------


def declared_fields(api: Api, params: Mapping[str, Any]) -> dict[str, Any]:
    """The fields that a body of an API must have, and no others, by dotted name."""
    fields: dict[str, Any] = {}
    for name, value in params.items():
        if name == "response_format":
            fields |= _schema_fields(api, value)
        elif name == "extra_body":
            fields |= _flat(value)
        elif name == "reasoning_effort" and api == "responses":
            fields |= _flat(value if isinstance(value, dict) else {"effort": value}, "reasoning")
        else:
            place = "generationConfig." if api == "gemini" else ""
            fields |= _flat(value, place + _NAMES[api].get(name, name))
    return fields


def _schema_fields(api: Api, response_format: Mapping[str, Any]) -> dict[str, Any]:
    """How an API is told a JSON schema."""
    given = response_format["json_schema"]
    match api:
        case "chat":
            return {"response_format": response_format}
        case "responses":
            return {"text.format": {"type": "json_schema", **given}}
        case "gemini":
            config = {"responseMimeType": "application/json", "responseJsonSchema": given["schema"]}
            return {f"generationConfig.{name}": value for name, value in config.items()}
        case "anthropic":
            return {"output_format": {"type": "json_schema", "schema": given["schema"]}}


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


def _turn_problems(turns: Sequence[tuple[str, list[str | Clip | None]]], request: Request) -> Iterator[str]:
    """System prompt and question must arrive verbatim, and nothing else but the clip before the question."""
    roles = [role for role, _ in turns]
    if roles != ["system", "user"]:
        yield f"the turns are {roles}, not system and user"
        return
    (_, system), (_, user) = turns
    if system != [request.system]:
        yield "the system prompt does not arrive verbatim"
    if not user or user[-1] != request.user:
        yield "the question does not arrive verbatim, as the last part"
    clips = [part for part in user if isinstance(part, Clip)]
    if len(clips) != len(user) - 1:
        yield "something other than clip and question arrives"
    if request.sent is not None:
        yield from _clip_problems(clips, request.sent)


def _clip_problems(clips: Sequence[Clip], media: Media) -> Iterator[str]:
    wanted = media.n_frames if media.profile == "images" else 1
    if len(clips) != wanted:
        yield f"media: {len(clips)} of {wanted} {'images' if media.profile == 'images' else 'videos'} arrive"
        return
    found = hashlib.sha256()
    for clip in clips:
        found.update(clip.data)
    if found.hexdigest() != media.sha256:
        yield "media: the bytes that arrive are not those that were prepared"
    for name, seen, mine in (
        ("type", {clip.mime for clip in clips}, _MIMES[media.profile]),
        ("fps", {clip.fps for clip in clips}, media.fps),
    ):
        if seen != {mine}:
            yield f"media.{name}: {mine} is declared, {', '.join(map(str, seen))} arrives"


def _wire_problems(entry: Entry, request: Request, wire: WireBody) -> Iterator[str]:
    if wire.api is None:
        yield f"{wire.method} {wire.path} is of no API that can be checked ({', '.join(_ENDPOINTS)})"
        return
    if _KEY.encode() in wire.raw or _KEY in wire.path:
        yield "the API key is in the body or the address"
    if not any(_KEY in value for value in wire.headers.values()):
        yield "the API key is in no header"
    try:
        said = read_body(wire)
    except UNKNOWN_FORM as error:
        yield f"the body is of an unknown form ({type(error).__name__}: {error})"
        return
    if said.model != model_name(entry):
        yield f"model: {model_name(entry)} is declared, {said.model} is sent"
    yield from _turn_problems(said.turns, request)
    yield from _field_problems(declared_fields(wire.api, request.params), said.fields)


def model_name(entry: Entry) -> str:
    """The provider's own name of a model: litellm's without the route."""
    return str(entry.provider_id).split("/", 1)[1].removeprefix("responses/")


# --- entries ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Checked:
    """An entry, what it sends, in a line, and what is wrong with that."""

    entry: Entry
    line: str
    problems: list[str]


def check_entry(entry: Entry) -> list[str]:
    """What is wrong with that which an entry sends; empty if nothing."""
    return examine(entry).problems


def examine(entry: Entry) -> Checked:
    """Ask an entry on this machine and compare."""
    if entry.backend == NETWORK:
        return _examine_network(entry)
    if isinstance(entry, ModelEntry) and entry.media is not None:
        return _examine_local(entry, entry.media)
    return Checked(entry, f"{entry.id:<24} nothing is sent anywhere", [])


def _examine_network(entry: Entry) -> Checked:
    requests = requests_of(entry)
    bodies = dict(zip(requests, render(entry, list(requests.values())), strict=True))
    problems: dict[str, list[str]] = {}
    for form, body in bodies.items():
        found = [body] if isinstance(body, str) else _wire_problems(entry, requests[form], body)
        for problem in found:
            problems.setdefault(problem, []).append(form)
    listed = [p if len(forms) == len(bodies) else f"{' and '.join(forms)}: {p}" for p, forms in problems.items()]
    if isinstance(entry, ModelEntry):
        listed += _protocol_problems(entry, requests)
    first = next(iter(requests))
    return Checked(entry, _line(entry, bodies[first], requests[first].sent), listed)


def _protocol_problems(entry: ModelEntry, requests: Mapping[str, Request]) -> Iterator[str]:
    """What the protocol wants of every model, whatever an entry declares."""
    for regime, request in requests.items():
        if ("response_format" in request.params) != (entry.json_schema and regime == "json"):
            yield f"{regime}: structured output is for the JSON regime alone, where the entry has json_schema"
    shown = {request.sent.n_frames for request in requests.values() if request.sent}
    if "media" not in entry.waivers and shown != {_PROTOCOL_FRAMES}:
        yield f"media: {shown} frames of a 5 s clip are sent, the protocol has {_PROTOCOL_FRAMES} (5 a second)"


def _line(entry: Entry, wire: WireBody | str, media: Media | None) -> str:
    if isinstance(wire, str):
        return f"{entry.id:<24} nothing caught"
    shown = f"{media.profile} {media.n_frames} frames {media.size_bytes:,} bytes" if media else "no clip"
    try:
        fields = read_body(wire).fields
    except UNKNOWN_FORM:
        fields = {}
    return f"{entry.id:<24} {wire.path}  {shown}  {_fields(fields)}"


def _fields(fields: Mapping[str, Any]) -> str:
    shown = {name: "schema" if name in _SCHEMAS else _short(value) for name, value in fields.items()}
    return " ".join(f"{name.removeprefix('generationConfig.')}={value}" for name, value in shown.items())


def _examine_local(entry: ModelEntry, spec: MediaSpec) -> Checked:
    """What a local model is shown: nothing is sent, but frames are picked and resized."""
    shown = sample(_studio().clip, spec)
    count, (height, width) = len(shown.frames), shown.frames.shape[1:3]
    times = " ".join(f"{time:g}" for time in shown.times_s[:3])
    line = f"{entry.id:<24} local  {count} frames of {width} x {height} at {times} ... {shown.times_s[-1]:g} s"
    problems = list(_local_problems(shown.times_s, (width, height), spec))
    return Checked(entry, f"{line}  {_fields(_flat(entry.params))}", problems)


def _local_problems(times_s: np.ndarray, size: tuple[int, int], spec: MediaSpec) -> Iterator[str]:
    last = (_CLIP_FRAMES - 1) / _CLIP_FPS
    if spec.uniform is not None:
        wanted = np.linspace(0, last, min(spec.uniform, _CLIP_FRAMES))
    else:
        wanted = (np.arange(_CLIP_FRAMES) / (spec.fps or 1))[: spec.most]
        wanted = wanted[wanted <= last + 1e-6]
    if len(times_s) != len(wanted):
        yield f"media: {len(times_s)} frames are shown, {len(wanted)} are declared"
    elif np.abs(times_s - wanted).max() > 0.5 / _CLIP_FPS + 1e-6:
        yield "media: the frames are not those nearest to the declared times"
    if size != (spec.size or _CLIP_SIZE):
        yield f"media: frames are {size}, {spec.size or _CLIP_SIZE} is declared"


def participants() -> dict[str, Entry]:
    """Models and judges that are asked over the network or locally, by id."""
    from traps_pipeline.models.judges import load_judges
    from traps_pipeline.models.registry import load_models

    return {**load_models(), **load_judges()}


def check_named(names: Sequence[str]) -> Iterator[Checked]:
    """Check the entries of these ids; without any, all that send or show something. Raises TrapsError."""
    known = participants()
    if unknown := [name for name in names if name not in known]:
        raise TrapsError(f"unknown model or judge {', '.join(unknown)}; known: {', '.join(known)}")
    for name, entry in known.items():
        if name in names or (not names and entry.backend in (NETWORK, "local")):
            yield examine(entry)
