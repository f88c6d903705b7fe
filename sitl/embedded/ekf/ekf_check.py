"""ArduCopter's ekf_check and gpsglitch_check: detect a failed EKF."""

from __future__ import annotations

from collections.abc import Callable

from sitl.embedded.ekf.estimator import Estimator
from sitl.embedded.parameters import Parameters
from sitl.embedded.severity import CRITICAL

_CHECKS_TO_FAIL = 10  # consecutive 10 Hz checks before the EKF failsafe
_WARNING_PERIOD_S = 30.0


class EkfCheck:
    """Checks the EKF's variances and innovations; call both methods at 10 Hz.

    failsafe: set by the caller if it acts on a failure. The check clears it, with a text, when the
    EKF is good again.
    """

    def __init__(
        self, parameters: Parameters, estimator: Estimator, notify: Callable[[int, str], None]
    ) -> None:
        self.failsafe = False
        self._parameters = parameters
        self._estimator = estimator
        self._notify = notify
        self._fails = 0
        self._bad = False
        self._ever_good = False
        self._last_warning = -1e9
        self._glitching = False

    def fails(self, time_s: float) -> bool:
        """True once per failure: at the check that completes the required number of failing checks.
        Never before the EKF was good once.
        """
        limit = self._parameters["FS_EKF_THRESH"]
        if self._estimator.origin is None or limit <= 0:
            return False
        passed = self._passes(limit)
        self._ever_good |= passed
        if not self._ever_good:
            return False
        if passed:
            self._fails = max(0, self._fails - 1)
            if self._bad and self._fails == 0:
                self._recover()
            return False
        if self._bad:
            return False
        self._fails += 1
        self._bad = self._fails >= _CHECKS_TO_FAIL
        if self._bad and time_s - self._last_warning > _WARNING_PERIOD_S:
            self._last_warning = time_s
            self._notify(CRITICAL, "EKF variance")
        return self._bad

    def report_glitch(self) -> None:
        """Send a text when GNSS leaves the innovation gate, and when it returns."""
        if self._estimator.gps_glitching is self._glitching:
            return
        self._glitching = not self._glitching
        text = "GPS Glitch or Compass error" if self._glitching else "Glitch cleared"
        self._notify(CRITICAL, text)

    def _passes(self, limit: float) -> bool:
        velocity, position, _, compass = self._estimator.variances
        over = int(compass >= limit) + (2 if velocity >= 2 * limit else int(velocity >= limit))
        bad = over >= 2 or (over >= 1 and position >= limit)
        return not bad and self._estimator.position_valid

    def _recover(self) -> None:
        self._bad = False
        if self.failsafe:
            self.failsafe = False
            self._notify(CRITICAL, "EKF Failsafe Cleared")
