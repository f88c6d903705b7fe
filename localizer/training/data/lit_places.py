"""Places with several days of flight, lit and ready to render."""

from __future__ import annotations

import os
from dataclasses import dataclass

import cv2
import numpy as np

from localizer.synth.heightfield.scene import LitScene
from localizer.training.data.pairs import (
    FlightDay,
    SceneConfig,
    draw_place,
    draw_visit,
    flight_day_scene,
    survey_scene,
)
from localizer.training.data.shards import PhotoSource


@dataclass(frozen=True)
class PlaceVisits:
    """A place as surveyed, and on several flight days."""

    survey: LitScene
    days: tuple[tuple[LitScene, FlightDay, bool], ...]
    source: str


def make_place(
    seed: int, scenes: SceneConfig, photos: PhotoSource | None, flight_days: int
) -> PlaceVisits:
    """The place of a seed, lit and ready to render. photos: None: generated ground only."""
    rng = np.random.default_rng(seed)
    place, source = draw_place(rng, scenes, None if photos is None else photos.library())
    survey = survey_scene(rng, place, scenes)
    days = []
    for _ in range(flight_days):
        visit = draw_visit(rng)
        fixed = None if scenes.light_variety else survey.light
        days.append((visit, *flight_day_scene(rng, place, visit, fixed)))
    return PlaceVisits(survey, tuple((lit, visit, season) for visit, lit, season in days), source)


def low_priority() -> None:
    """Initialise a worker process: low priority, one core."""
    os.nice(5)
    cv2.setNumThreads(1)
