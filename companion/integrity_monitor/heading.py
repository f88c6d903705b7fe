"""Compares vision's heading with the gyros', to detect a rotated frame of reference.

A map frame turned by 5 degrees about home puts a hover at 120 m 10 m aside. From then on the
position moves as the IMU does, so its motion shows no fault. The turn itself does, against gyros
and autopilot.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from dataclasses import dataclass

from localizer.sensors.error_model import SENSORS
from mavlink_bridge.messages import Attitude, VisionFix
from mavlink_bridge.quaternion import wrap_pi
from mavlink_bridge.vehicle.sensor_errors import VEHICLE_SENSORS

_SPAN_NS = 1_000_000_000  # over which the heading is the median
_LEAST = 3
_SIGMAS = 4.0
_OFF_RAD = math.radians(SENSORS.heading_step_deg)
_KEPT = 64


@dataclass(frozen=True)
class HeadingChange:
    """Vision's heading of a fix minus that of the gyros and of the autopilot, rad; its sigma."""

    time_ns: int
    against_gyros: float
    against_autopilot: float
    sigma: float


def heading_change(fix: VisionFix, attitude: Attitude | None) -> HeadingChange | None:
    """The heading differences of a fix; None if one of the headings is unknown. attitude: the
    autopilot's at the fix's time.
    """
    yaw_rad = fix.yaw_rad
    if attitude is None or yaw_rad is None:
        return None
    return HeadingChange(
        fix.time_ns,
        wrap_pi(yaw_rad - attitude.gyro_heading_rad),
        wrap_pi(yaw_rad - attitude.yaw_rad),
        fix.attitude_sigma_rad,
    )


class HeadingHistory:
    """Heading differences of the newest 64 fixes in time order."""

    def __init__(self) -> None:
        self._turns: deque[HeadingChange] = deque(maxlen=_KEPT)

    def add(self, turn: HeadingChange | None) -> None:
        """Add a fix's heading difference; None is ignored."""
        if turn is not None:
            self._turns.append(turn)

    def rotation_from_median(self, turn: HeadingChange) -> float:
        """Size of a fix's rotation from the median of the newest second, rad; 0 with too few
        headings.

        The gyros' heading has errors after lost ATTITUDE messages, and the autopilot's may step; a
        rotation counts only if both show it.
        """
        newest = self._newest()
        if len(newest) < _LEAST:
            return 0.0
        return min(
            abs(_median([wrap_pi(turn.against_gyros - one.against_gyros) for one in newest])),
            abs(
                _median([wrap_pi(turn.against_autopilot - one.against_autopilot) for one in newest])
            ),
        )

    def is_rotated(self, turn: HeadingChange) -> bool:
        """Whether a fix's heading is rotated by more than noise and gyro drift explain."""
        if not self._turns:
            return False
        newest = self._turns[-1]
        # Errors of vision are alike within a second: a median has the sigma of one.
        noise = _SIGMAS * math.hypot(newest.sigma, turn.sigma)
        drift = VEHICLE_SENSORS.gyro_drift_radps * (turn.time_ns - newest.time_ns) * 1e-9
        return self.rotation_from_median(turn) > _OFF_RAD + noise + drift

    def _newest(self) -> list[HeadingChange]:
        """Headings of the last second, and at least the newest three."""
        turns = list(self._turns)
        since_ns = turns[-1].time_ns - _SPAN_NS if turns else 0
        within = sum(turn.time_ns > since_ns for turn in turns)
        return turns[-max(within, _LEAST) :]


def _median(angles: list[float]) -> float:
    """Median of angles (rad) near the first one, because angles wrap."""
    return wrap_pi(angles[0] + statistics.median(wrap_pi(a - angles[0]) for a in angles))
