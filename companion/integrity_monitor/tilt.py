"""Compares vision's roll and pitch with the autopilot's and the gimbal's.

Low over ground with little structure, a tilt and a shift have the same effect on the image: the
position is wrong by the tilt times the height, its motion is nearly right, and the image matches.
The gravity direction of the other sensors shows the tilt.
"""

from __future__ import annotations

import math

from companion.integrity_monitor.step import UNREPORTED_JUMP_M
from localizer.sensors.error_model import SENSORS
from mavlink_bridge import quaternion as quat
from mavlink_bridge.messages import Attitude, VisionFix

_SIGMAS, _CALM_SIGMAS = 3.0, 2.0
# Roll and pitch of gimbal and autopilot with mounting, an axis.
_SIGMA_RAD = math.radians(SENSORS.mounted_tilt_deg)
# What is larger is a jump, and held; a gimbal that was knocked costs no more.
_MOST_M = UNREPORTED_JUMP_M
_HOLDS_NS = 1_000_000_000  # without an attitude: a link loses some


class TiltCheck:
    """Compares the tilt of every fix; see the module. It does not estimate a constant bias of the
    gimbal. A wrong tilt that grows slowly from the first fix on (1.5 degrees in 2 s,
    `begins-denied`) would become part of such a bias.
    """

    def __init__(self) -> None:
        self._off_rad = 0.0
        self._share = 0.0  # of its sigma
        self._checked_ns: int | None = None
        self.tilts = False
        """The newest fix is tilted as neither gimbal nor autopilot explain."""
        self.is_known = False
        """Whether there was an attitude of late. What the last one said holds until the next: a
        position is no better because nobody looks.
        """

    @property
    def off_deg(self) -> float:
        """Tilt between vision and autopilot, degrees, of the newest fix with both attitudes."""
        return math.degrees(self._off_rad)

    def metres(self, height_m: float | None) -> float:
        """Position error from the tilt, m: tilt times height above the ground; 0 below 2 sigma of
        the tilt, all of it above 3 sigma. At most a jump (`UNREPORTED_JUMP_M`), as for unknown
        height (None).
        """
        believed = (self._share - _CALM_SIGMAS) / (_SIGMAS - _CALM_SIGMAS)
        shift_m = _MOST_M if height_m is None else height_m * self._off_rad
        return min(shift_m * min(max(believed, 0.0), 1.0), _MOST_M)

    def add(self, fix: VisionFix, attitude: Attitude | None) -> None:
        """Add a fix. attitude: the autopilot's at its time, None if unknown."""
        if attitude is None or fix.quaternion is None:
            since = self._checked_ns
            self.is_known = since is not None and abs(fix.time_ns - since) <= _HOLDS_NS
            return
        self._checked_ns, self.is_known = fix.time_ns, True
        self._off_rad = math.dist(_level(fix.quaternion), _level(attitude.quaternion))
        self._share = self._off_rad / math.hypot(_SIGMA_RAD, fix.attitude_sigma_rad)
        self.tilts = self._share > (_CALM_SIGMAS if self.tilts else _SIGMAS)


def _level(ned_from_body: quat.Quaternion) -> tuple[float, float]:
    """The vertical in body axes: forward and right component of the unit vector down."""
    forward, right, _ = quat.rotate(quat.conjugate(ned_from_body), (0.0, 0.0, 1.0))
    return forward, right
