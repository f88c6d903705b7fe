"""Protection levels: how wrong a fix may be at the stated risk, when more than noise is wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.guardian.config import ProtectionConfig
from mavlink_bridge.messages import VehicleState, VisionFix


@dataclass(frozen=True)
class ProtectionLevel:
    """Metres that the error exceeds with the configured risk at most."""

    horizontal_m: float
    vertical_m: float


def protection_level(
    fix: VisionFix, state: VehicleState, config: ProtectionConfig
) -> ProtectionLevel:
    """The level of a fix: noise at the risk, plus map, calibration and time, as if they added up.

    Horizontally the noise is that of a circular distribution of the worst axis: exp(-k^2/2) = risk;
    vertically a normal one, bounded by the same exponential.
    """
    k = math.sqrt(-2.0 * math.log(config.risk))
    P = fix.position_covariance_ned
    horizontal = math.sqrt(max(float(np.linalg.eigvalsh(P[:2, :2])[-1]), 0.0))
    vertical = math.sqrt(max(float(P[2, 2]), 0.0))
    height = state.altitude_relative_m or 0.0
    velocity = state.local_velocity_ned or (0.0, 0.0, 0.0)
    bias = config.map_m + config.calibration_share * max(height, 0.0)
    return ProtectionLevel(
        k * horizontal + bias + config.time_bias_s * math.hypot(*velocity[:2]),
        k * vertical + bias + config.time_bias_s * abs(velocity[2]),
    )
