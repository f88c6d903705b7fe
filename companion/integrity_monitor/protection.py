"""Protection levels: bounds of the position error at a stated risk, with errors beyond the
covariance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.calibration_watch.observation import UNKNOWN_HEIGHT_M
from companion.integrity_monitor.config import ProtectionConfig
from mavlink_bridge.messages import VehicleState, VisionFix

_UNKNOWN_MPS = (15.0, 3.0)  # horizontally and vertically, of a vehicle that does not say


@dataclass(frozen=True)
class ProtectionLevel:
    """Bounds of the error, metres; exceeded with the configured risk at most."""

    horizontal_m: float
    vertical_m: float


def protection_level(
    fix: VisionFix,
    state: VehicleState,
    config: ProtectionConfig,
    known_m: float,
    height_m: float | None,
) -> ProtectionLevel:
    """The protection level of a fix. state: gives the velocity; without one that of the fix, or 15
    m/s and 3 m/s up, are taken. known_m: estimated position error, added to the bound; height_m:
    above the ground, None (taken as 120 m) where unknown.
    """
    velocity = state.local_velocity_ned or fix.velocity_ned
    speeds = _UNKNOWN_MPS
    if velocity is not None:
        speeds = (math.hypot(*velocity[:2]), abs(velocity[2]))
    if height_m is None:
        height_m = UNKNOWN_HEIGHT_M
    across, up = budget((fix.horizontal_sigma_m, fix.vertical_sigma_m), height_m, speeds, config)
    return ProtectionLevel(across + known_m, up + known_m)


def budget(
    sigma_m: tuple[float, float],
    height_m: float,
    speeds_mps: tuple[float, float],
    config: ProtectionConfig,
) -> tuple[float, float]:
    """Horizontal and vertical level, metres: k times the root of the summed variances.

    Errors of noise, map, calibration and time are independent. The horizontal error is taken as
    circular with the sigma of the worst axis: exp(-k^2/2) = risk. The vertical error is normal and
    bounded by the same exponential. sigma_m, speeds_mps: horizontal and vertical; height_m: above
    the ground.
    """
    k = math.sqrt(-2.0 * math.log(config.risk))
    maps = (config.map_m, config.map_height_m)
    calibration = config.calibration_share * height_m
    across, up = (
        k * math.hypot(sigma, of_map, calibration, config.time_bias_s * speed)
        for sigma, of_map, speed in zip(sigma_m, maps, speeds_mps, strict=True)
    )
    return across, up
