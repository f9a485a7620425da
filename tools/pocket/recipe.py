"""`assets/pocket/recipe.yaml`: the scenes and settings with which the pocket model is trained."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from tools.pocket.words import PROMPTS
from traps_pipeline.base.paths import ASSETS
from traps_pipeline.base.yamlfile import parse_yaml_model, read_yaml
from traps_pipeline.scenes.family_registry import family_names
from traps_pipeline.storage.media import MediaSpec

POCKET = ASSETS / "pocket"
RECIPE = POCKET / "recipe.yaml"
GAP, NO_GAP = "pocket", "pocket-no-gap"  # their entries in models.yaml
SHIPPED = {GAP: POCKET, NO_GAP: POCKET / "no_gap"}  # folder of each: recipe, weights, facts, figures
LANES = POCKET / "lanes"  # of `pocket-lanes`: the same
Split = Literal["train", "held-out"]


class Training(BaseModel):
    """How the weights are fitted. stop: the step with which training ends early, while its rate is not yet 0;
    void_share: share of void clips in a batch; brightness: augmentation; naming: weight of the naming loss;
    naming_steps: number of first steps with the naming loss alone; pairs: from a step on, how many pairs of frames of
    each clip are shown (`batches.Scenes.pairs`); all before the first."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    steps: int = Field(ge=1)
    stop: int | None = None
    batch: int = Field(ge=1)
    learning_rate: float = Field(gt=0)
    warmup_steps: int = Field(ge=0)
    weight_decay: float = Field(ge=0)
    void_share: float = Field(ge=0, le=1)
    brightness: float = Field(ge=0, lt=1)
    naming: float = Field(ge=0)
    naming_steps: int = Field(ge=0)
    pairs: dict[int, int]

    @property
    def last(self) -> int:
        """The step with which training ends."""
        return self.stop or self.steps

    def pairs_at(self, step: int) -> int | None:
        """Return how many pairs of frames are shown at a step; None for all."""
        begun = [first for first in self.pairs if first <= step]
        return self.pairs[max(begun)] if begun else None


class Jitter(BaseModel):
    """How the lengths of chaotic clips, and so their time stamps, overlap. control: share of controls that begin late,
    so that they are as short as a void; void: share of voids whose last frame is held until the control's end."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    control: float = Field(ge=0, le=1)
    void: float = Field(ge=0, le=1)


class Hedge(BaseModel):
    """Prompts under which abstentions say nothing of the side: voids and controls have the same share of them, by the
    colour of the ball. balls: share by colour; share: of all other colours."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    prompts: tuple[str, ...] = Field(min_length=1)
    balls: dict[str, Annotated[float, Field(ge=0, lt=0.5)]]
    share: float = Field(ge=0, lt=0.5)


class Recipe(BaseModel):
    """Number of training scenes by family, held-out scenes per family, how a clip is shown, and its labels.

    decoys: share of looks at an occlusion control in which an occluder stands where it hides nothing; without it, the
    occluder would tell the side. abstain_shares: by prompt (one of `words.PROMPTS`), the share of voids labelled with
    an abstention; a void that is so under one prompt is so under every prompt with a larger share. hedge: of the other
    prompts. two_events: scenes have two lanes (`lanes.py`), and neither jitter nor decoys. start: the shipped model
    whose weights training begins with.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    scenes: dict[str, int] = Field(min_length=1)
    held_out: int = Field(ge=1)
    data_seed: int = Field(ge=0)
    media: MediaSpec
    abstain_shares: dict[str, Annotated[float, Field(ge=0, le=1)]]
    hedge: Hedge | None = None
    jitter: Jitter = Jitter(control=0, void=0)
    decoys: float = Field(default=0, ge=0, le=1)
    two_events: bool = False
    start: Literal["pocket", "pocket-no-gap"] | None = None
    training: Training

    def content(self, *only: str) -> dict[str, Any]:
        """Return the settings (only: these) of the file for a digest."""
        dumped = self.model_dump(mode="json", include={*only} or None, exclude_unset=True)
        return dumped | ({"media": self.media.content()} if "media" in dumped else {})

    @field_validator("scenes")
    @classmethod
    def _families_exist(cls, value: dict[str, int]) -> dict[str, int]:
        unknown = sorted(set(value) - set(family_names()))
        if unknown:
            raise ValueError(f"unknown families {unknown}; known: {', '.join(family_names())}")
        return value

    @model_validator(mode="after")
    def _every_prompt_has_one_share(self) -> Recipe:
        named = [*self.abstain_shares, *(self.hedge.prompts if self.hedge else ())]
        if sorted(named) != sorted(PROMPTS):
            raise ValueError(
                f"abstain_shares and hedge name {sorted(named)}; each of {', '.join(PROMPTS)} must be in one of them"
            )
        return self

    def share(self, prompt_name: str, ball: str, *, void: bool) -> float:
        """Return the share of abstentions among the labels of a side's questions under a prompt; ball: its colour."""
        if self.hedge is not None and prompt_name in self.hedge.prompts:
            return self.hedge.balls.get(ball, self.hedge.share)
        return self.abstain_shares.get(prompt_name, 0.0) if void else 0.0

    def count(self, family: str, split: Split) -> int:
        """Return scenes of a family in a split."""
        return self.scenes[family] if split == "train" else self.held_out


def load_recipe(path: Path = RECIPE) -> Recipe:
    """Return the recipe. Raises TrapsError naming the field that is wrong."""
    return parse_yaml_model(Recipe, read_yaml(path), path)
