"""Flights of some seconds over the feature benchmark's unseen places, and over its NEON plots."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.features.pairs import DEGREES, METRES, SIZE, UNSEEN_GROUPS, MadePlaces
from benchmarks.features.real import plane_view, plot_dates, unseen_plots
from localizer.errors import SequenceError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose, so3_exp
from localizer.synth.appearance.model import apply_appearance, sample_appearance
from localizer.synth.heightfield.render import render
from localizer.training.data.batches import tamed
from localizer.training.data.pairs import (
    draw_place,
    draw_views,
    lived_scene,
    look_at,
    survey_scene,
    visit_of,
)
from localizer.training.data.shards import PhotoSource
from localizer.training.places.photos import read_photo
from localizer.types import Float32, Image, RenderedView

INTERVAL_S = 0.5
NEON = "neon"
_FIRST_SEED = {"test": 5_500_000, "validation": 4_500_000}
_SPEED, _PLOT_SPEED = 12.0, 1.5  # m/s; a plot has 40 m
_TRIES = 1000  # of a path that stays on its plot
_DRIFT_MPS, _SHAKE_DEG = 0.2, 0.2  # of a beginning from frame to frame
ALIKE, OWN, TRUE = "alike", "own", "true"
BEGINNINGS = (ALIKE, OWN, TRUE)

See = Callable[[Pose], tuple[Image, Float32]]


@dataclass(frozen=True)
class SequenceFrame:
    """One frame: the map's views from where a tracker may believe to be, and the query's image.

    views: by beginning. ALIKE err by the same 5 m and 5 degrees in all frames, with a drift and the
    gimbal's shake; every OWN errs by as much in a direction of its own; TRUE does not err.
    """

    views: Mapping[str, RenderedView]
    query: Image
    truth: Pose


@dataclass(frozen=True)
class _Scene:
    survey: See
    lived: See
    camera: Camera
    truths: list[Pose]
    weather: str


def made_sequence(
    condition: str, place: int, frames: int, split: str, textures: Path
) -> Iterator[SequenceFrame]:
    """Over one generated place on one day of a condition."""
    seed = _FIRST_SEED[split] + place
    rng = np.random.default_rng(seed)
    scenes = MadePlaces(split, 0, False, textures).scenes
    library = PhotoSource(textures, UNSEEN_GROUPS, held_out=True).library()
    ground, _ = draw_place(rng, scenes, library)
    survey = survey_scene(rng, ground, scenes)
    visit = visit_of(rng, condition)
    lived, _ = lived_scene(rng, ground, visit, None, False)
    top = max(survey.height.max(), lived.height.max()) + 15.0
    while True:
        views = draw_views(rng, survey, lived, scenes)
        if views is None:
            continue
        truths = _path(rng, views[1], frames, _SPEED)
        if min(t.translation[2] for t in truths) > top:
            break
    scene = _Scene(
        lambda pose: render(survey, pose, views[2]),
        lambda pose: render(lived, pose, views[2], supersample=2),
        views[2], truths, visit.weather,
    )  # fmt: skip
    yield from _flown(scene, rng)


def plot_sequence(place: int, frames: int, textures: Path) -> Iterator[SequenceFrame]:
    """Over a plot that was photographed in two seasons: one is the map, the other the flight."""
    plots = unseen_plots(textures / "neon_sjer_pairs")
    plot, dry_map = plots[place // 2 % len(plots)], bool(place % 2)
    dates = [read_photo(p) for p in plot_dates(plot)]
    surveyed, flown = dates[:: -1 if dry_map else 1]
    rng = np.random.default_rng((place, 4))
    for _ in range(_TRIES):
        camera = Camera.from_fov(*SIZE, rng.uniform(35, 50))
        pitch = np.radians(rng.uniform(70, 90))
        at = np.array([*rng.uniform(-10, 10, 2), 0.0])
        first = look_at(at, rng.uniform(22, 30) / np.sin(pitch), pitch, rng)
        truths = _path(rng, first, frames, _PLOT_SPEED)
        if all((plane_view(flown, t, camera)[1] > 0).mean() > 0.97 for t in truths):
            break
    else:
        raise SequenceError(f"{plot}: {frames} frames do not fit on it: ask for fewer")
    scene = _Scene(
        lambda pose: plane_view(surveyed, pose, camera),
        lambda pose: plane_view(flown, pose, camera),
        camera, truths, "day",
    )  # fmt: skip
    yield from _flown(scene, rng)


def _path(rng: np.random.Generator, first: Pose, frames: int, speed: float) -> list[Pose]:
    """Level flight with gentle turns; the camera turns with the vehicle and shakes."""
    heading, rate = rng.uniform(0, 2 * np.pi), 0.0
    rotation, position = first.rotation, first.translation
    path = []
    for _ in range(frames):
        shake = so3_exp(np.radians(rng.normal(0.0, 0.5, 3)))
        path.append(Pose(shake @ rotation, position))
        rate = 0.8 * rate + rng.normal(0.0, np.radians(2.0))
        heading += rate * INTERVAL_S
        rotation = so3_exp((0.0, 0.0, rate * INTERVAL_S)) @ rotation
        way = np.array([np.cos(heading), np.sin(heading), 0.0]) * speed * INTERVAL_S
        position = position + way + np.array([0.0, 0.0, rng.normal(0.0, 0.15)])
    return path


def _flown(scene: _Scene, rng: np.random.Generator) -> Iterator[SequenceFrame]:
    look = sample_appearance(rng, scene.weather)
    shift, turn = _of_length(rng, METRES), _of_length(rng, np.radians(DEGREES))
    wrong = rng.normal(0.0, _DRIFT_MPS, 3)
    own = rng.spawn(1)[0]
    for k, truth in enumerate(scene.truths):
        shake = np.radians(rng.normal(0.0, _SHAKE_DEG, 3))
        begins = {
            ALIKE: _beside(truth, shift + wrong * INTERVAL_S * k, turn + shake),
            OWN: _beside(truth, _of_length(own, METRES), _of_length(own, np.radians(DEGREES))),
            TRUE: truth,
        }
        image, depth = scene.lived(truth)
        query = apply_appearance(image, depth, tamed(look, depth), rng)
        views = {
            name: RenderedView(*scene.survey(pose), pose, scene.camera)
            for name, pose in begins.items()
        }
        yield SequenceFrame(views, query, truth)


def _beside(truth: Pose, shift: Array, turn: Array) -> Pose:
    return Pose(so3_exp(turn) @ truth.rotation, truth.translation + shift)


def _of_length(rng: np.random.Generator, length: float) -> Array:
    direction = rng.standard_normal(3)
    vector: Array = direction * length / np.linalg.norm(direction)
    return vector
