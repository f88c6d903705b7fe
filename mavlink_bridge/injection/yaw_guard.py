"""Checks vision's yaw against the autopilot's and the gyros', because ArduPilot does not.

Measured: a vision frame rotated by 5 deg causes 25 m of error without a warning; a yaw error of 30
deg is accepted with EK3_SRC1_YAW = 6. The EKF's own yaw is no reference: it steps by up to 8 deg
after take-off and drifts by 6 deg in hover on ODOMETRY. So the first fixes must agree with the
autopilot's yaw, and later ones must turn as the gyros do. Agreement with the autopilot does not
excuse a turn against the gyros: a frame rotated by 5 deg came within 3 deg of an EKF yaw that was 2
deg wrong.
"""

from __future__ import annotations

import math
import statistics
from collections import deque

from mavlink_bridge.messages import Attitude, VisionFix
from mavlink_bridge.quaternion import wrap_pi
from mavlink_bridge.vehicle.sensor_errors import VEHICLE_SENSORS

_LIMIT_RAD = math.radians(3.5)  # against the autopilot's yaw, or its gyros since earlier fixes
_GROSS_RAD = math.radians(20.0)  # largest difference in any case
_MEMORY_S = 60.0  # time for which the gyros are used
_MINIMUM_SAMPLES = 5  # fixes compared: the majority blocks, all release
_BASELINE_NS = 1_000_000_000
_RELEASE_SHARE = 0.7
_BLIND_AFTER = 20  # fixes in a row


class YawGuard:
    """Rejects fixes whose yaw changed wrongly, and blocks injection if most of the last ones did.

    It blocks if the majority of five fixes fail, because noise lets some fixes of a
    rotated frame pass. It releases after as many good fixes in a row, tested with a smaller limit.
    """

    def __init__(self) -> None:
        # (time, vision minus gyro heading, vision minus autopilot)
        self._accepted: deque[tuple[int, float, float]] = deque(maxlen=256)
        self._last: deque[bool] = deque(maxlen=_MINIMUM_SAMPLES)
        self._reset_count = 0  # of the fix before
        self.blocked = False
        self.difference_rad: float | None = None
        """The last fix's yaw minus the autopilot's; None while none could be compared."""
        self._unchecked_in_a_row = 0

    @property
    def refused_rad(self) -> float | None:
        """Yaw difference for which injection is blocked; None while it is not."""
        return self.difference_rad if self.blocked else None

    @property
    def blind(self) -> bool:
        """Whether the last 20 or more fixes had no yaw to compare."""
        return self._unchecked_in_a_row >= _BLIND_AFTER

    def reset(self) -> None:
        """Forget the history, because the autopilot rebooted and its yaw changed."""
        self._accepted.clear()
        self._last.clear()
        self.blocked = False

    def accepts(self, fix: VisionFix, autopilot: Attitude | None) -> bool:
        """Check one fix, in order of time; whether it may be sent. autopilot: its attitude at that
        time, None if unknown. A fix without both yaws passes unless the guard blocks.
        """
        time_ns, vision_yaw_rad = fix.time_ns, fix.yaw_rad
        reset = fix.reset_count != self._reset_count
        self._reset_count = fix.reset_count
        if autopilot is None or vision_yaw_rad is None:
            self._unchecked_in_a_row += 1
            return not self.blocked
        self._unchecked_in_a_row = 0
        self.difference_rad = difference = wrap_pi(vision_yaw_rad - autopilot.yaw_rad)
        to_gyros = wrap_pi(vision_yaw_rad - autopilot.gyro_heading_rad)
        good = self._agrees(time_ns, difference, to_gyros, reset)
        self._update_block(good)
        accept = good and not self.blocked
        if good and reset:
            self._accepted.clear()  # what follows is held against this fix, not against the past
        if accept:
            self._accepted.append((time_ns, to_gyros, difference))
        return accept

    def _update_block(self, good: bool) -> None:
        """Add a result; block or release by the last ones."""
        last = self._last
        last.append(good)
        if self.blocked:
            change = len(last) == last.maxlen and all(last)
        else:
            change = 2 * last.count(False) > _MINIMUM_SAMPLES
        if change:
            self.blocked = not self.blocked
            last.clear()

    def _agrees(self, time_ns: int, difference: float, to_gyros: float, reset: bool) -> bool:
        limit = _LIMIT_RAD * (_RELEASE_SHARE if self.blocked else 1.0)
        near = abs(difference) <= limit
        if abs(difference) > _GROSS_RAD or not self._accepted:
            return near
        newest_ns = self._accepted[-1][0]
        gap_s = (time_ns - newest_ns) * 1e-9
        if gap_s > _MEMORY_S:
            return near
        recent = [entry for entry in self._accepted if newest_ns - entry[0] <= _BASELINE_NS]
        turned = abs(statistics.median(wrap_pi(to_gyros - entry[1]) for entry in recent))
        if turned <= min(limit + VEHICLE_SENSORS.gyro_drift_radps * gap_s, _GROSS_RAD):
            return True
        # The gyro heading suffers where ATTITUDE was lost in a turn; the autopilot's yaw does not.
        against = abs(statistics.median(wrap_pi(difference - entry[2]) for entry in recent))
        return near and (reset or against <= limit)
