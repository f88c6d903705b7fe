"""Writes a plan as one self-contained HTML page with images, and as JSON data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from companion.planning.plan import MissionForecast
from companion.planning.verdicts import LegVerdict, SampleVerdict, VisionGap
from companion.planning.way import Aim, camera_pose
from companion.reporting.content import Report, ReportTable
from companion.reporting.layout import write_report
from companion.versions import made_by
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


LEG_HEADINGS = (
    "leg", "m", "works", "sigma m", "lost or wrong", "map", "similar", "condition", "reason"
)  # fmt: skip
STRETCH_HEADINGS = ("from m", "to m", "length m", "seconds", "drift m", "odometry")
PROPOSAL_HEADINGS = ("leg", "fly", "lost or wrong", "sigma m", "works then")


def verdict_words(plan: MissionForecast) -> str:
    """The result of a plan in a sentence, for the user."""
    bad = [v for v in plan.verdicts if not v.holds]
    limit = plan.question.limits.sigma_m
    circles = sum(v.leg.is_circle for v in plan.verdicts)
    count = f"{len(plan.verdicts) - circles} legs"
    if circles:
        count += f" and {circles} {'circle' if circles == 1 else 'circles'}"
    if bad:
        lost = sum(s.length_m for s in plan.stretches)
        said = (
            f"Vision fails on {len(bad)} of {count}: {lost:.0f} of {plan.length_m:.0f} m need "
            f"odometry or another route"
        )
    else:
        which = f"the {count} that could be judged" if plan.not_judged else f"all {count}"
        said = (
            f"Vision should work on {which} ({plan.length_m / 1000:.1f} km), sigma below "
            f"{limit:g} m"
        )
    return said + (f". Not judged: {'; '.join(plan.not_judged)}." if plan.not_judged else ".")


def leg_row(verdict: LegVerdict) -> tuple[str, ...]:
    """Table cells of a leg, with the reason at its worst sample."""
    worst = verdict.worst
    forecast = worst.forecast
    return (
        verdict.leg.name + (f" (x {verdict.times})" if verdict.times > 1 else ""),
        f"{verdict.leg.length_m:.0f}",
        f"{100 * verdict.share:.0f} %",
        "none" if math.isnan(verdict.sigma_m) else f"{verdict.sigma_m:.2f}",
        f"{100 * forecast.risk:.0f} %",
        f"{100 * forecast.figures.map_share:.0f} %",
        f"{100 * forecast.rival.share:.0f} %",
        forecast.condition,
        "" if worst.holds else worst.reason.value,
    )


def stretch_row(stretch: VisionGap) -> tuple[str, ...]:
    """Table cells of a stretch without vision."""
    return (
        f"{stretch.begin_m:.0f}",
        f"{stretch.end_m:.0f}",
        f"{stretch.length_m:.0f}",
        f"{stretch.seconds:.0f}",
        f"{stretch.drift_m:.1f}",
        "continues" if stretch.can_bridge else "ends before",
    )


def proposal_rows(plan: MissionForecast) -> list[tuple[str, ...]]:
    """Table rows of the alternatives."""
    return [
        (
            i.leg,
            i.change.words,
            f"{100 * i.risk:.0f} %",
            f"{i.sigma_m:.2f}",
            "yes" if i.holds else "no, but better",
        )
        for i in plan.proposals
    ]


def as_data(plan: MissionForecast) -> dict[str, Any]:
    """JSON data of a plan: request, legs, samples and stretches."""
    q = plan.question
    return {
        "mission": str(q.mission_file),
        "conditions": list(q.conditions),
        "sigma_limit_m": q.limits.sigma_m,
        "risk_limit": q.limits.risk,
        "holds": plan.holds,
        "not_judged": list(plan.not_judged),
        "length_m": plan.length_m,
        "speed_m_s": plan.speed_m_s,
        "legs": [
            {
                "name": v.leg.name,
                "length_m": v.leg.length_m,
                "times": v.times,
                "holds": v.holds,
                "samples": [
                    {
                        "way_m": j.sample.way_m,
                        "position_enu_m": [float(x) for x in j.sample.position],
                        "condition": j.forecast.condition,
                        "risk": j.forecast.risk,
                        "sigma_m": j.forecast.sigma_m,
                        "map_share": j.forecast.figures.map_share,
                        "texture": j.forecast.texture,
                        "likest_place": j.forecast.rival.share,
                        "reason": j.reason.value,
                    }
                    for j in v.samples
                ],
            }
            for v in plan.verdicts
        ],
        "stretches": [
            {"begin_m": s.begin_m, "end_m": s.end_m, "seconds": s.seconds, "drift_m": s.drift_m}
            for s in plan.stretches
        ],
        "instead": [
            {"leg": i.leg, "fly": i.change.words, "risk": i.risk, "holds": i.holds}
            for i in plan.proposals
        ],
        "notes": list(plan.notes),
    }


def write_page(plan: MissionForecast, pictures: Sequence[tuple[str, Image]], path: Path) -> None:
    """Write the page; `ReportError` if it cannot be written."""
    q = plan.question
    bad = frozenset(k for k, v in enumerate(plan.verdicts) if not v.holds)
    tables = (
        ("Legs", ReportTable(LEG_HEADINGS, tuple(map(leg_row, plan.verdicts)), bad)),
        ("Without vision", ReportTable(STRETCH_HEADINGS, tuple(map(stretch_row, plan.stretches)))),
        ("Alternatives", ReportTable(PROPOSAL_HEADINGS, tuple(proposal_rows(plan)))),
    )
    report = Report(
        f"Forecast of {q.mission_file.name}",
        f"Under {', '.join(q.conditions)}; sigma to {q.limits.sigma_m:g} m, at most "
        f"{100 * q.limits.risk:.0f} % of the frames lost or more than 1 m wrong.",
        verdict=verdict_words(plan),
        tables=tuple(table for table in tables if table[1].rows),
        pictures=tuple(pictures),
        versions=made_by(),
        notes=plan.notes,
    )
    write_report(report, path)
