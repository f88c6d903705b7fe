"""Limits of the calibration watch."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CalibrationLimits:
    """A value above its limit and four of its sigmas raises an alert and inhibits injection."""

    enabled: bool = True
    focal_share: float = 0.025  # focal length error
    boresight_deg: float = 3.0  # boresight error against gimbal and autopilot
    time_s: float = 0.08  # time offset
