"""Runs the integrity checks on their own thread, and checks every fix before it is injected."""

from __future__ import annotations

import logging
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from companion.calibration_watch.observation import CalibrationObservation
from companion.inertial import InertialTrack
from companion.integrity_monitor.checks import IntegrityChecks, IntegrityLimits
from companion.integrity_monitor.config import IntegrityMonitorConfig
from companion.integrity_monitor.debouncer import AlertDebouncer, CheckResult, InhibitMemory
from companion.integrity_monitor.protection import ProtectionLevel
from localizer.types import Image
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import CATALOGUE
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import Name
from mavlink_bridge.bridge import Bridge
from mavlink_bridge.link.clock import monotonic_ns
from mavlink_bridge.messages import VisionFix

_log = logging.getLogger(__name__)
_PERIOD_S = 0.1
_BLIND_RUNS = 10  # that failed in a row
_STALLED_NS = 2_000_000_000  # since its last turn: its thread hangs, or is gone
_COMPONENT_STALLED_NS = 4_000_000_000  # of another part, as the supervisor has it
_LOCK_S = 1.0  # a turn takes a twentieth of it


class IntegrityMonitor:
    """Checks frames, fixes and the vehicle; reports alerts and holds output.

    Frames come from the feed's thread and fixes from the localization thread; neither waits for
    more than the lock. Costly checks run on a thread of their own, ten times a second.

    If a check raises an exception, that fix is dropped. If the monitor's thread fails for one
    second or makes no progress for two, output stops until it runs again; then the calling threads
    report it.

    Above 200 lines: it wires every check to its alert, and the checks share the debounced state.
    """

    def __init__(
        self,
        config: IntegrityMonitorConfig,
        limits: IntegrityLimits,
        bridge: Bridge,
        memory: InhibitMemory | None = None,
        clock: Callable[[], int] = monotonic_ns,
        track: InertialTrack | None = None,
    ) -> None:
        self._clock = clock
        self._monitor, self._memory = IntegrityChecks(config, limits, track), memory
        self._bridge = bridge
        self._lock = threading.Lock()
        self._picture: tuple[int, Image] | None = None
        self._failed, self._stalled = (
            AlertDebouncer(CATALOGUE[of])
            for of in (AlertId.MONITOR_FAILED, AlertId.COMPONENT_STALLED)
        )
        self._last_ticks: Callable[[], Mapping[str, int]] = dict
        self._inhibiting: frozenset[AlertId] = frozenset()
        self._fails: dict[str, int] = {}  # how often in a row, by what is failing
        self._failures = threading.Lock()
        self.last_tick_ns = self._clock()
        """When its thread began its newest turn, CLOCK_MONOTONIC."""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="integrity", daemon=True)

    def start(self) -> None:
        """Start the thread. Inhibitions of a process that was killed are restored."""
        if self._memory is not None:
            self._monitor.restore(self._memory.recall())
            self._inhibit(self._monitor.inhibiting)
        self.last_tick_ns = self._clock()
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread; one that hangs is waited for up to 2 s."""
        self._stop.set()
        self._thread.join(2.0 * _LOCK_S)

    def close(self) -> None:
        """Delete what is stored for a restart, unless `hand_over` was called."""
        if self._memory is not None:
            self._memory.stop()

    def hand_over(self) -> None:
        """Keep the stored inhibitions, for the process that follows; call it before `close`."""
        if self._memory is not None:
            self._memory.stop(clean_shutdown=False)

    def watch(self, last_ticks_ns: Callable[[], Mapping[str, int]]) -> None:
        """From now on report components that stall for 4 s. last_ticks_ns: called in each run;
        gives the time of each component's last run, CLOCK_MONOTONIC ns.
        """
        self._last_ticks = last_ticks_ns

    def add_frame(self, time_ns: int, image: Image) -> None:
        """Store a frame (H, W, 3) for the next run, which checks the newest. Never blocks."""
        self._picture = (time_ns, image)

    def add_observation(self, observation: CalibrationObservation) -> None:
        """Pass a registered frame to the calibration watch and the height above the ground."""
        with self._locked() as answers:
            if answers:
                self._monitor.add_observation(observation)

    def check(self, fix: VisionFix) -> VisionFix | None:
        """The fix as it may be injected (see `IntegrityChecks.admit`); None holds it, also if a
        check fails or the monitor's thread hangs. Waits up to 1 s for the lock; raises nothing.
        """
        try:
            if self._is_stalled():
                return None
            state, attitude = self._bridge.state(), self._bridge.attitude_at(fix.time_ns)
            with self._locked() as answers:
                if not answers:
                    return None
                blind = self._is_blind
                admitted = self._monitor.admit(fix, state, attitude, held=blind)
        except Exception:
            self._note_failure("judging")
            return None
        self._note_success("judging")
        return admitted

    def submit(self, fix: VisionFix) -> None:
        """Check a fix and pass it to the bridge if it may be injected."""
        admitted = self.check(fix)
        if admitted is not None:
            self._bridge.submit(admitted)

    @property
    def reason(self) -> Alert | None:
        """Alert that holds the output; None while it is not held. Waits up to 1 s for the lock,
        without which no fix passes `check` either.
        """
        if self._is_stalled() or self._failed.raised:
            return self._failed.alert()
        with self._locked() as answers:
            return self._monitor.reason if answers else self._failed.alert()

    @property
    def level(self) -> ProtectionLevel | None:
        """The newest fix's protection level; None before it, or if the monitor hangs."""
        with self._locked() as answers:
            return self._monitor.level if answers else None

    def active_values(self) -> dict[str, float]:
        """The active alerts by identifier, with their values; empty if the monitor hangs."""
        with self._locked() as answers:
            return self._monitor.active_values() if answers else {}

    @contextmanager
    def _locked(self) -> Iterator[bool]:
        """Acquire the monitor's lock for at most 1 s; yields whether it was acquired, so that no
        caller hangs.
        """
        given = not self._is_stalled() and self._lock.acquire(timeout=_LOCK_S)
        try:
            yield given
        finally:
            if given:
                self._lock.release()

    def _is_stalled(self) -> bool:
        """Whether the monitor's thread has not run for 2 s; the calling thread reports it then."""
        now_ns = self._clock()
        if now_ns - self.last_tick_ns < _STALLED_NS:
            return False
        self._note_failure("taking turns")
        self._report_failure(now_ns)
        return True

    def _run(self) -> None:
        while not self._stop.wait(_PERIOD_S):
            self.run_checks()

    def run_checks(self) -> None:
        """Run all checks once, report their alerts, and set or clear inhibitions at the bridge. The
        thread calls it ten times a second.
        """
        self.last_tick_ns = self._clock()
        self._note_success("taking turns")
        picture, self._picture = self._picture, None
        looks = picture is not None  # a turn without one is no word that pictures can be looked at
        try:
            self._step(picture)
        except Exception:
            self._note_failure("looking" if looks else "watching")
        else:
            self._note_success("watching")
            if looks:
                self._note_success("looking")
        self._report_failure(self.last_tick_ns)
        self._report_stalled(self.last_tick_ns)

    def _report_failure(self, now_ns: int) -> None:
        with self._failures:
            alert = self._failed.update(now_ns, CheckResult(bool(self._fails)))
        if alert is not None:
            self._bridge.report_alert(alert)

    def _report_stalled(self, now_ns: int) -> None:
        """Report the component that has not run for longest, if its last run is too old."""
        last_ticks_ns = self._last_ticks()
        name = min(last_ticks_ns, key=lambda one: last_ticks_ns[one], default="")
        age_ns = now_ns - last_ticks_ns.get(name, now_ns)
        stalled = CheckResult(age_ns >= _COMPONENT_STALLED_NS, age_ns * 1e-9, Name(name))
        alert = self._stalled.update(now_ns, stalled)
        if alert is not None:
            self._bridge.report_alert(alert)

    @property
    def _is_blind(self) -> bool:
        with self._failures:
            return sum(self._fails.get(one, 0) for one in ("watching", "looking")) >= _BLIND_RUNS

    def _note_failure(self, what: str) -> None:
        """Count a failure of the monitor's task `what`; logs the first in a row."""
        with self._failures:
            count = self._fails[what] = self._fails.get(what, 0) + 1
        if count == 1:
            _log.error(
                "the integrity monitor failed %s", what, exc_info=sys.exc_info()[0] is not None
            )

    def _note_success(self, what: str) -> None:
        with self._failures:
            self._fails.pop(what, None)

    def _step(self, picture: tuple[int, Image] | None) -> None:
        with self._lock:
            if picture is not None:
                self._monitor.add_frame(*picture)
            alerts = self._monitor.step(self._clock(), self._bridge)
            inhibiting, found = self._monitor.inhibiting, self._monitor.to_remember()
        self._inhibit(inhibiting)
        if self._memory is not None:
            # Injection that runs is not stopped, by a restart no more than by the alert.
            self._memory.store({} if self._bridge.injecting else found)
        for alert in alerts:
            self._bridge.report_alert(alert)

    def _inhibit(self, inhibiting: frozenset[AlertId]) -> None:
        for of in inhibiting - self._inhibiting:
            self._bridge.inhibit(of)
        for of in self._inhibiting - inhibiting:
            self._bridge.clear(of)
        self._inhibiting = inhibiting
