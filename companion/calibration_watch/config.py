"""From when on a calibration is called wrong."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CalibrationLimits:
    """A finding beyond a limit is told, and injection does not begin; four sigmas must agree."""

    enabled: bool = True
    focal_share: float = 0.025  # focal length error
    boresight_deg: float = 3.0  # boresight error against gimbal and autopilot
    time_s: float = 0.08  # time offset
