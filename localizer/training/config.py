"""The configuration of one training run: one YAML file, every key documented there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import yaml
from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationError,
    model_validator,
)

from localizer.errors import ModelError
from localizer.plain_files import load_yaml, misread_booleans, plain_text
from localizer.synth.heightfield.scene import BLOCK
from localizer.training.data.pairs import SceneConfig
from localizer.training.models.networks import NetworkConfig
from localizer.training.places.land import PhotoLibrary

_MOST_WORKERS = 1024  # processes or threads
_MOST_STEPS = 10**9
_Side = Annotated[int, Field(gt=0, le=8192)]  # of an image, pixels
_Weight = Annotated[float, Field(ge=0.0, le=1000.0)]  # of a loss; less than 0 would be learned
_Error = Annotated[float, Field(ge=0.0, le=1000.0)]  # pixels


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class _PlacesSection(_Frozen):
    """Keys of the places and visits of both kinds of data. workers: processes that make places; of
    live pairs also the threads that render them.
    """

    first_seed: int = Field(ge=1000, lt=2**31)
    scenes: int = Field(gt=0, lt=2**31)
    photos: Path | None
    photo_groups: tuple[str, ...]
    photo_share: float = Field(ge=0.0, le=1.0)
    workers: int = Field(gt=0, le=_MOST_WORKERS)
    image: tuple[_Side, _Side]

    def scene_config(self) -> SceneConfig:
        """Scene configuration of the run."""
        width, height = self.image
        return SceneConfig(photo_share=self.photo_share, width=width, height=height)

    def library(self) -> PhotoLibrary | None:
        """The real textures of the run; None if it uses none."""
        return None if self.photos is None else PhotoLibrary(self.photos, self.photo_groups)


class DataSection(_PlacesSection):
    """Pairs on disk. Shards are generated in the order of their seeds, with views of `image`
    (width, height).
    """

    shards: Path
    image: tuple[_Side, _Side] = (256, 192)
    initial_scenes: int = Field(gt=0, lt=2**31)
    scenes_per_step: float = Field(ge=0.0, le=1e6)
    worlds: int = Field(ge=0, lt=2**31)
    world_share: float = Field(ge=0.0, le=1.0)
    world_first_step: int = Field(ge=0, le=_MOST_STEPS)


class LiveSection(_PlacesSection):
    """Pairs rendered while training (`training.data.live`). image: width, height of a view;
    cells: side of a place; active: number of places that a step draws from; one of them is replaced
    every `steps_per_scene` steps; flight_days: number of days on which each place is seen.
    """

    live: Literal[True]
    cells: int = Field(gt=0, le=16384, multiple_of=BLOCK)
    active: int = Field(gt=0)
    steps_per_scene: int = Field(gt=0, le=_MOST_STEPS)
    flight_days: int = Field(gt=0, le=1000)

    def scene_config(self) -> SceneConfig:
        """See `_PlacesSection.scene_config`."""
        return replace(super().scene_config(), cells=self.cells)

    @model_validator(mode="after")
    def _places_suffice(self) -> LiveSection:
        if self.scenes < self.active:
            raise ValueError(f"scenes {self.scenes} are fewer than active {self.active}")
        return self


def _kind(data: object) -> str:
    live = data.get("live", False) if isinstance(data, dict) else isinstance(data, LiveSection)
    return "live" if live else "shards"


Data = Annotated[
    Annotated[DataSection, Tag("shards")] | Annotated[LiveSection, Tag("live")],
    Discriminator(_kind),
]


class OptimizerSection(_Frozen):
    """Steps and step sizes. The rate warms up, stays constant, and falls to zero as a cosine over
    the last `decay_steps`, so that the length of a run can be changed until its decay begins. Eq. 3
    is used from `alignment_first_step` on. The contrast searches levels of at most
    `whole_map_cells` completely.
    """

    steps: int = Field(gt=0, le=_MOST_STEPS)
    decay_steps: int = Field(gt=0)
    mixed_precision: bool
    batch: int = Field(gt=0, le=65536)
    crop: tuple[_Side, _Side]
    anchors: int = Field(ge=32)
    learning_rate: float = Field(ge=1e-9, le=1.0)
    warmup_steps: int = Field(ge=0, le=_MOST_STEPS)
    weight_decay: float = Field(ge=0.0, le=1.0)
    ema_decay: float = Field(gt=0.0, lt=1.0)
    contrast_weight: _Weight
    alignment_weight: _Weight
    alignment_ramp_steps: int = Field(ge=1, le=_MOST_STEPS)
    alignment_first_step: int = Field(default=0, ge=0, le=_MOST_STEPS)
    whole_map_cells: int = Field(default=1200, ge=0, le=10**6)
    lm_iterations: int = Field(gt=0, le=1000)
    start_error_px: tuple[_Error, _Error, _Error]
    threads: int = Field(gt=0, le=_MOST_WORKERS)

    @model_validator(mode="after")
    def _decay_fits(self) -> OptimizerSection:
        if self.decay_steps > self.steps:
            raise ValueError(f"decay_steps {self.decay_steps} exceeds steps {self.steps}")
        if self.crop[0] * self.crop[1] < 2 * self.anchors:
            raise ValueError(f"crop {self.crop} has too few pixels for {self.anchors} anchors")
        return self


class TrainConfig(_Frozen):
    """A whole run. warm_start: checkpoint whose averaged weights are the first ones."""

    name: str = Field(pattern=r"^\w[\w.-]*$")  # of files
    seed: int = Field(ge=0, lt=2**31)
    output: Path
    checkpoint_steps: int = Field(gt=0, le=_MOST_STEPS)
    warm_start: Path | None = None
    model: NetworkConfig
    data: Data
    optimizer: OptimizerSection

    @model_validator(mode="after")
    def _crop_fits(self) -> TrainConfig:
        crop, image = self.optimizer.crop, self.data.image
        if any(side % 8 for side in crop):
            raise ValueError(f"crop {crop} has a side that is not divisible by 8")
        if crop[0] > image[0] or crop[1] > image[1]:
            raise ValueError(f"crop {crop} exceeds the image {image}")
        return self


def load_config(path: Path) -> TrainConfig:
    """Read a training configuration from a YAML file. `ModelError` names the file, and unknown keys
    or bad values.
    """
    try:
        data = load_yaml(plain_text(path))
        config = TrainConfig.model_validate(data)
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        wrong = [f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors()]
        raise ModelError(f"{path}: {'; '.join(wrong)}") from error
    # ValueError: no UTF-8, or a value that does not hold; RecursionError: endless nesting.
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ModelError(f"{path}: {' '.join(str(error).split())}") from error
    if wrong := [f"{'.'.join(map(str, where))}: is {str(value).lower()}, not a number or a text"
                 for where, value in misread_booleans(data, config)]:  # fmt: skip
        raise ModelError(f"{path}: {'; '.join(wrong)}")
    return config
