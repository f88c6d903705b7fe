"""Make a simulated flight of the user's map and mission."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from companion.errors import MissionFileError
from companion.planning import mission as saved
from companion.planning.mission import HeightAbove, MissionPlace, PlannedMission
from companion.preflight.coverage import is_covered
from companion.settings_file import SettingsError, validated
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.map.cache.cache import TileCache
from localizer.map.cache.pick import MapSurface
from localizer.synth.plan.terrain import River, Terrain
from localizer.synth.world import WorldInfo
from sitl.demo.assets import FlightAssets
from sitl.demo.scenario import Scenario, ScenarioError, ScenarioLeg

_PITCH_DEG = -75.0  # where the mission does not say
_SIDE = 0.5  # of the map's shorter half extent: how far the flight without a mission goes
_HEIGHT_M = 100.0
_LOWEST_M = 5.0  # of a leg


@dataclass(frozen=True)
class Rehearsal:
    """A simulated flight over the user's map. notes: limitations that the user should know."""

    assets: FlightAssets
    scenario: Scenario
    notes: tuple[str, ...]


def rehearse(cache: Path, live: Path | None, mission: Path | None, scenario: Scenario) -> Rehearsal:
    """Prepare a flight over the tile cache `cache`. live: the cache that the camera sees; None: the
    same. `ScenarioError` if the mission is invalid or not over the map.

    The scenario's weather, camera and errors are kept. Its legs are replaced by the mission's, or
    without a mission by a triangle about the map's centre.
    """
    opened = TileCache.open(cache)
    if live is not None:
        TileCache.open(live)
    planned = read_mission(mission) if mission is not None else None
    notes = [] if live else ["the camera sees the map itself, in another light: that flatters"]
    home = _home(opened, planned)
    world = _world(opened, home)
    if planned is None:
        flown = scenario.model_copy(update=_triangle(opened))
    else:
        flown = _as_planned(planned, world.frame, scenario)
        unknown = [n.text for n in planned.not_judged] + sorted(planned.no_effect)
        if any(p.gimbal.roi is not None for p in planned.path):
            unknown.append("the camera's region of interest")
        if any(p.curved for p in planned.path):
            unknown.append("the curves of its splines, flown straight")
        if any(p.circle is not None for p in planned.path):
            unknown.append("its loiter circles")
        if unknown:
            notes.append(f"of the mission is not rehearsed: {', '.join(unknown)}")
    _require_covered(opened, world.frame, flown)
    return Rehearsal(FlightAssets(world, cache, live or cache), flown, tuple(notes))


def read_mission(path: Path) -> PlannedMission:
    """Read a saved mission. `ScenarioError` if it is invalid or cannot be rehearsed."""
    try:
        planned = saved.read_mission(path)
    except MissionFileError as error:
        raise ScenarioError(str(error)) from error
    strange = {w.above.value for w in planned.path} - {HeightAbove.HOME.value}
    if strange:
        raise ScenarioError(
            f"{path}: waypoints above {', '.join(sorted(strange))}; a rehearsal flies heights "
            "above home (frame 3): save the mission with relative altitudes"
        )
    return planned


def _require_covered(cache: TileCache, home: LocalFrame, scenario: Scenario) -> None:
    map_from_home = cache.frame.ecef_from_enu.inverse @ home.ecef_from_enu
    corners = [(leg.east_m, leg.north_m, 0.0) for leg in scenario.legs]
    inside = is_covered(cache, map_from_home.apply(np.array(corners))[:, :2])
    if not inside.all():
        beside = ", ".join(str(k + 1) for k in np.flatnonzero(~inside))
        raise ScenarioError(f"waypoints {beside} are not over the map {cache.path}")


def _home(cache: TileCache, planned: PlannedMission | None) -> Geodetic:
    """Home on the surface: the mission's home, its first waypoint, or the map's centre."""
    if planned is not None:
        first = planned.path[0]
        latitude, longitude = planned.home or (first.latitude_deg, first.longitude_deg)
        east, north, _ = cache.frame.enu_from_geodetic(latitude, longitude, 0.0)
    else:
        low, high = _bounds(cache)
        east, north = (low + high)[:2] / 2
    return cache.frame.position([east, north, _surface_m(cache, east, north)])


def _bounds(cache: TileCache) -> tuple[np.ndarray, np.ndarray]:
    """Corners (3,) of the map, ENU."""
    return cache.index.box_min[0], cache.index.box_max[0]


def _surface_m(cache: TileCache, east: float, north: float) -> float:
    """ENU height of the highest surface at a position; `ScenarioError` where the map has none."""
    top = float(_bounds(cache)[1][2]) + 1.0
    down = np.array([[0.0, 0.0, -1.0]])
    distance = float(MapSurface(cache).cast(np.array([east, north, top]), down).distances[0])
    if not np.isfinite(distance):
        place = cache.frame.position([east, north, 0.0])
        raise ScenarioError(
            f"home at {place.latitude_deg:.6f}, {place.longitude_deg:.6f} is not on the map "
            f"{cache.path}: plan the mission over it"
        )
    return top - distance


def _world(cache: TileCache, home: Geodetic) -> WorldInfo:
    """World data for a flight over the map: flat ground at home's height, without roads."""
    low, high = _bounds(cache)
    size = float(2 * np.abs([low[:2], high[:2]]).max())
    none = River(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    return WorldInfo(
        seed=0,
        variant="map",
        size_m=size,
        origin=home,
        geoid_separation_m=cache.manifest.geoid_separation_m,
        targets=(),
        roads=(),
        buildings=0,
        terrain=Terrain(np.zeros((2, 2), np.float32), size, none),
    )


def _triangle(cache: TileCache) -> dict[str, object]:
    low, high = _bounds(cache)
    side = round(_SIDE * float((high - low)[:2].min()) / 2)
    corners = ((0, side), (side, side), (0, 0))
    legs = tuple(
        ScenarioLeg(east_m=e, north_m=n, height_m=_HEIGHT_M, gimbal_pitch_deg=-80.0)
        for e, n in corners
    )
    return {"legs": legs, "takeoff_height_m": _HEIGHT_M, "deny_after_s": 5.0, "speed_m_s": 8.0}


def _glides(place: MissionPlace, legs: Sequence[dict[str, float]]) -> bool:
    """Whether a place is on a descent to land; the simulated vehicle flies it level."""
    return bool(legs) and 0.0 <= place.height_m < _LOWEST_M


def _as_planned(planned: PlannedMission, home: LocalFrame, scenario: Scenario) -> Scenario:
    legs: list[dict[str, float]] = []
    places = planned.path if planned.launch is None else planned.path[1:]
    for waypoint in places:
        east, north, _ = home.enu_from_geodetic(
            waypoint.latitude_deg, waypoint.longitude_deg, home.origin.height_m
        )
        pitch = _PITCH_DEG if waypoint.pitch_deg is None else waypoint.pitch_deg
        legs.append(
            {
                "east_m": round(float(east), 6),
                "north_m": round(float(north), 6),
                "height_m": legs[-1]["height_m"] if _glides(waypoint, legs) else waypoint.height_m,
                "gimbal_pitch_deg": min(max(pitch, -90.0), 0.0),
            }
        )
    changed: dict[str, object] = {"legs": legs}
    changed["takeoff_height_m"] = planned.takeoff_height_m or places[0].height_m
    if planned.speed_m_s is not None and planned.speed_m_s > 0:
        changed["speed_m_s"] = planned.speed_m_s
    try:
        return validated(Scenario, scenario.model_dump() | changed)
    except SettingsError as error:
        raise ScenarioError(f"the mission cannot be flown:\n{error}") from error
