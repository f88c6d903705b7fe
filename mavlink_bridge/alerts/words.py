"""Alert values that are no numbers: each is one of a closed list."""

from __future__ import annotations

import enum
from typing import NewType

from pymavlink.dialects.v20 import ardupilotmega as mavlink

Name = NewType("Name", str)
"""A name from outside the catalogue: an address, a parameter, a target, a system error."""


class Word(str, enum.Enum):
    """A value of a closed list, shown as its text."""

    def __str__(self) -> str:
        return str(self.value)


class Output(Word):
    """Whether positions are being sent."""

    INJECTING = "injecting"
    NOTHING = "nothing is injected"


class SenderRefusal(Word):
    """Why commands of a system are refused: `bridge.ground_systems`, or signing."""

    NOT_ALLOWED = "not allowed"
    NOT_SIGNED = "not signed"


class LookAtRefusal(Word):
    """Why the gimbal is not pointed at a position."""

    OFF = "bridge.look_at is off"
    FIXED_CAMERA = "the camera is fixed"
    NO_PLACE = "no place on Earth"


class CommandAnswer(Word):
    """The autopilot's MAV_RESULT for a position command, or why there is none."""

    NOT_ASKED = "not asked, no GNSS"
    NOT_ANSWERED = "not answered"
    ACCEPTED = "accepted"
    TEMPORARILY_REJECTED = "temporarily rejected"
    DENIED = "denied"
    UNSUPPORTED = "unsupported"
    FAILED = "failed"
    IN_PROGRESS = "in progress"
    COMMAND_LONG_ONLY = "command long only"
    COMMAND_INT_ONLY = "command int only"
    UNKNOWN = "unknown"

    @classmethod
    def of(cls, result: int) -> CommandAnswer:
        """The answer of a MAV_RESULT."""
        known = mavlink.enums["MAV_RESULT"].get(result)
        name = "" if known is None else known.name.removeprefix("MAV_RESULT_")
        return cls.__members__.get(name, cls.UNKNOWN)


class InjectionOrder(Word):
    """Who enabled or disabled injection, if not an `RcChannel`."""

    START = "at the start"
    COMMAND = "command"


class RcChannel(int):
    """The RC channel that enabled or disabled injection."""

    def __str__(self) -> str:
        return f"channel {int(self)}"


class GnssProblem(Word):
    """Why the EKF should change from GNSS to vision."""

    LOST = "GNSS lost"
    GLITCH = "GNSS glitch"
    OFF_VISION = "GNSS off vision"


class ReturnCause(Word):
    """Why the EKF should return from vision to GNSS."""

    GNSS_GOOD = "GNSS good again"
    VISION_LOST = "vision lost, GNSS good"


class SwitchRefusal(Word):
    """Why the source set is kept, if the pilot did not choose it (`ChosenSet`)."""

    EKF_WITH_GNSS = "EKF with GNSS"
    NOT_READY = "not ready"


class ChosenSet(int):
    """The source set that the pilot chose."""

    def __str__(self) -> str:
        return f"set {int(self)} chosen"


class GnssDisagreement(Word):
    """Why a GNSS receiver is not accepted, after the unit of the difference."""

    OFF_VISION = "m off vision"
    NOISE = "m noise"
    CLAIMED = "m claimed"
    DRIFTS_FROM_VISION = "m/s off vision"
    DRIFTS_FROM_IMU = "m/s off IMU"


class CalibrationError(Word):
    """Direction or axis of a calibration error."""

    LONG = "long"
    SHORT = "short"
    LATE = "late"
    EARLY = "early"
    ROLL = "roll"
    PITCH = "pitch"
    YAW = "yaw"


class Direction(Word):
    """Eight directions, clockwise."""

    NORTH = "north"
    NORTH_EAST = "north-east"
    EAST = "east"
    SOUTH_EAST = "south-east"
    SOUTH = "south"
    SOUTH_WEST = "south-west"
    WEST = "west"
    NORTH_WEST = "north-west"


class MapOffsetUse(Word):
    """Whether the fixes are corrected by the map offset."""

    REPORTED = ""
    APPLIED = ", applied"


class ProcessFault(Word):
    """How the flight process ended."""

    HANGS = "hangs"
    DIED = "died"


class ClickRefusal(Word):
    """Why a click begins no target."""

    UNKNOWN = "position not known"
    UNCONFIRMED = "position not confirmed yet"
