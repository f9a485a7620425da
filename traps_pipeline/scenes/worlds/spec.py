"""Define the records of `scene_specs/`, and read and write their trajectories."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from traps_pipeline.base.digests import digest
from traps_pipeline.base.files import replace_file
from traps_pipeline.base.suggestions import did_you_mean
from traps_pipeline.protocol.datasets import RECORDED

if TYPE_CHECKING:
    from traps_pipeline.scenes.physics.kit import Physics

Slug = r"^[a-z0-9_]+-[a-z0-9]+$"


class _Strict(BaseModel):
    """Values of exactly these names and types, no number infinite."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


Length = Annotated[float, Field(ge=-100, le=100)]  # metres; a scene is a few metres wide
Angle = Annotated[float, Field(ge=-720, le=720)]  # degrees


class Footage(_Strict):
    """The length of a record's clips in seconds, and their frames per second."""

    duration_s: float = Field(ge=1, le=60)
    fps: int = Field(ge=1, le=60)


class _Physics(Footage):
    """`kit.Physics` in a record."""

    timestep_s: float = Field(ge=1e-5, le=0.02)
    gravity_m_s2: float = Field(ge=0, le=30)
    iterations: int = Field(ge=1, le=10_000)
    tolerance: float = Field(ge=0, le=1e-2)
    impratio: float = Field(ge=0.01, le=1000)
    speed: float = Field(default=1.0, ge=1, le=10)


class _Camera(_Strict):
    """`camera.Camera` in a record."""

    lookat: list[Length] = Field(min_length=3, max_length=3)
    distance: float = Field(gt=0, le=100)
    azimuth_deg: Angle
    elevation_deg: float = Field(ge=-90, le=90)
    fovy_deg: float = Field(gt=0, lt=180)
    extent: float = Field(gt=0, le=100)
    centre: list[Length] = Field(min_length=3, max_length=3)


class _Box(_Strict):
    """`camera.Occluder` in a record."""

    centre: list[Length] = Field(min_length=3, max_length=3)
    half: list[Length] = Field(min_length=3, max_length=3)
    yaw_deg: Angle


class _Occluder(_Strict):
    panel: _Box
    hidden_from_frame: int = Field(ge=0)


class _Truncation(_Strict):
    cut_frame: int = Field(ge=1)


class _Closing(_Strict):
    """When the occluder of the void comes in the control (occluder)."""

    closes_frame: int = Field(ge=1)


class _ClosingOccluder(_Closing):
    """When an occluder comes in the control, and which (truncation)."""

    panel: _Box


class _Recording(_Strict):
    """What stands in the parameters' place where nothing was simulated: picture size, digest of each side's clip."""

    size: list[int] = Field(min_length=2, max_length=2)
    clips: dict[Literal["control", "void", "twin"], str]


class _RecordedVoid(_Strict):
    """How a recorded void hides its outcome: under a board (cover), or as another clip."""

    hidden_from_frame: int = Field(ge=0)
    cover: list[int] | None = Field(default=None, min_length=4, max_length=4, description="x, y, width, height")


def check_labels(labels: Sequence[str], aliases: Mapping[str, str], answers: Iterable[str]) -> None:
    """Raise ValueError for a label that occurs twice, and for an answer or an alias of none of them."""
    if len(set(labels)) != len(labels):
        raise ValueError(f"labels {labels} repeat")
    for answer in answers:
        if answer not in labels:
            raise ValueError(f"answer {answer!r} is not one of {labels}{did_you_mean(answer, labels)}")
    if unknown_labels := sorted({*aliases.values()} - {*labels}):
        raise ValueError(f"aliases point to unknown labels {unknown_labels}; labels are {labels}")


class Answerable(BaseModel):
    """A question that both videos of the pair answer, with its labels and its answer."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    question: str = Field(min_length=1)
    labels: list[str] = Field(min_length=2)
    answer: str


class Twin(BaseModel):
    """Another world behind the same void: what differs, outcome, trajectory's digest.

    params: the whole scene with another hidden element (occlusion), or none: the same scene from another start
    (chaotic). Of recorded video it is a clip of another outcome, or empty. rollout: which of the perturbed starts
    that follow from the record's seed and from the first row of its trajectory (`ensemble.Futures`); the first row of
    the twin's own trajectory is that start rounded to float32, which has another future.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    params: dict[str, Any] | None
    rollout: int | None = Field(default=None, ge=0)
    ground_truth: str
    trajectory_sha256: str


class SceneSpec(BaseModel):
    """One scenario, resolved: nothing is left to chance or to the code's defaults.

    control: the first frame in which an occluder covers the control's outcome, and that occluder unless it is the
    void's; None if the control has no closing occluder.

    Hashes: `scene_hash` covers what decides the pixels (family, params, physics, camera, void, trajectory, twin),
    `spec_hash` covers everything. Both are derived, never read from the file.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    scenario_id: str = Field(pattern=Slug, max_length=80)
    taxonomy: Literal["occlusion", "chaotic"]
    category: str
    sub_scenario: str
    family: str
    seed: int
    params: dict[str, Any]
    physics: dict[str, Any]
    camera: dict[str, Any]
    void_kind: Literal["occluder", "truncation"]
    void: dict[str, Any]
    control: dict[str, Any] | None = None
    question: str = Field(min_length=1)
    labels: list[str] = Field(min_length=2)
    aliases: dict[str, str]
    answer_type: str
    ground_truth: str
    ill_posed_question: str = Field(min_length=1)
    answerable_question: Answerable | None
    trajectory_sha256: str
    twin: Twin
    evidence: dict[str, Any]

    @model_validator(mode="after")
    def _labels_agree(self) -> SceneSpec:
        check_labels(self.labels, self.aliases, [self.ground_truth])
        aside = self.answerable_question
        if aside is not None and aside.answer not in aside.labels:
            raise ValueError(f"answerable_question: answer {aside.answer!r} is not one of its labels")
        if self.is_recorded:
            return self
        if aside is None:
            raise ValueError("answerable_question: is missing")
        is_cut = self.void_kind == "truncation"
        if (self.twin.params is None) != is_cut or (self.twin.rollout is not None) != is_cut:
            raise ValueError("twin: an occluder's has `params` and no `rollout`, a truncation's has a `rollout` alone")
        return self

    @model_validator(mode="after")
    def _what_decides_the_pixels_is_plausible(self) -> SceneSpec:
        if self.is_recorded:
            physics = checked(Footage, "physics", self.physics)
            checked(_Recording, "params", self.params)
        else:
            physics = check_camera_and_physics(self.camera, self.physics)
        hiding = _RecordedVoid if self.is_recorded else _Occluder
        void = checked(_Truncation if self.void_kind == "truncation" else hiding, "void", self.void)
        frame = void.cut_frame if isinstance(void, _Truncation) else void.hidden_from_frame
        frames = {"void": frame}
        if self.control is not None:
            kind = _ClosingOccluder if self.void_kind == "truncation" else _Closing
            frames["control"] = checked(kind, "control", self.control).closes_frame
        for name, at in frames.items():
            if at >= physics.duration_s * physics.fps:
                raise ValueError(f"{name}: frame {at} is not in a clip of {physics.duration_s} s at {physics.fps} FPS")
        return self

    @property
    def is_recorded(self) -> bool:
        """Whether the clips are somebody's video, with no physics behind them."""
        return self.family == RECORDED

    @property
    def closes_frame(self) -> int | None:
        """The frame from which an occluder stands before the outcome; None if none."""
        return None if self.control is None else self.control["closes_frame"]

    @property
    def scene_hash(self) -> str:
        """The digest of the clips' content; a corrected question does not change it."""
        parts = ("family", "params", "physics", "camera", "void_kind", "void", "control", "trajectory_sha256", "twin")
        record = self.model_dump(mode="json", include=set(parts))
        return digest(record)

    @property
    def spec_hash(self) -> str:
        """The digest of the whole record as JSON."""
        return digest(self.model_dump(mode="json"))


def physics_record(physics: Physics) -> dict[str, Any]:
    """Return `kit.Physics` as records store it, without a default speed."""
    return {name: value for name, value in asdict(physics).items() if name != "speed" or value != 1.0}


_Part = TypeVar("_Part", bound=_Strict)


def checked(kind: type[_Part], name: str, values: dict[str, Any]) -> _Part:
    """Return a validated part of a record. Raises ValueError naming the field."""
    try:
        return kind.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        raise ValueError(f"{'.'.join(map(str, (name, *first['loc'])))}: {first['msg']}") from None


def check_camera_and_physics(camera: dict[str, Any], physics: dict[str, Any]) -> _Physics:
    """Return a record's physics; raise ValueError for implausible values, naming the field."""
    checked(_Camera, "camera", camera)
    return checked(_Physics, "physics", physics)


def trajectory_digest(qpos: np.ndarray) -> str:
    """Return the SHA-256 over shape and little-endian float32 values."""
    values = np.ascontiguousarray(qpos, dtype="<f4")
    return hashlib.sha256(repr(values.shape).encode() + values.tobytes()).hexdigest()


def save_trajectory(folder: Path, scenario_id: str, worlds: Mapping[str, np.ndarray]) -> None:
    """Write `<folder>/<scenario_id>.npz`: trajectories (`qpos`) of a scenario and of its twins, by name."""
    plain_arrays = {name: np.ascontiguousarray(values, dtype="<f4") for name, values in worlds.items()}
    with replace_file(folder / f"{scenario_id}.npz") as part, part.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **plain_arrays)


def load_trajectory(path: Path, sha256: str, world: str = "qpos") -> np.ndarray:
    """Return qpos (F, nq) float32 of a scenario or of a twin. Raises ValueError naming a missing or altered file."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            qpos = archive[world]
    except FileNotFoundError:
        raise ValueError(f"{path}: no such trajectory; restore it from git or remove its record") from None
    except Exception as error:
        raise ValueError(f"{path}: not a readable trajectory ({error}); restore it from git") from error
    digest = trajectory_digest(qpos)
    if digest != sha256:
        raise ValueError(f"{path}: digest {digest[:12]} is not the record's {sha256[:12]}; restore the file from git")
    return qpos
