"""Pre-arm checks with ArduPilot's texts, in ArduPilot's order."""

from __future__ import annotations

from dataclasses import dataclass

from sitl.embedded.ekf.aided_filter import EXTERNAL, GPS
from sitl.embedded.ekf.estimator import Estimator
from sitl.embedded.parameters import Parameters

_ALL, _GPS_CHECK, _INS, _VISION = 1, 1 << 3, 1 << 4, 1 << 18  # ARMING_CHECK
GYRO_SETTLE_S = 25.0  # as measured on ArduPilot SITL


@dataclass(frozen=True)
class ArmingContext:
    """Vehicle state that the pre-arm checks use."""

    time_s: float
    parameters: Parameters
    estimator: Estimator
    mode_name: str
    mode_armable: bool
    needs_position: bool
    home_set: bool
    gps_fix: bool
    gps_healthy: bool
    vision_healthy: bool


def arming_failures(context: ArmingContext) -> list[str]:
    """The texts of all arming checks that fail, as ArduPilot words them; an empty list if the
    vehicle may arm.
    """
    failures = _optional(context) + _mandatory(context)
    if not context.mode_armable:
        failures.append(f"{context.mode_name} mode not armable")
    return failures


def _optional(c: ArmingContext) -> list[str]:
    failures = []
    if _enabled(c, _INS) and c.time_s < GYRO_SETTLE_S:
        failures.append("Gyros inconsistent")
    if _enabled(c, _GPS_CHECK):
        if c.parameters["GPS1_TYPE"] > 0 and not c.gps_fix:
            failures.append("GPS 1: Bad fix")
        elif c.parameters["GPS1_TYPE"] > 0 and not c.gps_healthy:
            failures.append("GPS 1: not healthy")
        elif not c.home_set:
            failures.append("AHRS: waiting for home")
    if _enabled(c, _VISION) and c.parameters["VISO_TYPE"] > 0 and not c.vision_healthy:
        failures.append("VisOdom: not healthy")
    return failures


def _enabled(c: ArmingContext, check: int) -> bool:
    return bool(int(c.parameters["ARMING_CHECK"]) & (_ALL | check))


def _mandatory(c: ArmingContext) -> list[str]:
    sources = _source_failure(c)
    if sources:
        return [f"AHRS: {sources}"]
    if not c.needs_position:
        return []
    if not c.estimator.position_valid:
        return ["Need Position Estimate"]
    if c.estimator.gps_glitching:
        return ["GPS glitching"]
    limit = c.parameters["FS_EKF_THRESH"]
    velocity, position, height, compass = c.estimator.variances
    named = (
        ("compass", compass),
        ("position", position),
        ("velocity", velocity),
        ("height", height),
    )
    return [f"EKF {name} variance" for name, value in named if 0 < limit <= value][:1]


def _source_failure(c: ArmingContext) -> str | None:
    """EKF3's check that every configured source has its sensor."""
    position = [
        int(c.parameters[f"EK3_SRC{n}_{what}"])
        for n in (1, 2, 3)
        for what in ("POSXY", "VELXY", "POSZ", "VELZ")
        if c.needs_position
    ]
    yaw = [int(c.parameters[f"EK3_SRC{n}_YAW"]) for n in (1, 2, 3)]
    if GPS in position and c.parameters["GPS1_TYPE"] == 0:
        return "EK3 sources require GPS"
    if EXTERNAL in position + yaw and c.parameters["VISO_TYPE"] == 0:
        return "EK3 sources require VisualOdom"
    return None
