"""Pre-arm checks with ArduPilot's texts, in ArduPilot's order."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sitl.embedded.ekf.aided_filter import EXTERNAL, GPS

if TYPE_CHECKING:
    from sitl.embedded.aircraft import Aircraft

_ALL, _GPS_CHECK, _INS, _VISION = 1, 1 << 3, 1 << 4, 1 << 18  # ARMING_CHECK
GYRO_SETTLE_S = 25.0  # as measured on ArduPilot SITL


def arming_failures(vehicle: Aircraft) -> list[str]:
    """The texts of all arming checks that fail, as ArduPilot words them; an empty list if the
    vehicle may arm.
    """
    failures = _optional(vehicle) + _mandatory(vehicle)
    if not vehicle.modes.mode.armable:
        failures.append(f"{vehicle.modes.mode.name} mode not armable")
    return failures


def _optional(v: Aircraft) -> list[str]:
    failures = []
    if _enabled(v, _INS) and v.time_s < GYRO_SETTLE_S:
        failures.append("Gyros inconsistent")
    if _enabled(v, _GPS_CHECK):
        if v.parameters["GPS1_TYPE"] > 0 and not v.gps_has_fix:
            failures.append("GPS 1: Bad fix")
        elif v.parameters["GPS1_TYPE"] > 0 and not v.gps_healthy:
            failures.append("GPS 1: not healthy")
        elif v.modes.home is None:
            failures.append("AHRS: waiting for home")
    visual = v.parameters["VISO_TYPE"] > 0
    if _enabled(v, _VISION) and visual and not v.injection.healthy(v.time_ms):
        failures.append("VisOdom: not healthy")
    return failures


def _enabled(v: Aircraft, check: int) -> bool:
    return bool(int(v.parameters["ARMING_CHECK"]) & (_ALL | check))


def _mandatory(v: Aircraft) -> list[str]:
    sources = _source_failure(v)
    if sources:
        return [f"AHRS: {sources}"]
    if not v.modes.mode.needs_position:
        return []
    if not v.estimator.position_valid:
        return ["Need Position Estimate"]
    if v.estimator.gps_glitching:
        return ["GPS glitching"]
    limit = v.parameters["FS_EKF_THRESH"]
    velocity, position, height, compass = v.estimator.variances
    named = (
        ("compass", compass),
        ("position", position),
        ("velocity", velocity),
        ("height", height),
    )
    return [f"EKF {name} variance" for name, value in named if 0 < limit <= value][:1]


def _source_failure(v: Aircraft) -> str | None:
    """EKF3's check that every configured source has its sensor."""
    position = [
        int(v.parameters[f"EK3_SRC{n}_{what}"])
        for n in (1, 2, 3)
        for what in ("POSXY", "VELXY", "POSZ", "VELZ")
        if v.modes.mode.needs_position
    ]
    yaw = [int(v.parameters[f"EK3_SRC{n}_YAW"]) for n in (1, 2, 3)]
    if GPS in position and v.parameters["GPS1_TYPE"] == 0:
        return "EK3 sources require GPS"
    if EXTERNAL in position + yaw and v.parameters["VISO_TYPE"] == 0:
        return "EK3 sources require VisualOdom"
    return None
