"""Missions as ground stations save them: QGroundControl's ``.plan`` (JSON) and ``.waypoints``
(``QGC WPL 110``, also Mission Planner's), as the places that are flown to.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.errors import MissionFileError
from localizer.plain_files import plain_text

# ArduPilot counts its commands in a signed 16-bit number (AP_Mission, MIS_TOTAL).
_MOST_ITEMS = 32_767
_MOST_BYTES = 16 << 20  # so many items take 8 MB
_PLACES = (
    mavlink.MAV_CMD_NAV_WAYPOINT,
    mavlink.MAV_CMD_NAV_SPLINE_WAYPOINT,
    mavlink.MAV_CMD_NAV_LOITER_UNLIM,
    mavlink.MAV_CMD_NAV_LOITER_TIME,
    mavlink.MAV_CMD_NAV_LOITER_TURNS,
)
_UNSET = (0.0, 0.0)  # coordinates that stand for where the vehicle is


class HeightAbove(Enum):
    """What an item's altitude is above."""

    HOME = "home"
    SEA = "mean sea level"
    TERRAIN = "terrain"


_FRAMES = {
    mavlink.MAV_FRAME_GLOBAL: HeightAbove.SEA,
    mavlink.MAV_FRAME_GLOBAL_INT: HeightAbove.SEA,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT: HeightAbove.HOME,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT: HeightAbove.HOME,
    mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT: HeightAbove.TERRAIN,
    mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT: HeightAbove.TERRAIN,
}


@dataclass(frozen=True)
class PlannedWaypoint:
    """A place to fly to. height_m: above what `above` says; pitch_deg: of the gimbal on the way
    there, if said.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float
    pitch_deg: float | None
    above: HeightAbove = HeightAbove.HOME


@dataclass(frozen=True)
class PlannedMission:
    """home: (latitude, longitude) degrees, if the file has it. speed_m_s: the last that is said.
    returns: it ends with a return to home. ignored: numbers of commands that are not flown.
    """

    home: tuple[float, float] | None
    waypoints: tuple[PlannedWaypoint, ...]
    takeoff_height_m: float | None
    speed_m_s: float | None
    returns: bool
    ignored: tuple[int, ...]


@dataclass(frozen=True)
class _MissionItem:
    command: int
    frame: int
    parameters: tuple[float, float, float, float]
    latitude_deg: float
    longitude_deg: float
    altitude_m: float

    @property
    def place(self) -> tuple[float, float]:
        return self.latitude_deg, self.longitude_deg


def read_mission(path: Path) -> PlannedMission:
    """Read either format; MissionFileError says what is wrong with a file."""
    try:
        text = plain_text(path, _MOST_BYTES)
        home: tuple[float, float] | None
        if path.suffix == ".plan":
            home, items = _plan(json.loads(text))
        else:
            home, items = _waypoints(text)
        if len(items) > _MOST_ITEMS:
            raise MissionFileError(
                f"{path}: holds {len(items):,} items; an autopilot counts {_MOST_ITEMS:,} at the "
                "most: split the mission"
            )
        return _mission(path, home, items)
    except OSError as error:
        raise MissionFileError(f"{path}: cannot be read: {error.strerror}") from error
    # What a damaged or a foreign file raises while it is taken apart.
    except (
        ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError, RecursionError
    ) as error:  # fmt: skip
        raise MissionFileError(
            f"{path}: no .plan of QGroundControl and no QGC WPL 110 file ({error})"
        ) from error


def _plan(document: dict[str, Any]) -> tuple[tuple[float, float], list[_MissionItem]]:
    mission = document["mission"]
    home = mission["plannedHomePosition"]
    items = [_plan_item(item) for entry in mission["items"] for item in _simple(entry)]
    return (float(home[0]), float(home[1])), items


def _simple(entry: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """A simple item, or those that a complex one (a survey) was turned into when it was saved."""
    if entry["type"] == "SimpleItem":
        yield entry
    else:
        yield from entry["TransectStyleComplexItem"]["Items"]


def _plan_item(entry: dict[str, Any]) -> _MissionItem:
    numbers = [0.0 if p is None else float(p) for p in entry["params"]]
    p1, p2, p3, p4, latitude, longitude, altitude = numbers
    return _MissionItem(
        int(entry["command"]), int(entry["frame"]), (p1, p2, p3, p4), latitude, longitude, altitude
    )


def _waypoints(text: str) -> tuple[tuple[float, float] | None, list[_MissionItem]]:
    """Rows of index, current, frame, command, four parameters, latitude, longitude, altitude,
    autocontinue; row 0 is home.
    """
    first, *lines = text.splitlines()
    if first.split() != ["QGC", "WPL", "110"]:
        raise ValueError(f"it begins with {first[:20]!r}")
    items = []
    for line in lines:
        if not line.strip():
            continue
        cells = line.split()
        p1, p2, p3, p4, latitude, longitude, altitude = (float(c) for c in cells[4:11])
        items.append(
            _MissionItem(
                int(cells[3]), int(cells[2]), (p1, p2, p3, p4), latitude, longitude, altitude
            )
        )
    home = (items[0].latitude_deg, items[0].longitude_deg) if items else None
    return (None if home == (0.0, 0.0) else home), items[1:]


def _mission(
    path: Path, home: tuple[float, float] | None, items: Sequence[_MissionItem]
) -> PlannedMission:
    waypoints: list[PlannedWaypoint] = []
    takeoff = speed = pitch = None
    returns, ignored = False, []
    for item in items:
        if item.command == mavlink.MAV_CMD_NAV_TAKEOFF:
            above_home = _FRAMES.get(item.frame) is HeightAbove.HOME
            takeoff = item.altitude_m if above_home else None
        elif item.command in _PLACES:
            before = waypoints[-1] if waypoints else _begun(home, takeoff)
            waypoints.append(_waypoint(path, _filled(item, before), pitch, len(waypoints) + 1))
        elif item.command == mavlink.MAV_CMD_NAV_LAND:
            if waypoints and item.place != _UNSET:  # it is flown to, and then down
                there = _level(item, waypoints[-1])
                waypoints.append(_waypoint(path, there, pitch, len(waypoints) + 1))
        elif item.command == mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH:
            returns = True
        elif item.command == mavlink.MAV_CMD_DO_CHANGE_SPEED:
            speed = item.parameters[1]
        elif item.command in (
            mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW,
            mavlink.MAV_CMD_DO_MOUNT_CONTROL,
        ):
            pitch = item.parameters[0]
        else:
            ignored.append(item.command)
    if home is not None and not _is_on_earth(*home):
        raise ValueError(f"home is no place: {home}")
    if not waypoints:
        raise MissionFileError(f"{path}: holds no waypoint")
    return PlannedMission(home, tuple(waypoints), takeoff, speed, returns, tuple(ignored))


def _begun(home: tuple[float, float] | None, takeoff_m: float | None) -> PlannedWaypoint | None:
    """Where the vehicle is before the first place; None where the file does not say."""
    return None if home is None else PlannedWaypoint(*home, takeoff_m or 0.0, None)


def _filled(item: _MissionItem, before: PlannedWaypoint | None) -> _MissionItem:
    """With what is not set, coordinates or an altitude of zero, as it is where the vehicle is, as
    ArduPilot has it (ModeAuto::loc_from_cmd).
    """
    if before is None:
        return item
    if item.place == _UNSET:
        latitude, longitude = before.latitude_deg, before.longitude_deg
        item = replace(item, latitude_deg=latitude, longitude_deg=longitude)
    return item if item.altitude_m else _level(item, before)


def _level(item: _MissionItem, before: PlannedWaypoint) -> _MissionItem:
    """At the height of the waypoint before it."""
    frame = next(f for f, above in _FRAMES.items() if above is before.above)
    return replace(item, altitude_m=before.height_m, frame=frame)


def _waypoint(path: Path, item: _MissionItem, pitch: float | None, number: int) -> PlannedWaypoint:
    place = (item.latitude_deg, item.longitude_deg, item.altitude_m)
    if not (_is_on_earth(*place[:2]) and math.isfinite(item.altitude_m)):
        raise ValueError(f"waypoint {number} is no place: {place}")
    if pitch is not None and not math.isfinite(pitch):
        raise ValueError(f"the gimbal's pitch before waypoint {number} is no angle: {pitch}")
    if item.frame not in _FRAMES:
        raise MissionFileError(
            f"{path}: waypoint {number} in frame {item.frame}; known are {sorted(_FRAMES)} "
            "(MAV_FRAME): save the mission with global coordinates"
        )
    return PlannedWaypoint(*place, pitch, _FRAMES[item.frame])


def _is_on_earth(latitude_deg: float, longitude_deg: float) -> bool:
    return abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 360.0  # NaN is not either
