"""Every entry of the registry sends exactly what it declares, and the check reports every difference."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.build.errors import raises
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.checks import wire_check
from traps_pipeline.checks.loopback import PLACEHOLDER_KEY, sent_bodies
from traps_pipeline.checks.wire_body import ClipPart, WireBody, read_body
from traps_pipeline.checks.wire_check import check_named, examine, requests_of
from traps_pipeline.cli import main
from traps_pipeline.models.registry.entries import ModelEntry, get_model, load_models
from traps_pipeline.models.registry.schemas import answer_object
from traps_pipeline.models.wire import api
from traps_pipeline.protocol.regimes import FIELDS, fields_of
from traps_pipeline.storage.media import Media, MediaSpec, data_uris, payload

pytestmark = pytest.mark.slow  # litellm's import

PAPER = [  # docs/spec.md 3.2
    "gemini-2.5-pro", "gemini-2.5-flash", "gemini-2.5-flash-nt", "gemini-3.1-pro", "gemini-3.1-pro-r-low",
    "gemini-3.1-flash-lite", "qwen3-vl-think", "qwen3-vl-instruct", "qwen3-vl-8b", "gpt-5-pro", "gpt-5-high",
    "gpt-5-medium", "gpt-5-nr", "gpt-5-mini", "gemma-4-e4b", "llava-next-video-7b",
]  # fmt: skip
CHECKED = [name for name, entry in wire_check.participants().items() if entry.backend in ("api", "local")]


def altered(name: str, params: dict[str, Any] | None = None, **changes: Any) -> ModelEntry:
    """An entry of the registry with other values, unchecked; a parameter that is None is left out."""
    entry = get_model(name)
    merged = entry.params | (params or {})
    return entry.model_copy(update=changes | {"params": {p: v for p, v in merged.items() if v is not None}})


def bodies(name: str) -> dict[str, WireBody]:
    requests = requests_of(get_model(name))
    found = dict(zip(requests, sent_bodies(get_model(name), list(requests.values())), strict=True))
    assert all(isinstance(body, WireBody) for body in found.values()), found
    return found  # pyright: ignore[reportReturnType]


# --- what is released -------------------------------------------------------------------------------------------------


def test_the_sixteen_configurations_are_there_in_the_papers_order() -> None:
    assert [name for name in load_models() if name in PAPER] == PAPER
    assert [get_model(name).runs for name in PAPER] == [1 if name == "qwen3-vl-8b" else 3 for name in PAPER]
    groups = [get_model(name).groups for name in PAPER]
    assert [g.group for g in groups].count("main") == 14
    assert [(g.group, g.input) for g in groups].count(("main", "video")) == 9
    assert [g.input for g in groups].count("image") == 5


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.promise] * (name in PAPER)) for name in CHECKED]
)
def test_an_entry_sends_what_it_declares(name: str) -> None:
    (checked,) = check_named([name])
    assert checked.problems == []


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("qwen3-vl-8b", ["local  16 ", "480 x 360", "0 0.3 0.7 ... 4.9 s"]),
        ("gemma-4-e4b", ["local  10 ", "480 x 360", "0 0.5 1 ... 4.5 s"]),
        ("llava-next-video-7b", ["local  10 ", "336 x 336", "0 0.5 1 ... 4.5 s"]),
        ("gemini-2.5-pro", ["/v1beta/models/gemini-2.5-pro:generateContent  video 25 "]),
        ("qwen3-vl-instruct", ["/compatible-mode/v1/chat/completions  video 25 "]),
        ("gpt-5-nr", ["/v1/responses  images 25 "]),
    ],
)
def test_the_frames_are_those_of_the_protocol(name: str, shown: list[str]) -> None:
    (checked,) = check_named([name])
    assert all(part in checked.line for part in shown), checked.line


@pytest.mark.parametrize(
    ("name", "schema"),
    [("gemini-2.5-pro", "responseJsonSchema"), ("gpt-5-high", "text.format"), ("qwen3-vl-instruct", "response_format")],
)
def test_a_schema_is_sent_in_regimes_of_json_alone(name: str, schema: str) -> None:
    for regime, body in bodies(name).items():
        sent = [field for field in read_body(body).fields if field.endswith(schema)]
        assert len(sent) == bool(fields_of(regime)), regime
    assert [f for body in bodies("qwen3-vl-think").values() for f in read_body(body).fields if "format" in f] == []


def test_the_clip_in_the_body_is_the_one_that_was_prepared() -> None:
    for name, images in (("gemini-3.1-pro", 1), ("qwen3-vl-think", 1), ("gpt-5-mini", 25)):
        sent = requests_of(get_model(name))["standard"].sent
        assert sent is not None
        _, user = read_body(bodies(name)["guided"]).turns[1]
        clips = [part for part in user if isinstance(part, ClipPart)]
        assert (len(clips), [clip.data for clip in clips]) == (images, payload(sent))
        assert {clip.fps for clip in clips} == {sent.fps} == {None if images > 1 else 5}


# --- what must not pass -----------------------------------------------------------------------------------------------


def place_and_figures(problem: str) -> tuple[str, list[str]]:
    """What a problem begins with, and the numbers that it names."""
    place, _, rest = problem.partition(": ")
    return place, re.findall(r"\d+(?:\.\d+)?", rest)


def test_gemini_drops_a_video_url_without_a_word(monkeypatch: pytest.MonkeyPatch) -> None:
    def as_video_url(media: Media, _: str) -> list[dict[str, Any]]:
        return [{"type": "video_url", "video_url": {"url": data_uris(media)[0]}, "fps": 5}]

    monkeypatch.setattr(api, "media_parts", as_video_url)
    (problem,) = examine(get_model("gemini-2.5-pro")).problems
    assert place_and_figures(problem) == ("media", ["0", "1"])


@pytest.mark.parametrize("name", ["gemini-3.1-flash-lite", "qwen3-vl-think"])
def test_another_rate_than_the_clips_is_found(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    honest = api.media_parts

    def at_one_fps(media: Media, route: str) -> list[dict[str, Any]]:
        (part,) = honest(media, route)
        if "file" in part:
            return [part | {"file": part["file"] | {"video_metadata": {"fps": 1}}}]
        return [part | {"fps": 1}]

    monkeypatch.setattr(api, "media_parts", at_one_fps)
    (problem,) = examine(get_model(name)).problems
    assert place_and_figures(problem) == ("media.fps", ["5", "1"])


def test_anything_beside_clip_and_question_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    honest = api.media_parts
    hint = {"type": "text", "text": "These are 25 frames."}
    monkeypatch.setattr(api, "media_parts", lambda media, route: [*honest(media, route), hint])
    (problem,) = examine(get_model("gpt-5-nr")).problems
    assert "These are 25 frames." in problem


@pytest.mark.parametrize(
    ("entry", "names"),
    [
        pytest.param(
            altered("gemini-2.5-pro", media=MediaSpec(profile="video", fps=1)),
            ["media: {5} ", " 25 "],
            id="one frame a second",
        ),
        pytest.param(
            altered("gpt-5-high", {"temperature": 0.8}),
            ["gpt-5 doesn't support temperature=0.8 while reasoning is active"],  # in the words of the library
            id="a parameter that the model refuses is not dropped silently",
        ),
        pytest.param(
            altered("gemini-3.1-pro", {"temperature": None}),
            ["generationConfig.temperature: 1.0 "],
            id="a default of the library",
        ),
        pytest.param(
            altered("qwen3-vl-think", {"response_format": answer_object(FIELDS["json"])}),
            ["standard: ", "json_schema"],
            id="a schema in every regime",
        ),
    ],
)
def test_an_altered_entry_is_told_what_is_wrong(entry: ModelEntry, names: list[str]) -> None:
    problems = examine(entry).problems
    assert any(all(name in problem for name in names) for problem in problems), problems


def test_a_key_in_the_body_is_found() -> None:
    assert examine(altered("qwen3-vl-think", {"note": "a word"})).problems == []
    assert len(examine(altered("qwen3-vl-think", {"note": PLACEHOLDER_KEY})).problems) == 1


@pytest.mark.parametrize(
    ("line", "names"),
    [
        ("waivers: {temperature: refused}", ["params.top_p ", " 0.95", "waivers"]),
        ("params: {temperature: 0.2}, waivers: {top_p: refused, max_tokens: long}", ["params.temperature ", " 0.2"]),
        ("params: {temperature: 0.8}, waivers: {temperature: x, top_p: x}", ["waivers.temperature: "]),
    ],
)
def test_a_missing_waiver_names_entry_and_field(tmp_path: Path, line: str, names: list[str]) -> None:
    path = tmp_path / "models.yaml"
    media = "media: {profile: images, fps: 5}"
    path.write_text(
        f"models:\n  - {{id: mine, backend: api, account: openai, provider_id: openai/gpt-5, {media}, {line}}}\n"
    )
    with raises(TrapsError, "base.yamlfile.parse_yaml_model", "models.yaml:", " 1 (mine): ", *names):
        load_models(path)


# --- the command ------------------------------------------------------------------------------------------------------

OFFLINE = """
import socket, sys

def connect(self, address, connect=socket.socket.connect):
    if address[0] != "127.0.0.1":
        print("reached for", address)
        raise OSError("no network")
    return connect(self, address)

def resolve(host, *args, resolve=socket.getaddrinfo, **kwargs):
    if host != "127.0.0.1":
        print("looked up", host)
        raise socket.gaierror("no network")
    return resolve(host, *args, **kwargs)

socket.socket.connect, socket.getaddrinfo = connect, resolve
from traps_pipeline.cli import main
sys.exit(main(["models", "check", "gemini-2.5-pro", "gpt-5-nr", "qwen3-vl-think", "judge-claude-opus-4.6"]))
"""


def test_the_command_needs_neither_keys_nor_a_network() -> None:
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_API_KEY")}
    environment |= {"HTTP_PROXY": "http://127.0.0.1:9", "HTTPS_PROXY": "http://127.0.0.1:9"}
    done = subprocess.run(
        [sys.executable, "-c", OFFLINE], env=environment, capture_output=True, text=True, check=False, timeout=300
    )
    lines = done.stdout.splitlines()
    assert done.returncode == 0, done.stdout + done.stderr
    checked = ["gemini-2.5-pro", "qwen3-vl-think", "gpt-5-nr", "judge-claude-opus-4.6"]
    assert [line.split()[0] for line in lines[:-1]] == checked
    assert done.stderr == ""


def test_the_command_fails_where_an_entry_does(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = altered("gpt-5-nr", {"temperature": 0.8})
    monkeypatch.setattr(wire_check, "participants", lambda: {"gpt-5-nr": broken})
    assert main(["models", "check"]) == 1
    entry, problem, *_, summary = capsys.readouterr().out.splitlines()
    assert entry.startswith("gpt-5-nr ") and problem.startswith("    0 ") and summary.startswith("1 ")
    with raises(TrapsError, "checks.wire_check.check_named", "gpt-6"):
        next(check_named(["gpt-6"]))


def test_a_panel_is_checked_by_its_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["models", "check", "rules"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()[:-1]] == ["rule-1", "rule-2", "rule-3"]
