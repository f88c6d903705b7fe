"""Cross-check of the vision yaw against the autopilot's, because ArduPilot makes none.

Measured: a vision frame rotated by 5 deg costs 25 m with no warning, and a 30 deg wrong yaw is
accepted with EK3_SRC1_YAW = 6. Measured as well: in hover on ODOMETRY the EKF's own yaw wandered by
6 deg within seconds while vision was right, and withholding vision then ended in LAND. So a fix
passes when its yaw agrees with the autopilot's, or when their difference is the one that was seen
with the fixes before: the autopilot's yaw may drift, a vision frame that turns does so at once.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from dataclasses import dataclass

from mavlink_bridge.config import YawGuardConfig
from mavlink_bridge.quaternion import wrap_pi

_BASELINE_NS = 1_000_000_000
_RELEASE_SHARE = 0.7
_DRIFT_RAD_PER_S = math.radians(0.3)  # of the autopilot's yaw while no fix is seen


@dataclass(frozen=True)
class YawVerdict:
    """What the guard says of one fix. accept: send it; difference_rad: vision minus autopilot."""

    accept: bool
    difference_rad: float


class YawGuard:
    """Refuses fixes whose yaw turned, and blocks injection when they keep coming.

    Blocking takes `minimum_samples` refused fixes in a row, releasing as many good ones, held to
    a tighter limit.
    """

    def __init__(self, config: YawGuardConfig) -> None:
        self._config = config
        self._accepted: deque[tuple[int, float]] = deque(maxlen=256)
        self._in_a_row = 0
        self.blocked = False
        self.unchecked = 0

    def reset(self) -> None:
        """The autopilot started over: its yaw did, too."""
        self._accepted.clear()
        self._in_a_row = 0
        self.blocked = False

    def check(self, time_ns: int, vision_yaw_rad: float, autopilot_yaw_rad: float) -> YawVerdict:
        """Judge one fix; NaN on either side cannot be judged and follows the standing verdict."""
        if not self._config.enabled:
            return YawVerdict(True, math.nan)
        if not (math.isfinite(vision_yaw_rad) and math.isfinite(autopilot_yaw_rad)):
            self.unchecked += 1
            return YawVerdict(not self.blocked, math.nan)
        difference = wrap_pi(vision_yaw_rad - autopilot_yaw_rad)
        good = self._agrees(time_ns, difference)
        if good != self.blocked:
            self._in_a_row = 0
        else:
            self._in_a_row += 1
            if self._in_a_row >= self._config.minimum_samples:
                self.blocked, self._in_a_row = not self.blocked, 0
        accept = good and not self.blocked
        if accept:
            self._accepted.append((time_ns, difference))
        return YawVerdict(accept, difference)

    def _agrees(self, time_ns: int, difference: float) -> bool:
        limit = math.radians(self._config.limit_deg) * (_RELEASE_SHARE if self.blocked else 1.0)
        gross = math.radians(self._config.gross_deg)
        if abs(difference) <= limit:
            return True
        if abs(difference) > gross or not self._accepted:
            return False
        newest_ns = self._accepted[-1][0]
        gap_s = (time_ns - newest_ns) * 1e-9
        if gap_s > self._config.memory_s:
            return False
        recent = [d for t, d in self._accepted if newest_ns - t <= _BASELINE_NS]
        # A turn within the wrap is impossible here: both are within `gross` of zero.
        change = abs(difference - statistics.median(recent))
        return change <= min(limit + _DRIFT_RAD_PER_S * gap_s, gross)
