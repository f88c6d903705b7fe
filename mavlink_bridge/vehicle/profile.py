"""Firmware profiles: how each autopilot interprets the injected messages.

Measured or read from source; messages.md has the table and the sources.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.config import InjectionMessage
from mavlink_bridge.vehicle.origin import Projection

CovarianceFormula = Literal["cbrt", "sqrt", "variance"]
Version = tuple[int, int, int]


@dataclass(frozen=True)
class FirmwareProfile:
    """How one firmware interprets the injected messages.

    covariance: how it turns the message's diagonal into an error (see `covariance_entry`).
    max_delay_ms: age beyond which a measurement cannot be fused any more. messages: the injection
    messages that it accepts. odometry_frame: MAV_FRAME that it accepts for positions. least_lag:
    whether its delay parameter is the smallest lag of the last 100 messages; it then dates the
    other messages by their timestamps (ArduPilot's AP_HAL JitterCorrection). position_delta:
    whether it keeps a relative position with VISION_POSITION_DELTA alone. known: False for the
    profile of an unknown firmware.
    """

    name: str
    covariance: CovarianceFormula
    projection: Projection
    max_delay_ms: float
    messages: tuple[InjectionMessage, ...]
    odometry_frame: int
    least_lag: bool = False
    position_delta: bool = False
    known: bool = True


ARDUPILOT = FirmwareProfile(
    name="ArduPilot 4.5-4.7",
    covariance="cbrt",
    projection="ardupilot",
    max_delay_ms=250.0,
    messages=(
        "vision_position_estimate", "odometry", "gps_input", "external_position_estimate",
    ),
    odometry_frame=mavlink.MAV_FRAME_LOCAL_FRD,
    least_lag=True,
    position_delta=True,
)  # fmt: skip
# Pull request 32084 (merged February 2026) replaced the cube root.
ARDUPILOT_SQRT = replace(ARDUPILOT, name="ArduPilot 4.8+", covariance="sqrt")
PX4 = FirmwareProfile(
    name="PX4 1.15+",
    covariance="variance",
    projection="px4",
    max_delay_ms=300.0,
    messages=("vision_position_estimate", "odometry", "global_position_sensor"),
    odometry_frame=mavlink.MAV_FRAME_LOCAL_NED,
)
# The cube-root entry overstates the error in every formula below 3 m, so it is the safe one.
GENERIC = FirmwareProfile(
    name="generic",
    covariance="cbrt",
    projection="ardupilot",
    max_delay_ms=250.0,
    messages=("vision_position_estimate",),
    odometry_frame=mavlink.MAV_FRAME_LOCAL_FRD,
    known=False,
)


def autopilot_name(autopilot: int) -> str:
    """ "ardupilot", "px4" or "unknown" for a MAV_AUTOPILOT."""
    return {
        mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ardupilot",
        mavlink.MAV_AUTOPILOT_PX4: "px4",
    }.get(autopilot, "unknown")


def decode_version(flight_sw_version: int) -> Version:
    """(major, minor, patch) of AUTOPILOT_VERSION.flight_sw_version."""
    return (
        flight_sw_version >> 24 & 0xFF,
        flight_sw_version >> 16 & 0xFF,
        flight_sw_version >> 8 & 0xFF,
    )


def select_profile(autopilot: str, version: Version | None) -> FirmwareProfile:
    """The profile of `autopilot_name` and version. version None: not known yet, the newest known
    profile. `GENERIC` for another autopilot, or before ArduPilot 4.5 or PX4 1.15.
    """
    if autopilot == "ardupilot":
        if version is None or (4, 5, 0) <= version < (4, 8, 0):
            return ARDUPILOT
        return ARDUPILOT_SQRT if version >= (4, 8, 0) else GENERIC
    if autopilot == "px4" and (version is None or version >= (1, 15, 0)):
        return PX4
    return GENERIC


def covariance_entry(error: float, formula: CovarianceFormula) -> float:
    """Diagonal entry that the firmware reads as the 1-sigma error `error` (m or rad).

    cbrt: ``error = cbrt(3 c^2)`` (ArduPilot 4.5-4.7, GCS_Common.cpp). sqrt: ``error = sqrt(3 c)``
    (pull request 32084). variance: ``c = error^2``, as MAVLink defines it (PX4).
    """
    if formula == "cbrt":
        return math.sqrt(error**3 / 3.0)
    if formula == "sqrt":
        return error**2 / 3.0
    return error**2
