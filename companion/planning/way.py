"""Computes the camera's poses along a mission, in the map's frame. A leg is a straight line, a
spline as ArduPilot flies it, or a circle.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from companion.errors import MissionFileError
from companion.geometry import (
    GimbalAngles,
    GimbalFrame,
    Mount,
    camera_attitude,
    world_from_camera,
)
from companion.planning.mission import HeightAbove, MissionPlace, PlannedMission
from localizer.geometry.geo import EARTH_RADIUS_M, geo_box
from localizer.geometry.pose import Array, Pose, matrix_from_euler
from localizer.map.cache.cache import TileCache
from localizer.map.cache.pick import MapSurface
from mavlink_bridge.mission.items import GimbalTarget, LoiterCircle, RegionOfInterest

LEAST_LEG_M = 1.0  # shorter ones are climbs on the spot
# A ray that falls just between two tiles may miss both: some beside it do not.
_DOWN = np.array([[x, y, -1.0] for x, y in ((0, 0), (1e-3, 4e-4), (-4e-4, 1e-3), (-1e-3, -6e-4))])
_FARTHEST_KM = 500.0  # from the map: beyond it a digit is wrong


@dataclass(frozen=True)
class Aim:
    """Direction of the camera. mount: its mounting; pitch_deg: of the gimbal if the mission has
    none; fixed: mounted on the airframe, which is level here.
    """

    mount: Mount
    pitch_deg: float
    fixed: bool


@dataclass(frozen=True)
class PathSample:
    """A sample of the path. position: (3,) of the vehicle, world metres; way_m: distance flown;
    turn_deg: camera direction clockwise from the path.
    """

    position: Array
    way_m: float
    heading_deg: float
    pitch_deg: float
    turn_deg: float = 0.0


@dataclass(frozen=True)
class FlightLeg:
    """The path between two positions. name: made of their numbers, "home" or "take-off"; step_m:
    distance between samples; speed_m_s: None if the mission has none; first: index of the first
    identical leg; is_circle: whether it is a loiter circle.
    """

    name: str
    length_m: float
    step_m: float
    samples: tuple[PathSample, ...]
    speed_m_s: float | None = None
    first: int = 0
    is_circle: bool = False


class MapHeights:
    """Surface heights of the map."""

    def __init__(self, cache: TileCache) -> None:
        self._surface = MapSurface(cache)
        self._top_m = float(cache.index.box_max[0, 2]) + 1.0
        self._known: dict[tuple[float, float], float | None] = {}

    def height_m(self, east_m: float, north_m: float) -> float | None:
        """World z (m) of the highest surface at a position (m from the map's origin); None outside
        the map and in holes. Each position is measured once and then remembered.
        """
        place = east_m, north_m
        if place not in self._known:
            self._known[place] = self._measured(east_m, north_m)
        return self._known[place]

    def _measured(self, east_m: float, north_m: float) -> float | None:
        eye = np.array([east_m, north_m, self._top_m])
        hits = self._surface.cast(eye, _DOWN).distances
        return self._top_m - float(np.nanmin(hits)) if np.isfinite(hits).any() else None


def legs_of(
    mission: PlannedMission, cache: TileCache, ground: MapHeights, aim: Aim, spacing_m: float
) -> tuple[FlightLeg, ...]:
    """The mission's legs in flight order with samples every spacing_m; legs with an unknown path
    are left out.

    MissionFileError if the mission does not state its height above the map.
    """
    site = _Site(cache, ground, _launch(mission, cache))
    path = [replace(p, after_gap=False) for p in mission.path]
    positions = [site.position(p) for p in path]
    log = _Legs(site, aim, spacing_m)
    leaves = np.zeros(3)
    for k, (start, end) in enumerate(itertools.pairwise(path)):
        if mission.path[k + 1].after_gap:
            leaves = np.zeros(3)
            log.circle(end, positions[k + 1], leaves)
            continue
        beyond = path[k + 2] if k + 2 < len(path) else None
        here, there = positions[k], positions[k + 1]
        course = straight(here, there)
        if end.curved:
            after, curved = (None, False) if beyond is None else (positions[k + 2], beyond.curved)
            course = spline(here, there, leaves, after, curved_on=curved)
        arrived, leaves = leaves, course.leaves
        if course.length_m < LEAST_LEG_M:  # a climb on the spot
            leaves = np.zeros(3)
        else:
            alike = (start.name, start.latitude_deg, start.longitude_deg, start.height_m, end)
            key = (*alike, *arrived, beyond) if end.curved else alike
            log.add(key, f"{start.name} to {end.name}", end, course)
        log.circle(end, there, there - here)
    if len(path) == 1 and not log.legs:
        raise MissionFileError(
            "the mission has one place and no home, so no way between places: set its home"
        )
    if not log.legs:
        raise MissionFileError("the mission goes nowhere: its places lie on one another")
    return tuple(log.legs)


def camera_pose(sample: PathSample, cache: TileCache, aim: Aim) -> Pose:
    """The camera's world pose at a sample, for a level vehicle that flies along its path."""
    to_ned = cache.frame.ned_from_enu(cache.frame.position(sample.position))
    body = matrix_from_euler(0.0, 0.0, float(np.radians(sample.heading_deg)))
    turn = float(np.radians(sample.turn_deg))
    if aim.fixed:
        body = matrix_from_euler(0.0, 0.0, float(np.radians(sample.heading_deg)) + turn)
        angles = GimbalAngles(0.0, 0.0, 0.0, GimbalFrame.BODY)
    else:
        angles = GimbalAngles(0.0, float(np.radians(sample.pitch_deg)), turn)
    attitude = camera_attitude(body, angles, aim.mount)
    return world_from_camera(sample.position, body, attitude, aim.mount.lever_arm_m, to_ned)


@dataclass(frozen=True)
class _Site:
    """Converts places to positions. launch: (east, north) where heights above home begin."""

    cache: TileCache
    ground: MapHeights
    launch: tuple[float, float]

    def position(self, place: MissionPlace | RegionOfInterest) -> Array:
        """World position (3,)."""
        cache = self.cache
        if place.above is HeightAbove.SEA:
            height = place.height_m + cache.manifest.geoid_separation_m
        else:
            east, north = _enu(place.latitude_deg, place.longitude_deg, cache)
            is_home = place.above is HeightAbove.HOME
            below = self.launch if is_home else (east, north)
            surface = self.ground.height_m(*below)
            if surface is None:
                what = "home" if is_home else "a waypoint above terrain"
                at = cache.frame.position([*below, 0.0])
                raise MissionFileError(
                    f"{what} at {at.latitude_deg:.6f}, {at.longitude_deg:.6f} is not over the map "
                    f"{cache.path} ({_extent(cache, below)}), so nobody knows how high its ground "
                    "is: plan it over the map, or with altitudes above mean sea level"
                )
            # Above the ellipsoid, not above the map's plane: that falls away by 8 m in 10 km.
            height = cache.frame.position([*below, surface]).height_m + place.height_m
        return np.asarray(
            cache.frame.enu_from_geodetic(place.latitude_deg, place.longitude_deg, height)
        )


class _Legs:
    """Collects the legs; a leg that is flown identically again is not sampled again."""

    def __init__(self, site: _Site, aim: Aim, spacing_m: float) -> None:
        self.legs: list[FlightLeg] = []
        self._site, self._aim, self._spacing_m = site, aim, spacing_m
        self._firsts: dict[tuple[Any, ...], FlightLeg] = {}
        self._way_m = 0.0

    def add(self, key: tuple[Any, ...], name: str, end: MissionPlace, course: Course) -> None:
        """Add a leg to `end` on this course. key: equal for identical legs."""
        if key not in self._firsts:
            leg = _leg(name, end, course, self._site, self._aim, self._spacing_m)
            self._firsts[key] = replace(leg, first=len(self.legs))
        leg = self._firsts[key]
        samples = tuple(
            replace(s, way_m=self._way_m + (k + 0.5) * leg.step_m)
            for k, s in enumerate(leg.samples)
        )
        self.legs.append(replace(leg, samples=samples))
        self._way_m += course.length_m

    def circle(self, place: MissionPlace, centre: Array, arrives: Array) -> None:
        """Add the circles about a place, if any. arrives: (3,) direction of arrival."""
        if place.circle is None:
            return
        course = circled(centre, arrives, place.circle)
        for _ in range(place.circle.rounds):
            self.add(
                ("circle", replace(place, after_gap=False)), f"circle {place.name}", place, course
            )


def _leg(
    name: str, end: MissionPlace, course: Course, site: _Site, aim: Aim, spacing_m: float
) -> FlightLeg:
    """A leg with its samples, from distance 0."""
    count = max(round(course.length_m / spacing_m), 1)
    step_m = course.length_m / count
    looked_at = None if end.gimbal.roi is None else site.position(end.gimbal.roi)
    samples = []
    for share in map(float, (np.arange(count) + 0.5) / count):
        position, heading = course.at(share)
        nose = course.nose_deg
        pitch, turn = _look(end.gimbal, aim, position, heading + nose, looked_at)
        turn = (turn + nose + 180.0) % 360.0 - 180.0
        samples.append(PathSample(position, share * course.length_m, heading, pitch, turn))
    leg = FlightLeg(name, course.length_m, step_m, tuple(samples), end.speed_m_s)
    return replace(leg, is_circle=course.is_circle)


def _look(
    gimbal: GimbalTarget, aim: Aim, position: Array, heading_deg: float, looked_at: Array | None
) -> tuple[float, float]:
    """Camera pitch, and its turn to the right of the path, degrees. A vehicle without a gimbal
    turns to a region of interest itself, as ArduCopter does. looked_at: its position, None without.
    """
    pitch = aim.pitch_deg if gimbal.pitch_deg is None else gimbal.pitch_deg
    if looked_at is not None:
        east, north, up = looked_at - position
        pitch = float(np.degrees(np.arctan2(up, np.hypot(east, north))))
        turn = float(np.degrees(np.arctan2(east, north))) - heading_deg
    elif aim.fixed:
        turn = 0.0
    else:
        turn = gimbal.yaw_deg - (heading_deg if gimbal.from_north else 0.0)
    return pitch, (turn + 180.0) % 360.0 - 180.0


def _launch(mission: PlannedMission, cache: TileCache) -> tuple[float, float]:
    """(east, north) of home, m; of the first place if the mission has no home."""
    first = mission.path[0]
    latitude, longitude = mission.home or (first.latitude_deg, first.longitude_deg)
    east, north = _enu(latitude, longitude, cache)
    if np.hypot(east, north) > 1000.0 * _FARTHEST_KM:
        raise MissionFileError(
            f"the mission begins at {latitude:.5f}, {longitude:.5f}, "
            f"{np.hypot(east, north) / 1000:.0f} km from the map's origin: another map, or a "
            "wrong digit"
        )
    return east, north


def _enu(latitude_deg: float, longitude_deg: float, cache: TileCache) -> tuple[float, float]:
    height = cache.frame.origin.height_m
    east, north, _ = cache.frame.enu_from_geodetic(latitude_deg, longitude_deg, height)
    return float(east), float(north)


def _extent(cache: TileCache, below: tuple[float, float]) -> str:
    """Text on where the map lies, and how far a place (east, north in m) is from it."""
    corners = np.array(
        [_enu(*corner, cache) for corner in cache.manifest.extent]
    )  # of the rectangle, (n, 2)
    nearest = np.clip(below, corners.min(axis=0), corners.max(axis=0))
    away_m = float(np.hypot(*(np.asarray(below) - nearest)))
    return f"{geo_box(cache.manifest.extent).line()}; it is {away_m:.0f} m away"


def length_m(legs: Sequence[FlightLeg]) -> float:
    """Total length of the legs, m."""
    return sum(leg.length_m for leg in legs)


_PIECES = 64  # of a spline or a circle
# The vectors at both ends are shortened to so many times the distance between them
# (SplineCurve::set_origin_and_destination).
_LONGEST = 4.0


@dataclass(frozen=True)
class Course:
    """Path of a leg. points: (N, 3), world metres; leaves: (3,) direction and strength at its end,
    zero for a stop; nose_deg: heading of the vehicle, clockwise from the path.
    """

    points: Array
    leaves: Array
    nose_deg: float = 0.0
    is_circle: bool = False

    @property
    def length_m(self) -> float:
        """Horizontal length, m."""
        return float(self._steps().sum())

    def at(self, share: float) -> tuple[Array, float]:
        """Position (3,), world metres, and direction of the path, degrees clockwise from the map's
        north, after a share (0 to 1) of the length.
        """
        steps = self._steps()
        done = np.concatenate([[0.0], np.cumsum(steps)])
        way = share * done[-1]
        k = int(np.clip(np.searchsorted(done, way, side="right") - 1, 0, len(steps) - 1))
        start, end = self.points[k], self.points[k + 1]
        east, north, _ = end - start
        part = (way - done[k]) / max(steps[k], 1e-9)
        # As high above the Earth as between the ends: a chord lies below.
        bulge = 0.5 * part * (1.0 - part) * (east * east + north * north) / EARTH_RADIUS_M
        position = start + part * (end - start) + (0.0, 0.0, bulge)
        return position, float(np.degrees(np.arctan2(east, north)) % 360.0)

    def _steps(self) -> Array:
        return np.asarray(np.hypot(*np.diff(self.points, axis=0)[:, :2].T))


def straight(start: Array, end: Array) -> Course:
    """A straight course between two positions (3,), world metres."""
    return Course(np.stack([start, end]), end - start)


def spline(
    start: Array, end: Array, arrives: Array, after: Array | None, *, curved_on: bool
) -> Course:
    """A spline leg between two positions (3,), world metres. arrives: `leaves` (3,) of the course
    before; after: next position, None for a stop; curved_on: whether the next leg is a spline.
    """
    leaves = np.zeros(3)
    if after is not None:
        leaves = after - start if curved_on else after - end
    longest = _LONGEST * float(np.linalg.norm(end - start))
    strength = float(np.linalg.norm(arrives) + np.linalg.norm(leaves))
    scale = min(longest / strength, 1.0) if strength > 0 else 1.0
    t = np.linspace(0.0, 1.0, _PIECES + 1)[:, None]
    points = (
        (2 * t**3 - 3 * t**2 + 1) * start
        + (t**3 - 2 * t**2 + t) * scale * arrives
        + (3 * t**2 - 2 * t**3) * end
        + (t**3 - t**2) * scale * leaves
    )
    return Course(points, leaves)


def circled(centre: Array, arrives: Array, circle: LoiterCircle) -> Course:
    """One circle about a position (3,), world metres, from the point where a vehicle flying in
    direction `arrives` (3,) meets it; counter-clockwise if the circle's radius is negative.
    """
    begin = np.arctan2(-arrives[1], -arrives[0])
    turned = begin - np.sign(circle.radius_m) * np.linspace(0.0, 2.0 * np.pi, _PIECES + 1)
    out = np.stack([np.cos(turned), np.sin(turned), np.zeros_like(turned)], axis=-1)
    nose_deg = float(np.sign(circle.radius_m)) * 90.0 if circle.inward else 0.0
    return Course(centre + abs(circle.radius_m) * out, np.zeros(3), nose_deg, is_circle=True)
