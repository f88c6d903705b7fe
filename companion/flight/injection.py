"""Converts estimates to fixes and passes them to the bridge, unless a check holds them.

Each estimate is converted once, for injection and for the observers.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

from companion.conversions import CameraExtrinsics, vision_fix
from companion.integrity_monitor.debouncer import AlertDebouncer, CheckResult
from localizer.types import PoseEstimate, ReferenceBundle, TrackingState
from mavlink_bridge.alerts.catalogue import CATALOGUE
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.bridge import Bridge
from mavlink_bridge.messages import VisionFix

_log = logging.getLogger(__name__)

FixCheck = Callable[[VisionFix], VisionFix | None]
"""Checks a fix before injection. Returns the fix, perhaps with another covariance; None holds it.
It is called on the localization thread and returns at once. If it raises an exception, the fix is
held and an alert is raised.
"""

Observer = Callable[[PoseEstimate, ReferenceBundle, VisionFix], None]
"""Takes each fix before the checks change it, injected or not. It returns at once."""

_INJECTED = (TrackingState.TRACKING, TrackingState.BRIDGING)


def is_for_injection(estimate: PoseEstimate) -> bool:
    """Whether an estimate is converted to a fix and checked: accepted, TRACKING or BRIDGING."""
    return estimate.accepted and estimate.state in _INJECTED


class FixInjection:
    """Converts each accepted estimate to a fix, has it checked, and passes it to the bridge.

    It runs on the localization thread. The conversion takes 0.12 ms in the median (two geodetic
    conversions and two rotations, no access to the map). To wake another thread would take as long
    and make the fix older.

    It counts the jumps of the estimate (`VisionFix.reset_count`, from 1), so that the EKF resets to
    the new position. A jump is each start after LOST, also the first. A registration after BRIDGING
    is a jump, too, because it corrects the drift. DEGRADED causes no jump.
    """

    def __init__(self, bridge: Bridge, extrinsics: CameraExtrinsics) -> None:
        self._bridge = bridge
        self._extrinsics = extrinsics
        self._jumps = 1
        self._state = TrackingState.INITIALIZING
        self._observers: tuple[Observer, ...] = ()
        self._checks: tuple[FixCheck, ...] = ()
        self._checks_failed = AlertDebouncer(CATALOGUE[AlertId.FIXES_NOT_CHECKED])

    def add_check(self, check: FixCheck) -> None:
        """Add a check, called with each fix that earlier ones pass; it may hold or change it."""
        self._checks = (*self._checks, check)

    def add_observer(self, observer: Observer) -> None:
        """Call `observer` with every fix from now on, after its injection, also if it is held."""
        self._observers = (*self._observers, observer)

    def add_estimate(self, estimate: PoseEstimate, bundle: ReferenceBundle) -> None:
        """Convert an estimate, inject the fix if all checks pass, call observers. Others than
        accepted ones, TRACKING or BRIDGING, only count as jumps. Waits only for checks and
        observers, for 1 s at most if the integrity monitor is busy.
        """
        before, self._state = self._state, estimate.state
        is_lost = self._state is TrackingState.LOST and before is not TrackingState.LOST
        found_again = before is TrackingState.BRIDGING and self._state is TrackingState.TRACKING
        self._jumps += is_lost or found_again
        if not is_for_injection(estimate):
            return
        time_ns = estimate.exposure_time_ns
        fix = vision_fix(
            estimate,
            self._extrinsics,
            self._bridge.attitude_at(time_ns),
            self._bridge.gimbal_at(time_ns),
            self._jumps,
        )
        checked = self._checked(fix)
        if checked is not None:
            self._bridge.submit(checked)
        for observer in self._observers:
            observer(estimate, bundle, fix)

    def _checked(self, fix: VisionFix) -> VisionFix | None:
        """The fix after all checks; None if one holds it."""
        checked: VisionFix | None = fix
        failed = False
        try:
            for check in self._checks:
                checked = check(checked) if checked is not None else None
        except Exception:  # a position that nobody checked would be believed unwarned
            if not self._checks_failed.raised:
                _log.exception("a fix could not be checked")
            failed, checked = True, None
        alert = self._checks_failed.update(fix.time_ns, CheckResult(failed))
        if alert is not None:
            self._bridge.report_alert(alert)
        return checked
