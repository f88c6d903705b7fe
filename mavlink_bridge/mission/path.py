"""Flight path of a mission's items, as ArduPilot's AP_Mission and its modes execute them.

Used by the forecast (`plan`), `map fetch --mission`, the rehearsal and the doctor. Items whose
effect cannot be known before the flight are listed as `NotJudged`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.errors import MissionError
from mavlink_bridge.mission.items import (
    DESCENTS,
    FLY_TOO,
    FRAMES,
    GIMBAL_COMMANDS,
    GIMBAL_ONLY,
    LANDINGS,
    NO_EFFECT,
    PLACES,
    ROI_COMMANDS,
    TAKEOFFS,
    UNKNOWN_VEHICLE,
    VIEW,
    GimbalTarget,
    HeightAbove,
    LoiterCircle,
    MissionItem,
    MissionVehicle,
    UnreadItem,
    circle_of,
    command_name,
    gimbal_after,
)

_MOST_STEPS = 200_000  # of a mission of jumps in jumps

_JUMPS = (mavlink.MAV_CMD_DO_JUMP, mavlink.MAV_CMD_DO_JUMP_TAG)
_MOST_REPEATS = 10  # of one jump; every round is alike
_MOST_IN_A_ROW = 64  # without a command between them (AP_Mission::get_next_cmd)
_FOREVER = -1
_ENDS = (*LANDINGS, mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH)


@dataclass(frozen=True)
class MissionPlace:
    """A position on the flight path. name: number among the waypoints, "home" or "take-off"; item:
    number in the mission; gimbal, speed_m_s: on the leg to it (None: not commanded); after_gap:
    whether the path to it is unknown; curved: whether the path to it is a spline; circle: circle
    that is flown about it on arrival.
    """

    name: str
    item: int
    latitude_deg: float
    longitude_deg: float
    height_m: float
    above: HeightAbove = HeightAbove.HOME
    gimbal: GimbalTarget = field(default_factory=GimbalTarget)
    speed_m_s: float | None = None
    after_gap: bool = False
    curved: bool = False
    circle: LoiterCircle | None = None

    @property
    def pitch_deg(self) -> float | None:
        """Gimbal pitch above the horizon, degrees; None if not commanded."""
        return self.gimbal.pitch_deg

    @property
    def is_waypoint(self) -> bool:
        """Whether it is from an item of the mission, not home or take-off."""
        return self.name.isdecimal()


@dataclass(frozen=True)
class NotJudged:
    """An item whose effect is unknown before the flight. text: its MAVLink name and number, and why
    the effect is unknown; gimbal_only: whether it affects only a gimbal camera; flies: whether it
    moves the vehicle.
    """

    text: str
    gimbal_only: bool = False
    flies: bool = False


@dataclass(frozen=True)
class PlannedMission:
    """A mission as it will be flown.

    home: (latitude, longitude) degrees, if known. path: the positions in flight order, from home or
    the take-off on, including returns to home. takeoff_height_m: above home, if stated. speed_m_s:
    the last stated one. no_effect: names of commands that change neither path nor view. notes:
    further remarks, as sentences.
    """

    home: tuple[float, float] | None
    path: tuple[MissionPlace, ...]
    takeoff_height_m: float | None
    speed_m_s: float | None
    not_judged: tuple[NotJudged, ...] = ()
    no_effect: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def waypoints(self) -> tuple[MissionPlace, ...]:
        """The positions without home and take-off."""
        return tuple(place for place in self.path if place.is_waypoint)

    @property
    def launch(self) -> MissionPlace | None:
        """Start of the path, above home or the take-off; None if unknown."""
        return self.path[0] if self.path and self.path[0].item == 0 else None


def planned_path(
    items: Sequence[MissionItem | UnreadItem],
    home: tuple[float, float] | None,
    vehicle: MissionVehicle = UNKNOWN_VEHICLE,
    speed_m_s: float | None = None,
) -> PlannedMission:
    """Compute the flight path of a mission's items (without item 0, home). home: (latitude,
    longitude) degrees, None: unknown, then returns are `not_judged`. speed_m_s: until the mission
    commands one. MissionError for an impossible position, or one in a frame without global
    coordinates.
    """
    flight = _Flight(items, home, vehicle, speed_m_s)
    flight.run()
    return flight.result()


class _Jumps:
    """Follows DO_JUMP and DO_JUMP_TAG as AP_Mission does, up to a number of repetitions.

    notes: differences from the flight, such as limited repetitions.
    """

    def __init__(self, items: Sequence[MissionItem | UnreadItem]) -> None:
        self._items = items
        self._index_of = {item.number: k for k, item in enumerate(items)}
        self._runs: dict[int, int] = {}
        self._in_a_row: tuple[int, int] = (-1, 0)  # a count of commands, and of jumps since
        self.notes: dict[str, None] = {}

    def following(self, item: MissionItem, index: int, commands: int) -> int | None:
        """Index of the item to continue with after executing the jump `item` at `index`, which is
        counted; None if the mission ends. commands: number of other commands executed so far, to
        detect jumps in a circle.
        """
        last, jumps = self._in_a_row
        self._in_a_row = (commands, jumps + 1 if last == commands else 1)
        target = self._target(item)
        if target is None or self._in_a_row[1] > _MOST_IN_A_ROW:
            self._note(f"{item.label} leads nowhere: the mission ends there.")
            return None
        count, done = item.parameters[1], self._runs.get(index, 0)
        times = int(count) if math.isfinite(count) else 0
        if times == _FOREVER and done:
            self._note(
                f"{item.label} repeats without end: one round more is judged, and what follows the "
                "jump is never reached."
            )
            return None
        if times != _FOREVER and done >= min(times, _MOST_REPEATS):
            if times > _MOST_REPEATS:
                self._note(
                    f"{item.label} repeats {times} times: {_MOST_REPEATS} rounds are counted, all "
                    "are alike."
                )
            self._runs[index] = 0  # AP_Mission begins to count again
            return index + 1
        self._runs[index] = done + 1
        return target

    def _note(self, text: str) -> None:
        self.notes[text] = None

    def _target(self, item: MissionItem) -> int | None:
        number = item.parameters[0]
        if not math.isfinite(number):
            return None
        if item.command == mavlink.MAV_CMD_DO_JUMP_TAG:
            tags = (
                k
                for k, other in enumerate(self._items)
                if isinstance(other, MissionItem)
                and other.command == mavlink.MAV_CMD_JUMP_TAG
                and other.parameters[0] == number
            )
            return next(tags, None)
        return self._index_of.get(int(number))


class _Flight:
    """Follows a mission item by item, and collects the path."""

    def __init__(
        self,
        items: Sequence[MissionItem | UnreadItem],
        home: tuple[float, float] | None,
        vehicle: MissionVehicle,
        speed_m_s: float | None,
    ) -> None:
        self._items, self._home, self._vehicle = items, home, vehicle
        self._usual_speed_m_s = self._speed_m_s = speed_m_s
        self._at = home
        self._level: tuple[float, HeightAbove] | None = None
        self._launch: MissionPlace | None = None
        self._takeoff_m: float | None = None
        self._gimbal = GimbalTarget()
        self._path: list[MissionPlace] = []
        self._names: dict[int, str] = {}
        self._gap = False
        self._not_judged: dict[NotJudged, None] = {}
        self._no_effect: dict[str, None] = {}
        self._notes: dict[str, None] = {}
        self._jumps = _Jumps(items)

    def run(self) -> None:
        """Follow the items from the first to the end."""
        index = commands = 0
        while index < len(self._items):
            item = self._items[index]
            if isinstance(item, MissionItem) and item.command in _JUMPS:
                following = self._jumps.following(item, index, commands)
                if following is None:
                    return
                index = following
                continue
            index, commands = index + 1, commands + 1
            if commands > _MOST_STEPS:
                self._leave_out(f"what follows {_MOST_STEPS:,} commands")
                return
            self._take(item)
            ends = isinstance(item, MissionItem) and item.command in _ENDS
            if ends and not _takes_off_next(self._items[index:]):
                return

    def result(self) -> PlannedMission:
        """The mission that was followed."""
        path = list(self._path)
        start = self._start()
        if start is not None:
            path.insert(0, start)
        return PlannedMission(
            self._home,
            tuple(path),
            self._takeoff_m,
            self._speed_m_s,
            tuple(self._not_judged),
            tuple(self._no_effect),
            (*self._notes, *self._jumps.notes),
        )

    def _start(self) -> MissionPlace | None:
        """Position above home, or above the take-off if home is unknown; None without both."""
        if self._launch is not None:
            return self._launch
        if self._home is None or not self._path:
            return None
        first = self._path[0]
        return MissionPlace("home", 0, *self._home, first.height_m, first.above)

    def _take(self, item: MissionItem | UnreadItem) -> None:
        if isinstance(item, UnreadItem):
            self._leave_out(item.label, "the ground station works it out at the upload", gap=True)
            return
        command = item.command
        if command in TAKEOFFS:
            self._take_off(item)
        elif command in PLACES:
            self._fly_to(item, item.altitude_m)
            self._note_place(item)
        elif command in DESCENTS:
            self._descend(item)
        elif command == mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH:
            self._return(item)
        elif command == mavlink.MAV_CMD_DO_CHANGE_SPEED:
            self._speed_m_s = _speed_after(item, self._speed_m_s, self._usual_speed_m_s)
        elif command in GIMBAL_COMMANDS:
            self._gimbal, why = gimbal_after(item, self._gimbal, self._vehicle)
            if why:
                turned = command not in ROI_COMMANDS  # a region turns a vehicle without gimbal
                self._leave_out(item.label, why, gimbal_only=turned)
        elif command in NO_EFFECT or _is_off(item):
            self._no_effect[command_name(command)] = None
        else:
            flies = command <= mavlink.MAV_CMD_NAV_LAST or command in FLY_TOO
            gimbal_only = command in GIMBAL_ONLY
            self._leave_out(item.label, gap=flies and command not in VIEW, gimbal_only=gimbal_only)

    def _leave_out(
        self, label: str, why: str = "", *, gap: bool = False, gimbal_only: bool = False
    ) -> None:
        text = f"{label}: {why}" if why else label
        self._not_judged[NotJudged(text, gimbal_only, gap)] = None
        self._gap |= gap

    def _take_off(self, item: MissionItem) -> None:
        """Climb straight up; ArduPilot ignores a take-off's coordinates, PX4 flies there."""
        altitude = item.altitude_m
        if altitude is not None:
            self._level = (altitude, _above(item))
        if self._path:
            if self._vehicle.is_px4 and item.place is not None:
                self._add("take-off", item, item.place)
            return
        place = self._home or item.place
        if altitude is not None and _above(item) is HeightAbove.HOME:
            self._takeoff_m = altitude
        if place is None:
            return
        self._at = _checked(item, "the take-off", place)
        if self._level is not None:
            name = "home" if self._home is not None else "take-off"
            self._launch = MissionPlace(name, 0, *place, *self._level)
        if self._vehicle.is_px4 and item.place is not None and item.place != place:
            self._add("take-off", item, item.place)

    def _fly_to(self, item: MissionItem, altitude_m: float | None) -> None:
        name = self._names.setdefault(item.number, str(len(self._names) + 1))
        place = item.place or self._at
        if altitude_m is not None:
            self._level = (altitude_m, _above(item))
        if place is None:  # on the spot, and nobody knows where that is
            return
        self._add(name, item, place)

    def _add(self, name: str, item: MissionItem, place: tuple[float, float]) -> None:
        what = f"waypoint {name}" if name.isdecimal() else name
        self._at = _checked(item, what, place)
        height, above = self._level or (0.0, HeightAbove.HOME)
        if not math.isfinite(height):
            raise MissionError(f"{what} is no place: its altitude is {height}")
        gap, self._gap = self._gap, False
        curved = item.command == mavlink.MAV_CMD_NAV_SPLINE_WAYPOINT
        circle, notes = circle_of(item, self._vehicle)
        self._notes |= dict.fromkeys(notes)
        there = MissionPlace(
            name,
            item.number,
            *place,
            height,
            above,
            self._gimbal,
            self._speed_m_s,
            gap,
            curved,
            circle,
        )
        self._path.append(there)

    def _note_place(self, item: MissionItem) -> None:
        _above(item)  # a local frame's coordinates are no latitude and longitude
        if item.command == mavlink.MAV_CMD_NAV_LOITER_UNLIM:
            self._notes[f"{item.label} holds until the pilot goes on."] = None

    def _descend(self, item: MissionItem) -> None:
        """Fly to its coordinates at the present height, then down; an aeroplane glides there."""
        if item.place is None:
            return
        _above(item)
        glides = item.command == mavlink.MAV_CMD_NAV_LAND and self._vehicle.has_wings
        altitude = item.parameters[6]
        before = self._level
        self._fly_to(item, altitude if glides and math.isfinite(altitude) else None)
        self._level = before

    def _return(self, item: MissionItem) -> None:
        if self._home is None:
            self._leave_out(item.label, "the mission has no home")
            return
        if self._vehicle.has_rally_points:
            self._leave_out(item.label, "it may return to a rally point")
        self._add("home", item, self._home)


def _takes_off_next(items: Sequence[MissionItem | UnreadItem]) -> bool:
    """Whether a take-off follows: only that continues a landing (AP_Mission::is_takeoff_next)."""
    for item in items:
        if not isinstance(item, MissionItem):
            return False
        if item.command in TAKEOFFS:
            return True
        if item.command not in NO_EFFECT and item.command <= mavlink.MAV_CMD_NAV_LAST:
            return False
    return False


def _is_off(item: MissionItem) -> bool:
    """Whether the command's parameter disables it."""
    mode = item.parameters[0]
    if item.command == mavlink.MAV_CMD_NAV_GUIDED_ENABLE:
        return not mode > 0.5
    if item.command == mavlink.MAV_CMD_DO_MOUNT_CONFIGURE:
        return bool(mode == mavlink.MAV_MOUNT_MODE_MAVLINK_TARGETING)
    return False


def _speed_after(item: MissionItem, before: float | None, usual: float | None) -> float | None:
    """Speed after DO_CHANGE_SPEED, m/s; -1 keeps `before`, -2 is the vehicle's `usual` one."""
    kind, speed = item.parameters[:2]
    if kind not in (mavlink.SPEED_TYPE_AIRSPEED, mavlink.SPEED_TYPE_GROUNDSPEED):
        return before
    if speed == -2:
        return usual
    return speed if math.isfinite(speed) and speed > 0 else before


def _above(item: MissionItem) -> HeightAbove:
    if item.frame not in FRAMES:
        raise MissionError(
            f"{item.label} is in frame {item.frame}; known are {sorted(FRAMES)} (MAV_FRAME): save "
            "the mission with global coordinates"
        )
    return FRAMES[item.frame]


def _checked(item: MissionItem, what: str, place: tuple[float, float]) -> tuple[float, float]:
    latitude, longitude = place
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 360.0):  # NaN is not either
        raise MissionError(
            f"{what} is no place: item {item.number} lies at {latitude:g}, {longitude:g} degrees; "
            "load the mission into the vehicle again, or save it again"
        )
    return place
