"""Training pairs: a reference view of the map and a query view of the same place, both posed.

The reference shows the map as it was surveyed. The query shows the place later: other sun, season
and objects, from a pose 5-15 m and 5-15 deg away, as in the paper, or closer, as in video. Light,
weather and sensor are put on the query afterwards (`localizer.synth.appearance.model`), by depth.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose, so3_exp
from localizer.synth.appearance.model import CONDITIONS
from localizer.synth.heightfield.render import render
from localizer.synth.heightfield.scene import (
    Land,
    LitScene,
    SkyLight,
    compose,
    height_at,
    light_scene,
    omit_randomly,
)
from localizer.synth.visits.visit import draw_texel, with_new_texture, with_wet_patches
from localizer.training.places.land import PhotoLibrary, generated_place, photo_place
from localizer.training.places.objects import (
    TrainingPlace,
    coarse_mesh,
    new_buildings,
    parked_cars,
    plain_walls,
    season_shift,
)
from localizer.types import Float32, Image

FIRST_WORLD_SEED = 1000  # those below belong to demos and tests
SEASON, OUTDATED, COMBINED = "season", "outdated map", "combined"
_PLAIN_WALLS = 0.4  # share of the maps whose facades were not photographed
_COARSE_MESH = 0.8  # share of the maps on a photogrammetric mesh instead of the true surface
_OVERLAP = 0.45  # least share of the reference's surface that the query must see


@dataclass(frozen=True)
class Pair:
    """Both views of one pair. reference, query: (H, W, 3) uint8; depths (H, W) float32, metres
    along the axis, 0 = sky. The query has no weather yet; its `condition` states which to apply.
    outdated: whether buildings are gone or new; season: whether the query's vegetation is of
    another time of year.
    """

    reference: Image
    reference_depth: Float32
    query: Image
    query_depth: Float32
    world_from_reference: Pose
    world_from_query: Pose
    camera: Camera
    condition: str
    outdated: bool
    source: str
    season: bool = False


@dataclass(frozen=True)
class SceneConfig:
    """Size and variety of the scenes and views. cell_m: range of a cell's size, which
    sets the altitude. conditions: one for each light in turn (`named_conditions`); empty: drawn.
    motion: exact metres and degrees between the two views; None: the training's mixture.
    """

    cells: int = 1024
    width: int = 256
    height: int = 192
    photo_share: float = 0.5
    references: int = 10
    queries_per_light: int = 5
    cell_m: tuple[float, float] = (0.2, 2.2)
    conditions: tuple[str, ...] = ()
    motion: tuple[float, float] | None = None


@dataclass(frozen=True)
class FlightDay:
    """Conditions of a flight. weather: weather or light, of `CONDITIONS`; outdated: whether
    buildings have changed; season: whether the season differs from the map's; None: drawn.
    """

    weather: str
    outdated: bool
    season: bool | None


def scene_pairs(seed: int, config: SceneConfig, library: PhotoLibrary | None) -> Iterator[Pair]:
    """Yield all training pairs of the place of `seed`. library: None: generated ground only."""
    rng = np.random.default_rng(seed)
    place, source = draw_place(rng, config, library)
    survey = survey_scene(rng, place, config)
    lived: LitScene | None = None
    visit, season = FlightDay("day", False, None), False
    for k in range(config.references):
        if lived is None or k % config.queries_per_light == 0:
            if config.conditions:
                visit = named_conditions(rng, config.conditions[k // config.queries_per_light])
            else:
                visit = draw_visit(rng)
            lived, season = flight_day_scene(rng, place, visit)
        views = draw_views(rng, survey, lived, config)
        if views is not None:
            yield render_pair(survey, lived, views, visit, source, season=season)


def render_pair(
    survey: LitScene, lived: LitScene, views: tuple[Pose, Pose, Camera], visit: FlightDay,
    source: str, *, season: bool,
) -> Pair:  # fmt: skip
    """The reference's view of the survey and the query's view of the place later, without weather.
    views: as `draw_views` returns them.
    """
    reference, query, camera = views
    image, depth = render(survey, reference, camera)
    seen, seen_depth = render(lived, query, camera, supersample=2)
    return Pair(
        image, depth, seen, seen_depth, reference, query, camera, visit.weather, visit.outdated,
        source, season,
    )  # fmt: skip


def draw_place(
    rng: np.random.Generator, config: SceneConfig, library: PhotoLibrary | None
) -> tuple[TrainingPlace, str]:
    """Draw a place; also returns the source of its ground: "photo" or "generated"."""
    n = config.cells
    cell = float(np.exp(rng.uniform(*np.log(config.cell_m))))
    if library is not None and rng.random() < config.photo_share:
        return photo_place(rng, n, min(cell, 0.8), library.sample(rng, n)), "photo"
    return generated_place(rng, n, cell), "generated"


def draw_visit(rng: np.random.Generator) -> FlightDay:
    """Draw the conditions of a training flight."""
    return FlightDay(draw_condition(rng), bool(rng.random() < 0.4), None)


def survey_scene(rng: np.random.Generator, place: TrainingPlace, config: SceneConfig) -> LitScene:
    """The place on the survey day, as the map shows it: a baked texture on a coarse mesh."""
    prisms = [*place.prisms, *parked_cars(rng, place, _car_count(rng, place))]
    if rng.random() < _PLAIN_WALLS:
        prisms = plain_walls(prisms)
    light = _sun(rng, rng.uniform(30, 70), rng.uniform(0.0, 1.0))
    lit = light_scene(compose(place.land, prisms), light, _sky(rng, "day"), draw_texel(rng))
    return coarse_mesh(lit, rng) if rng.random() < _COARSE_MESH else lit


def flight_day_scene(
    rng: np.random.Generator, place: TrainingPlace, visit: FlightDay
) -> tuple[LitScene, bool]:
    """The place on the flight day, and whether its season differs from the map's."""
    land, prisms, season = place.land, list(place.prisms), False
    condition, outdated = visit.weather, visit.outdated
    if visit.season is not False:
        season = bool(place.seasons) and rng.random() < 0.6
        albedo = place.seasons[0] if season else land.albedo
        if rng.random() < 0.7 or (visit.season and not season):
            albedo, season = season_shift(albedo, rng), True
        land = Land(land.height, albedo, land.cell_m)
    albedo = with_new_texture(land.albedo, place.lasting, land.cell_m, rng)
    land = Land(land.height, with_wet_patches(albedo, place.lasting, rng), land.cell_m)
    if outdated:
        prisms = omit_randomly(prisms, rng, rng.uniform(0.03, 0.25))
        prisms += new_buildings(rng, place, int(rng.integers(3, 40)))
    prisms += parked_cars(rng, place, _car_count(rng, place))
    direct = 0.0 if condition in ("fog", "rain", "snow", "night") else 1.0
    if condition == "day" and rng.random() < 0.25:
        direct = 0.15
    if condition == "night" and rng.random() < 0.4:
        direct = 0.5  # moonlight
    elevation = rng.uniform(8, 22) if condition == "dusk" else rng.uniform(22, 75)
    sun = _sun(rng, elevation, direct)
    return light_scene(compose(land, prisms), sun, _sky(rng, condition)), season


def _car_count(rng: np.random.Generator, place: TrainingPlace) -> int:
    return int(rng.integers(0, 250)) if place.land.cell_m < 0.9 else 0


def _sun(rng: np.random.Generator, elevation_deg: float, direct: float) -> SkyLight:
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(elevation_deg)
    flat = np.cos(elevation)
    sun = (flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation))
    strength = direct * rng.uniform(0.7, 1.1)
    return SkyLight((float(sun[0]), float(sun[1]), float(sun[2])), strength, 1.15 - 0.7 * strength)


def _sky(rng: np.random.Generator, condition: str) -> tuple[float, float, float]:
    level = rng.uniform(0.6, 0.95)
    return (level * 0.85, level * 0.93, level) if condition == "day" else (level, level, level)


def draw_condition(rng: np.random.Generator) -> str:
    """The weather or light of a query, with the training's shares."""
    return str(rng.choice(CONDITIONS, p=(0.42, 0.15, 0.17, 0.1, 0.08, 0.08)))


def named_conditions(rng: np.random.Generator, condition: str) -> FlightDay:
    """Conditions of a named test: a weather, `SEASON`, `OUTDATED`, or any weather with both
    (`COMBINED`).
    """
    if condition == COMBINED:
        return FlightDay(str(rng.choice(CONDITIONS)), True, True)
    if condition in (SEASON, OUTDATED):
        return FlightDay("day", condition == OUTDATED, condition == SEASON)
    return FlightDay(condition, False, False)


def draw_views(
    rng: np.random.Generator, survey: LitScene, lived: LitScene, config: SceneConfig
) -> tuple[Pose, Pose, Camera] | None:
    """Draw (reference pose, query pose, camera) with enough common view; None after a few failed
    tries. survey, lived: the reference's scene and the query's.
    """
    for _ in range(12):
        fov = rng.uniform(30, 90)
        camera = Camera.from_fov(config.width, config.height, fov)
        reference, distance = _viewpoint(rng, survey, camera)
        query = moved(rng, reference, distance, config.motion)
        if not (_clear(survey, reference) and _clear(lived, query)):
            continue
        if _overlap(survey, reference, query, camera) >= _OVERLAP:
            return reference, query, camera
    return None


def _viewpoint(rng: np.random.Generator, scene: LitScene, camera: Camera) -> tuple[Pose, float]:
    """A camera 50-800 m up, 20-90 deg below the horizon, that sees cells at 0.5 to 2 px."""
    extent = scene.height.shape[0] * scene.cell_m
    x, y = rng.uniform(0.1, 0.9, 2) * extent
    gsd = scene.cell_m * np.exp(rng.uniform(np.log(0.6), np.log(2.0)))
    pitch = np.radians(90 - 70 * rng.random() ** 1.6)
    distance = float(np.clip(camera.fx * gsd, 50 / np.sin(pitch), 800 / np.sin(pitch)))
    target = np.array([x, y, height_at(scene, x, y)])
    return look_at(target, distance, pitch, rng), distance


def look_at(target: Array, distance: float, pitch_rad: float, rng: np.random.Generator) -> Pose:
    """A camera at `distance` from `target`, `pitch_rad` below the horizon; draws heading, roll."""
    yaw, roll = rng.uniform(0, 2 * np.pi), np.radians(rng.normal(0, 3))
    flat = np.cos(pitch_rad)
    forward = np.array([flat * np.cos(yaw), flat * np.sin(yaw), -np.sin(pitch_rad)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    rotation = np.stack([right, np.cross(forward, right), forward], 1) @ so3_exp((0, 0, roll))
    return Pose(rotation, target - distance * forward)


def moved(
    rng: np.random.Generator, pose: Pose, distance: float, exact: tuple[float, float] | None
) -> Pose:
    """Draw the query pose near `pose`: up to 15 m and 15 deg away. distance: m to the ground,
    limits the shift; exact: (metres, degrees) instead of drawn ones.
    """
    if rng.random() < 0.3:
        metres, degrees = rng.uniform(0, 3), rng.uniform(0, 3)
    else:
        metres, degrees = rng.uniform(3, 15), rng.uniform(2, 15)
    metres = min(metres, 0.15 * distance)
    if exact is not None:
        metres, degrees = exact
    shift, axis = rng.standard_normal(3), rng.standard_normal(3)
    shift *= metres / np.linalg.norm(shift)
    axis *= np.radians(degrees) / np.linalg.norm(axis)
    return Pose(so3_exp(axis) @ pose.rotation, pose.translation + shift)


def _clear(scene: LitScene, pose: Pose) -> bool:
    """Whether the camera is well above everything."""
    return bool(pose.translation[2] > scene.height.max() + 15.0)


def _overlap(scene: LitScene, reference: Pose, query: Pose, camera: Camera) -> float:
    """Share of the reference's pixels that project into the query, from a thumbnail."""
    small = camera.resized(32, 24)
    depth = render(scene, reference, small)[1]
    v, u = np.mgrid[0:24, 0:32] + 0.5
    points = reference.apply(small.rays(np.stack([u, v], -1)) * depth[..., None])
    inside = small.project(query.inverse.apply(points))[1] & (depth > 0)
    return float(inside.mean())


def soften(rng: np.random.Generator, image: Image) -> Image:
    """Blur a map texture slightly, half the time."""
    if rng.random() < 0.5:
        return image
    soft: Image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.4, 1.3))
    return soft


def relative_pose(pair: Pair) -> Array:
    """(4, 4) ``query_from_reference``."""
    return (pair.world_from_query.inverse @ pair.world_from_reference).matrix


@dataclass(frozen=True)
class PlaceVisits:
    """A place as surveyed, and on several flight days."""

    survey: LitScene
    days: tuple[tuple[LitScene, FlightDay, bool], ...]
    source: str


def make_place(
    seed: int, scenes: SceneConfig, photos: PhotoLibrary | None, flight_days: int
) -> PlaceVisits:
    """The place of a seed, lit and ready to render. photos: None: generated ground only."""
    rng = np.random.default_rng(seed)
    place, source = draw_place(rng, scenes, photos)
    survey = survey_scene(rng, place, scenes)
    days = []
    for _ in range(flight_days):
        visit = draw_visit(rng)
        lit, season = flight_day_scene(rng, place, visit)
        days.append((lit, visit, season))
    return PlaceVisits(survey, tuple(days), source)


def low_priority() -> None:
    """Initialise a worker process: low priority, one core."""
    os.nice(5)
    cv2.setNumThreads(1)
