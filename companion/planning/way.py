"""From a mission's places to the camera's poses along it, in the map's frame."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from companion.errors import MissionFileError
from companion.geometry import (
    GimbalAngles,
    GimbalFrame,
    Mount,
    camera_attitude,
    ned_from_world,
    world_from_camera,
)
from companion.planning.mission import HeightAbove, PlannedMission, PlannedWaypoint
from localizer.geometry.antimeridian import geo_box
from localizer.geometry.pose import Array, Pose, matrix_from_euler
from localizer.map.cache.cache import TileCache
from localizer.map.cache.surface import MapSurface

LEAST_LEG_M = 1.0  # shorter ones are climbs on the spot
# A ray that falls just between two tiles may miss both: some beside it do not.
_DOWN = np.array([[x, y, -1.0] for x, y in ((0, 0), (1e-3, 4e-4), (-4e-4, 1e-3), (-1e-3, -6e-4))])
_EARTH_M = 6.371e6
_FARTHEST_KM = 500.0  # from the map: beyond it a digit is wrong


@dataclass(frozen=True)
class Aim:
    """How the camera looks from the vehicle. mount: its place; pitch_deg: of the gimbal where the
    mission does not say; fixed: screwed to the airframe, which flies level here.
    """

    mount: Mount
    pitch_deg: float
    fixed: bool


@dataclass(frozen=True)
class PathSample:
    """A place on the way. position: (3,) of the vehicle, world metres; way_m: flown until there;
    turn_deg: of the camera to the right of the way (an alternative's).
    """

    position: Array
    way_m: float
    heading_deg: float
    pitch_deg: float
    turn_deg: float = 0.0


@dataclass(frozen=True)
class FlightLeg:
    """A straight way between two places. name: as the ground station numbers them, "home" too;
    step_m: of the way that each sample stands for.
    """

    name: str
    length_m: float
    step_m: float
    samples: tuple[PathSample, ...]


class MapHeights:
    """Heights of the map's surface."""

    def __init__(self, cache: TileCache) -> None:
        self._surface = MapSurface(cache)
        self._top_m = float(cache.index.box_max[0, 2]) + 1.0

    def height_m(self, east_m: float, north_m: float) -> float | None:
        """World z (m) of the highest surface there; None beside the map and in its holes."""
        eye = np.array([east_m, north_m, self._top_m])
        hits = self._surface.cast(eye, _DOWN).distances
        return self._top_m - float(np.nanmin(hits)) if np.isfinite(hits).any() else None


def legs_of(
    mission: PlannedMission, cache: TileCache, ground: MapHeights, aim: Aim, spacing_m: float
) -> tuple[FlightLeg, ...]:
    """The legs between home, the waypoints and, if it returns, home; a sample every so many metres.

    MissionFileError where the mission does not say how high it flies over the map.
    """
    home = _home(mission, cache)
    places = [(f"{k}", w) for k, w in enumerate(mission.waypoints, 1)]
    if mission.home is not None:
        latitude, longitude = mission.home
        at_home = replace(mission.waypoints[0], latitude_deg=latitude, longitude_deg=longitude)
        if mission.waypoints[0].above is HeightAbove.HOME:
            at_home = replace(
                at_home, height_m=mission.takeoff_height_m or mission.waypoints[0].height_m
            )
        places.insert(0, ("home", at_home))
        if mission.returns:
            last = mission.waypoints[-1]
            back = replace(last, latitude_deg=latitude, longitude_deg=longitude)
            places.append(("home", back))
    points = [_position(w, cache, ground, home) for _, w in places]
    legs, way_m = [], 0.0
    for (start, end), (a, b) in zip(
        itertools.pairwise(places), itertools.pairwise(points), strict=True
    ):
        pitch = aim.pitch_deg if end[1].pitch_deg is None else end[1].pitch_deg
        leg = _leg(f"{start[0]} to {end[0]}", (a, b), pitch, (way_m, spacing_m))
        if leg is not None:
            legs.append(leg)
            way_m += leg.length_m
    if not legs:
        raise MissionFileError("the mission goes nowhere: its places lie on one another")
    return tuple(legs)


def camera_pose(sample: PathSample, cache: TileCache, aim: Aim) -> Pose:
    """The camera's pose (world) of a level vehicle that flies along its way."""
    to_ned = ned_from_world(cache.frame, cache.frame.position(sample.position))
    body = matrix_from_euler(0.0, 0.0, float(np.radians(sample.heading_deg)))
    turn = float(np.radians(sample.turn_deg))
    if aim.fixed:
        body = matrix_from_euler(0.0, 0.0, float(np.radians(sample.heading_deg)) + turn)
        angles = GimbalAngles(0.0, 0.0, 0.0, GimbalFrame.BODY)
    else:
        angles = GimbalAngles(0.0, float(np.radians(sample.pitch_deg)), turn)
    attitude = camera_attitude(body, angles, aim.mount)
    return world_from_camera(sample.position, body, attitude, aim.mount.lever_arm_m, to_ned)


def _leg(
    name: str, ends: tuple[Array, Array], pitch_deg: float, way: tuple[float, float]
) -> FlightLeg | None:
    """None for a climb on the spot. way: flown before it, and the samples' spacing, m."""
    start, end = ends
    east, north = (end - start)[:2]
    length = float(np.hypot(east, north))
    if length < LEAST_LEG_M:
        return None
    begun_m, spacing_m = way
    count = max(round(length / spacing_m), 1)
    heading = float(np.degrees(np.arctan2(east, north)) % 360.0)
    shares = (np.arange(count) + 0.5) / count
    samples = tuple(
        PathSample(_on_the_way(start, end, s), begun_m + s * length, heading, pitch_deg)
        for s in map(float, shares)
    )
    return FlightLeg(name, length, length / count, samples)


def _on_the_way(start: Array, end: Array, share: float) -> Array:
    """A place (3,) on a leg, as high above the Earth as between its ends: a chord lies below."""
    east, north, _ = end - start
    bulge = 0.5 * share * (1.0 - share) * (east * east + north * north) / _EARTH_M
    return np.asarray(start + share * (end - start) + (0.0, 0.0, bulge))


def _home(mission: PlannedMission, cache: TileCache) -> tuple[float, float]:
    """(east, north) of home, or of the first waypoint where the file has no home."""
    first = mission.waypoints[0]
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


def _position(
    waypoint: PlannedWaypoint, cache: TileCache, ground: MapHeights, home: tuple[float, float]
) -> Array:
    """World position (3,) of a waypoint."""
    if waypoint.above is HeightAbove.SEA:
        height = waypoint.height_m + cache.manifest.geoid_separation_m
        return np.asarray(
            cache.frame.enu_from_geodetic(waypoint.latitude_deg, waypoint.longitude_deg, height)
        )
    east, north = _enu(waypoint.latitude_deg, waypoint.longitude_deg, cache)
    below = home if waypoint.above is HeightAbove.HOME else (east, north)
    surface = ground.height_m(*below)
    if surface is None:
        what = "home" if waypoint.above is HeightAbove.HOME else "a waypoint above terrain"
        place = cache.frame.position([*below, 0.0])
        raise MissionFileError(
            f"{what} at {place.latitude_deg:.6f}, {place.longitude_deg:.6f} is not over the map "
            f"{cache.path} ({_extent(cache, below)}), so nobody knows how high its ground is: plan "
            "it over the map, or with altitudes above mean sea level"
        )
    # Above the ellipsoid, not above the map's plane: that falls away by 8 m in 10 km.
    height = cache.frame.position([*below, surface]).height_m + waypoint.height_m
    return np.asarray(
        cache.frame.enu_from_geodetic(waypoint.latitude_deg, waypoint.longitude_deg, height)
    )


def _extent(cache: TileCache, below: tuple[float, float]) -> str:
    """Where the map lies, and how far a place (east, north in metres) is from its rectangle."""
    corners = np.array(
        [_enu(*corner, cache) for corner in cache.manifest.extent]
    )  # of the rectangle, (n, 2)
    nearest = np.clip(below, corners.min(axis=0), corners.max(axis=0))
    away_m = float(np.hypot(*(np.asarray(below) - nearest)))
    return f"{geo_box(cache.manifest.extent).line()}; it is {away_m:.0f} m away"


def length_m(legs: Sequence[FlightLeg]) -> float:
    """Of all legs."""
    return sum(leg.length_m for leg in legs)
