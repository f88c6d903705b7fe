"""Reads missions of ground stations: QGroundControl's ``.plan`` (JSON) and ``.waypoints`` (``QGC
WPL 110``, also Mission Planner's).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.errors import MissionFileError
from localizer.plain_files import plain_text
from mavlink_bridge.errors import MissionError
from mavlink_bridge.mission.items import HeightAbove, MissionItem, MissionVehicle, UnreadItem
from mavlink_bridge.mission.path import MissionPlace, PlannedMission, planned_path

__all__ = ["HeightAbove", "MissionPlace", "PlannedMission", "read_mission"]

# ArduPilot counts its commands in a signed 16-bit number (AP_Mission, MIS_TOTAL).
_MOST_ITEMS = 32_767
_FIELDS = 12  # of a row of QGC WPL 110
_MOST_BYTES = 16 << 20  # so many items take 8 MB
_LANDING_PATTERNS = {
    "fwLandingPattern": mavlink.MAV_CMD_NAV_LAND,
    "vtolLandingPattern": mavlink.MAV_CMD_NAV_VTOL_LAND,
}
_Items = list[MissionItem | UnreadItem]


def read_mission(path: Path) -> PlannedMission:
    """Read a mission of either format; `MissionFileError` for an invalid one, or no waypoint."""
    try:
        text = plain_text(path, _MOST_BYTES)
        read = _plan if text.lstrip()[:1] in ("{", "[") else _waypoints
        home, items, vehicle, speed = read(text)
        if len(items) > _MOST_ITEMS:
            raise MissionFileError(
                f"{path}: holds {len(items):,} items; an autopilot counts {_MOST_ITEMS:,} at the "
                "most: split the mission"
            )
        mission = planned_path(items, home, vehicle, speed)
    except OSError as error:
        raise MissionFileError(f"{path}: cannot be read: {error.strerror}") from error
    except MissionError as error:
        raise MissionFileError(f"{path}: {error}") from error
    except json.JSONDecodeError as error:
        raise MissionFileError(
            f"{path}: its JSON breaks off at line {error.lineno} ({error.msg}); save the mission "
            "again, or copy the file again"
        ) from error
    # What a damaged or a foreign file raises while it is taken apart.
    except (
        ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError, RecursionError
    ) as error:  # fmt: skip
        raise MissionFileError(
            f"{path}: no .plan of QGroundControl and no QGC WPL 110 file ({error})"
        ) from error
    if not mission.waypoints:
        unknown = ", ".join(n.text for n in mission.not_judged)
        but = f", and this cannot be followed before the flight: {unknown}" if unknown else ""
        raise MissionFileError(f"{path}: holds no waypoint{but}")
    return mission


_Read = tuple[tuple[float, float] | None, _Items, MissionVehicle, float | None]


def _plan(text: str) -> _Read:
    document = json.loads(text)
    mission = document["mission"]
    home = _home(mission["plannedHomePosition"])
    autopilot, kind = (_whole(mission.get(key)) for key in ("firmwareType", "vehicleType"))
    rally = bool(document.get("rallyPoints", {}).get("points"))
    vehicle = MissionVehicle(autopilot, kind, rally)
    entries = [found for entry in mission["items"] for found in _expanded(entry)]
    numbers = _numbers([_whole(entry.get("doJumpId")) for entry in entries])
    items = [_plan_item(*one) for one in zip(entries, numbers, strict=True)]
    speed = mission.get("hoverSpeed" if vehicle.is_multirotor else "cruiseSpeed")
    return home, items, vehicle, float(speed) if speed and speed > 0 else None


def _expanded(entry: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """The mission items of an entry: a simple item itself; the saved items of a survey or corridor;
    the items that QGroundControl makes of a landing pattern. Another entry itself, which is not
    read.
    """
    if entry["type"] == "SimpleItem":
        yield entry
        return
    kind = str(entry.get("complexItemType"))
    inner = entry.get("TransectStyleComplexItem", entry)
    if kind in _LANDING_PATTERNS:
        yield from _landing_pattern(entry, kind)
    elif isinstance(inner.get("Items"), list) and inner["Items"]:
        yield from inner["Items"]
    else:
        yield {"complexItemType": kind}


def _landing_pattern(entry: dict[str, Any], kind: str) -> Iterator[dict[str, Any]]:
    """Approach and landing (QGroundControl's LandingComplexItem). Older files call the approach the
    loiter, and state for each position the reference of its altitude.
    """
    name = "landingApproachCoordinate"
    approach = entry[name if name in entry else "loiterCoordinate"]
    landing = entry["landCoordinate"]
    relative = entry.get("altitudesAreRelative", True)
    above_home, above_sea = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT, mavlink.MAV_FRAME_GLOBAL
    frames = [
        above_home if entry.get(key, relative) else above_sea
        for key in ("loiterAltitudeRelative", "landAltitudeRelative")
    ]
    loiters = entry.get("useLoiterToAlt", True)
    radius = float(entry.get("loiterRadius", 0.0)) if loiters else 0.0
    radius *= 1.0 if entry.get("loiterClockwise", True) else -1.0
    command = mavlink.MAV_CMD_NAV_LOITER_TO_ALT if loiters else mavlink.MAV_CMD_NAV_WAYPOINT
    yield {"command": mavlink.MAV_CMD_DO_LAND_START, "frame": 2, "params": [0] * 7}
    if entry.get("useDoChangeSpeed"):
        speed = entry.get("finalApproachSpeed")
        yield {
            "command": mavlink.MAV_CMD_DO_CHANGE_SPEED, "frame": 2,
            "params": [0, speed, -1, 0, 0, 0, 0],
        }  # fmt: skip
    yield {"command": command, "frame": frames[0], "params": [0, radius, 0, 0, *approach]}
    yield {"command": _LANDING_PATTERNS[kind], "frame": frames[1], "params": [0] * 4 + landing}


def _plan_item(entry: dict[str, Any], number: int) -> MissionItem | UnreadItem:
    if "command" not in entry:
        return UnreadItem(number, str(entry["complexItemType"]))
    given = [*entry["params"], *entry.get("coordinate", ())]  # apart in the format's first version
    p1, p2, p3, p4, x, y, z = (math.nan if p is None else float(p) for p in given)
    return MissionItem(
        number, int(entry["command"]), int(entry["frame"]), (p1, p2, p3, p4, x, y, z)
    )


def _waypoints(text: str) -> _Read:
    """Read rows of index, current, frame, command, four parameters, latitude, longitude, altitude,
    autocontinue; row 0 is home.
    """
    first, *lines = text.splitlines() or [""]
    if first.split() != ["QGC", "WPL", "110"]:
        raise ValueError(f"it begins with {first[:20]!r}" if text.strip() else "it is empty")
    rows = [line.split() for line in lines if line.strip()]
    for number, cells in enumerate(rows):
        if len(cells) < _FIELDS:
            raise MissionError(
                f"row {number} has {len(cells)} of {_FIELDS} fields: the file breaks off; save the "
                "mission again, or copy the file again"
            )
    numbers = _numbers([int(cells[0]) for cells in rows[1:]])
    items: _Items = []
    for number, cells in zip([0, *numbers], rows, strict=False):
        p1, p2, p3, p4, x, y, z = (float(c) for c in cells[4:11])
        items.append(MissionItem(number, int(cells[3]), int(cells[2]), (p1, p2, p3, p4, x, y, z)))
    home = _home([float(c) for c in rows[0][8:10]]) if rows else None
    return home, items[1:], MissionVehicle(), None


def _numbers(stated: Sequence[int | None]) -> Sequence[int]:
    """Numbers as a jump names them: as stated, or counted from 1 if those are not unique."""
    known = [number for number in stated if number is not None]
    if len(set(known)) == len(stated):
        return known
    return range(1, len(stated) + 1)


def _home(place: Sequence[Any]) -> tuple[float, float] | None:
    """Latitude and longitude, degrees; None if home was not set (0, 0 or nothing)."""
    latitude, longitude = (math.nan if p is None else float(p) for p in place[:2])
    if (latitude, longitude) == (0, 0) or (math.isnan(latitude) and math.isnan(longitude)):
        return None
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 360.0):
        raise ValueError(f"home is no place: {(latitude, longitude)}")
    return latitude, longitude


def _whole(value: Any) -> int | None:
    return int(value) if isinstance(value, int | float) and math.isfinite(value) else None
