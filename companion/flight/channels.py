"""Channels between the components: frames from the camera, estimates, and fixes to the bridge.

Each estimate is converted once, for injection and for the observers.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, ParamSpec

from companion.conversions import CameraExtrinsics, vision_fix
from companion.ending import wait_for_end
from companion.integrity_monitor.debouncer import AlertDebouncer, CheckResult
from companion.sources import FrameSource
from companion.targets.target_manager import TargetEstimate
from localizer.types import Frame, PoseEstimate, ReferenceBundle, TrackingState
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import CATALOGUE
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.bridge import Bridge
from mavlink_bridge.messages import TrackRequest, VisionFix

P = ParamSpec("P")


class Channel(Generic[P]):
    """Calls every subscriber with each sent value, on the sender's thread, in the order of
    subscription. Subscribers must return at once, for example after queueing the value.
    """

    def __init__(self) -> None:
        self._subscribers: tuple[Callable[P, None], ...] = ()

    def subscribe(self, take: Callable[P, None]) -> None:
        """Call `take` with every value that is sent from now on."""
        self._subscribers = (*self._subscribers, take)

    def send(self, *args: P.args, **kwargs: P.kwargs) -> None:
        """Call every subscriber; raise the first of their errors when all were called."""
        failed: Exception | None = None
        for take in self._subscribers:
            try:
                take(*args, **kwargs)
            except Exception as error:  # one part's fault must not starve the others
                failed = failed or error
        if failed is not None:
            raise failed


@dataclass(frozen=True)
class Channels:
    """Every channel of one process, each with the thread that sends on it."""

    frames: Channel[[Frame]] = field(default_factory=Channel)
    """Every frame of the camera, on the feed's thread."""
    estimates: Channel[[PoseEstimate, ReferenceBundle]] = field(default_factory=Channel)
    """Every estimate, accepted or not, with its reference view, on the localization thread."""
    targets: Channel[[TargetEstimate]] = field(default_factory=Channel)
    """Every located target, on the targets' thread."""
    gone: Channel[[str]] = field(default_factory=Channel)
    """The name of every target that ended, on the targets' thread."""
    clicks: Channel[[TrackRequest]] = field(default_factory=Channel)
    """What the ground station asks the camera to track, on a MAVLink link's thread."""
    alerts: Channel[[Alert]] = field(default_factory=Channel)
    """Every alert that the operator was told, on any thread."""
    events: Channel[[str, str]] = field(default_factory=Channel)
    """What happens (level, text) and is told nobody in flight: for log and record, any thread."""


class Feed:
    """Passes every frame of a source to `take`, on its own thread. ended: set when the source ends;
    error: what ended it, None for a normal end. failures: number of frames for which `take` raised;
    the flight continues.
    """

    def __init__(self, source: FrameSource, take: Callable[[Frame], None]) -> None:
        self._source = source
        self._take = take
        self.ended = threading.Event()
        self.error: Exception | None = None
        self.failures = 0
        self._taken_ns: int | None = None
        self._thread = threading.Thread(target=self._run, name="feed", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Close the source and wait for the thread."""
        self._source.close()
        wait_for_end(self._thread)

    @property
    def last_tick_ns(self) -> int:
        """When the present frame came, CLOCK_MONOTONIC; now while waiting for a frame."""
        taken_ns = self._taken_ns
        return time.monotonic_ns() if taken_ns is None else taken_ns

    def _run(self) -> None:
        try:
            for frame in self._source.frames():
                self._taken_ns = time.monotonic_ns()
                self._pass_on(frame)
                self._taken_ns = None
        except Exception as error:
            self.error = error
        self.ended.set()

    def _pass_on(self, frame: Frame) -> None:
        try:
            self._take(frame)
        except Exception:  # a part's fault, which the others and the next frames do not share
            self.failures += 1
            if self.failures in (1, 10, 100, 1000):
                _log.exception("a part failed on a frame (%d times)", self.failures)


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
