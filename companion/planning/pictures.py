"""Images of a plan: the path coloured over the map, and a heat map of the risk on the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from companion.planning.plan import MissionForecast
from companion.planning.verdicts import LegVerdict, SampleVerdict
from companion.planning.way import Aim, camera_pose
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.render.numba_raster import NumbaRenderer
from localizer.render.topview import render_top_view
from localizer.types import Image

_SIDE_PX = 1000
_MARGIN = 0.12  # of the way's extent
_LEAST_HALF_M = 80.0
_GOOD, _DOUBTFUL, _BAD = (0.0, 0.05, 0.2)  # risk
_COLOURS = ((42, 157, 74), (224, 161, 0), (198, 40, 40))  # RGB
_WASH = 0.5  # of the heat map over the picture
_LINE_PX = 7


@dataclass(frozen=True)
class MapSquare:
    """Top view of a square of the map, north up. low: (2,) south-west corner, east and north, m;
    gsd_m: metres per pixel.
    """

    rgb: Image
    low: Array
    gsd_m: float

    def pixels(self, places: Array) -> Array:
        """Pixels (N, 2), column and row, of positions (N, 2), east and north."""
        flat = (places - self.low) / self.gsd_m
        return np.stack([flat[:, 0], self.rgb.shape[0] - flat[:, 1]], axis=1)


def render_map_square(plan: MissionForecast, cache: TileCache) -> MapSquare:
    """Render the map in a square around the plan's path, north up."""
    places = _places(_all(plan))
    low, high = places.min(axis=0), places.max(axis=0)
    half = max(float((high - low).max()) * (0.5 + _MARGIN), _LEAST_HALF_M)
    centre = (low + high) / 2
    gsd = 2 * half / _SIDE_PX
    with TileStreamer(cache) as streamer:
        renderer = NumbaRenderer(streamer)
        try:
            base = float(cache.index.box_min[0, 2])
            rgb = render_top_view(renderer, centre, _SIDE_PX, gsd, base).rgb
        finally:
            renderer.close()
    return MapSquare(rgb, centre - half, gsd)


def track_picture(sheet: MapSquare, plan: MissionForecast) -> Image:
    """The path in green (works), amber (doubtful) and red (fails), with numbered waypoints."""
    picture = sheet.rgb.copy()
    for verdict in plan.verdicts:
        pixels = sheet.pixels(_places(verdict.samples))
        for judged, pixel in zip(verdict.samples, pixels, strict=True):
            half = _half_step(verdict, judged, sheet.gsd_m)
            a, b = np.int32(np.stack([pixel - half, pixel + half]) * 16).tolist()
            cv2.line(picture, a, b, (20, 20, 20), _LINE_PX + 4, cv2.LINE_AA, 4)
            cv2.line(picture, a, b, colour_of(judged), _LINE_PX, cv2.LINE_AA, 4)
    for verdict in plan.verdicts:
        start = sheet.pixels(_places(verdict.samples))[0]
        start = start - _half_step(verdict, verdict.samples[0], sheet.gsd_m)
        _label(picture, start, verdict.leg.name.split(" to ")[0])
    return _with_legend(picture, ("works", "doubtful", "fails"))


def heat_picture(
    sheet: MapSquare, plan: MissionForecast, cache: TileCache, camera: Camera, aim: Aim
) -> Image:
    """The ground in view, coloured by the mean risk of the samples that see it."""
    total = np.zeros(sheet.rgb.shape[:2], np.float32)
    count = np.zeros_like(total)
    for judged in _all(plan):
        corners = _footprint(judged, cache, camera, aim)
        if corners is None:
            continue
        seen = np.zeros(total.shape, np.uint8)
        hull = cv2.convexHull(np.float32(sheet.pixels(corners)))
        cv2.fillConvexPoly(seen, np.int32(hull), 1)
        total += seen * np.float32(judged.forecast.risk if judged.holds else 1.0)
        count += seen
    share = np.clip(total / np.maximum(count, 1), 0, 1)
    position = np.interp(share, (_GOOD, _DOUBTFUL, _BAD, 1.0), (0.0, 0.5, 1.0, 1.0))[..., None]
    green, amber, red = (np.array(c, np.float32) for c in _COLOURS)
    wash = np.where(
        position < 0.5, green + 2 * position * (amber - green),
        amber + (2 * position - 1) * (red - amber),
    )  # fmt: skip
    weight = _WASH * (count > 0)[..., None]
    picture: Image = (sheet.rgb * (1 - weight) + wash * weight).astype(np.uint8)
    return _with_legend(picture, ("seen, works", "doubtful", "seen, fails"))


def colour_of(judged: SampleVerdict) -> tuple[int, int, int]:
    """RGB colour of a sample: works, doubtful or fails."""
    if not judged.holds:
        return _COLOURS[2]
    return _COLOURS[1] if judged.forecast.risk > _DOUBTFUL else _COLOURS[0]


def _all(plan: MissionForecast) -> list[SampleVerdict]:
    return [j for v in plan.verdicts for j in v.samples]


def _places(judged: Sequence[SampleVerdict]) -> Array:
    return np.array([j.sample.position[:2] for j in judged])


def _half_step(verdict: LegVerdict, judged: SampleVerdict, gsd_m: float) -> Array:
    """Half of the path (2,) that a sample of the leg stands for, pixels."""
    heading = np.radians(judged.sample.heading_deg)
    along = np.array([np.sin(heading), -np.cos(heading)])
    half: Array = 0.5 * verdict.leg.step_m / gsd_m * along
    return half


def _footprint(judged: SampleVerdict, cache: TileCache, camera: Camera, aim: Aim) -> Array | None:
    """Corners (N, 2) of the ground in view, at most three times as far as its middle; or None."""
    ground = judged.forecast.ground_m
    if ground <= 0:
        return None
    pose = camera_pose(judged.sample, cache, aim)
    w, h = camera.width, camera.height
    rays = camera.rays(np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]]))
    down = -(pose.rotation @ np.array([0.0, 0.0, 1.0]))[2]
    drop = ground * max(down, 0.2)  # height over the ground that is seen
    world = rays @ pose.rotation.T
    reach = np.where(world[:, 2] < -1e-3, drop / np.maximum(-world[:, 2], 1e-3), np.inf)
    flat = world[:, :2] / np.maximum(np.linalg.norm(world[:, :2], axis=1), 1e-9)[:, None]
    away = np.minimum(reach * np.linalg.norm(world[:, :2], axis=1), 3 * ground)[:, None]
    corners: Array = pose.translation[:2] + flat * away
    return corners


def _label(picture: Image, place: Array, text: str) -> None:
    at = (int(place[0]) + 8, int(place[1]) - 8)
    for colour, width in (((0, 0, 0), 4), ((255, 255, 255), 1)):
        cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.6, colour, width, cv2.LINE_AA)


def _with_legend(picture: Image, words: tuple[str, ...]) -> Image:
    bar = np.full((30, picture.shape[1], 3), 255, np.uint8)
    x = 10
    for colour, word in zip(_COLOURS, words, strict=True):
        cv2.rectangle(bar, (x, 8), (x + 24, 22), colour, -1)
        cv2.putText(bar, word, (x + 32, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1,
                    cv2.LINE_AA)  # fmt: skip
        x += 60 + 10 * len(word)
    return np.vstack([picture, bar])
