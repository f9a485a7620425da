"""The code of each stage that states one by hand, and a digest of the files that decide what it makes.

`python -m tests.pipeline.stage_codes` writes both to `stage_codes.json`. Comments, docstrings, layout and the
sentences of errors do not count.
"""

from __future__ import annotations

import ast
import io
import json
import tokenize
from pathlib import Path

import traps_pipeline.definitions  # noqa: F401 - declares the stages
from traps_pipeline.base.digests import digest
from traps_pipeline.base.paths import PACKAGE
from traps_pipeline.pipeline.graph import the_graph

REVIEWED = Path(__file__).with_name("stage_codes.json")
_SCENES = ("certification", "families", "parts", "worlds")
_DECIDED_BY: dict[str, tuple[str, ...]] = {
    "scene_specs": (*(f"scenes/{room}" for room in _SCENES), "benchmark/corrections.py", "benchmark/specs.py"),
    "videos": ("scenes/picture", "scenes/worlds/clips.py", "benchmark/videos.py", "video"),
    "arms": ("scenes/variants", "benchmark/filmed_arms.py", "benchmark/filmed_lanes.py"),
    "items": ("benchmark/items.py",),
    "responses": ("models/asking/answers.py", "models/framing.py", "models/reading/interpret.py", "models/request.py"),
    "votes": ("judging/panel.py", "judging/rules.py", "models/reading/judged_answers.py"),
    "verdicts": ("judging/verdicts.py",),
    "confabulation": ("judging/confabulation.py", "judging/confabulation_protocol.py"),
    "hidden_states": ("mechanism/hidden_states.py", "models/local/capture.py"),
    "probes": ("mechanism/probes.py", "mechanism/probing.py"),
    "probe_baselines": ("mechanism/baselines.py",),
    "steering": ("mechanism/steering.py", "mechanism/hook.py"),
    "steering_fluency": ("mechanism/fluency.py",),
    "steering_votes": ("mechanism/steering.py",),
    "steering_effects": ("mechanism/shares.py", "mechanism/effects.py"),
    "steering_shares": ("mechanism/shares.py",),
    "steering_nulls": ("mechanism/nulls.py",),
    "steering_pecs": ("mechanism/nulls.py",),
    "gate": ("mechanism/gate.py", "mechanism/gating.py"),
    "patching": ("mechanism/patching_effects.py", "mechanism/patching_stage.py"),
}  # else the module of the stage's own name


def codes() -> dict[str, list[str]]:
    """Return by stage its code, and the digest of what decides its rows."""
    found = {}
    for stage in the_graph().stages:
        if not is_followed(stage.code):
            paths = _DECIDED_BY.get(stage.name, (f"mechanism/{stage.name}.py",))
            found[stage.name] = [stage.code, digest([statements(path) for name in paths for path in _files(name)])[:16]]
    return found


def is_followed(code: str) -> bool:
    """Return whether a code is the digest of a group's files (`stage.code_of`)."""
    return len(code) == 12


def statements(path: Path) -> str:
    """Return a module's source without comments, docstrings, errors' sentences and white space.

    It is the same for all versions of Python.
    """
    source = path.read_text(encoding="utf-8")
    lines = source.splitlines()
    comments = [t for t in tokenize.generate_tokens(io.StringIO(source).readline) if t.type == tokenize.COMMENT]
    for comment in comments:
        lines[comment.start[0] - 1] = lines[comment.start[0] - 1][: comment.start[1]]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            unread, kept = node.body[0], ""
        elif isinstance(node, ast.Raise):
            unread, kept = node, "raise"
        else:
            continue
        lines[unread.lineno - 1 : unread.end_lineno] = [kept] + [""] * ((unread.end_lineno or 0) - unread.lineno)
    return "".join("".join(lines).split())


def _files(name: str) -> list[Path]:
    path = PACKAGE / name
    return sorted(path.rglob("*.py")) if path.is_dir() else [path]


if __name__ == "__main__":
    REVIEWED.write_text(json.dumps(codes(), indent=1) + "\n", encoding="utf-8")
