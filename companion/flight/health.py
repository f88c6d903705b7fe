"""Assesses the health once a second and reports it to the bridge, the record and the log."""

from __future__ import annotations

import json
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from companion.ending import wait_for_end
from companion.integrity_monitor.integrity_monitor import IntegrityMonitor
from companion.sources import StreamState
from companion.writing import NewestFile, json_value
from localizer.tracking.engine_health import EngineHealth
from localizer.types import PoseEstimate, TrackingState
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert, body, values_by_name
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.bridge import Bridge
from mavlink_bridge.messages import HealthLevel

_log = logging.getLogger(__name__)
_PERIOD_S = 1.0
_WINDOW = 200
_STALE_S = 2.0
_RATE_S = 5.0
_LEAST_HZ = 3.0  # below 4 an EKF does without; a frame or two more or less is no news
_SHORT_BRIDGE_NS = 2_000_000_000
_LASTING = (AlertId.NO_SEARCH, AlertId.SEARCH_HANGS)  # obstacles of a search
_OF_FEED = {
    StreamState.FAILED: (HealthLevel.FAILED, AlertId.VIDEO_FAILED),
    StreamState.MISFIT: (HealthLevel.FAILED, AlertId.VIDEO_SIZE),
    StreamState.STALLED: (HealthLevel.DEGRADED, AlertId.VIDEO_STALLED),
}
_OF_STATE = {
    TrackingState.INITIALIZING: (HealthLevel.STARTING, AlertId.INITIALIZING),
    TrackingState.TRACKING: (HealthLevel.OK, AlertId.TRACKING),
    TrackingState.DEGRADED: (HealthLevel.DEGRADED, AlertId.DEGRADED),
}


@dataclass(frozen=True)
class HealthStatus:
    """Result of an assessment. alerts: the active ones, most severe first. is_reported: another
    component has already reported the first alert.
    """

    level: HealthLevel
    alerts: tuple[Alert, ...]
    is_reported: bool = False

    @property
    def line(self) -> str:
        """The alerts' texts in one line, for health.json."""
        return ", ".join(body(alert) for alert in self.alerts)


@dataclass(frozen=True)
class HealthInputs:
    """Further inputs of the assessment. is_recorded: the record is complete; position_sigma_m: of
    the autopilot's position, None if unknown; unreadable_nodes: of the map; map_shift: map offset,
    None without; targets: counts; search_lacks: why no search is possible, None if one is.
    """

    is_recorded: Callable[[], bool] = lambda: True
    position_sigma_m: Callable[[], float | None] = lambda: None
    integrity_monitor: IntegrityMonitor | None = None
    unreadable_nodes: Callable[[], int] = lambda: 0
    map_shift: Callable[[], dict[str, float | bool] | None] = lambda: None
    targets: Callable[[], dict[str, int]] = dict
    search_lacks: Callable[[], AlertId | None] = lambda: None


class HealthMonitor:
    """Assesses all components once a second, reports changes, and writes ``health.json``.

    feed_state: state of the video; event: receives (level, text) for log and record; record_folder:
    for health.json, None without.

    Above 200 lines: every condition that can be true is ranked here, in one place.
    """

    def __init__(
        self,
        engine_health: Callable[[], EngineHealth],
        bridge: Bridge,
        feed_state: Callable[[], StreamState],
        event: Callable[[str, str], None],
        record_folder: Path | None,
        inputs: HealthInputs | None = None,
    ) -> None:
        self._inputs = inputs or HealthInputs()
        self._engine_health = engine_health
        self._bridge = bridge
        self._feed_state = feed_state
        self._ended = ""
        self.newest: dict[str, Any] = {"level": "starting", "text": "starting"}
        """The newest report, as health.json has it."""
        self._file = None if record_folder is None else _health_file(record_folder, event)
        self._estimates: deque[tuple[float, PoseEstimate]] = deque(maxlen=_WINDOW)
        self._came: deque[tuple[float, int]] = deque(maxlen=_WINDOW)
        self._failures = 0
        self.last_tick_ns = time.monotonic_ns()
        """When its thread began its newest turn, CLOCK_MONOTONIC."""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="health", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        if self._file is not None:
            self._file.start()
        # Since it was made, kernels were compiled for a minute.
        self.last_tick_ns = time.monotonic_ns()
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread, after one last report."""
        self._stop.set()
        wait_for_end(self._thread)
        if self._file is not None:
            self._file.stop()

    def end(self, how: str, *, is_failure: bool = False) -> None:
        """Set the reason for which the flight ends. From now on nothing is reported until `stop`,
        whose last report states it. is_failure: the video failed, which is reported at once.
        """
        self._ended = how
        if is_failure:
            self._bridge.set_health(HealthLevel.FAILED, (alert(AlertId.VIDEO_FAILED),))

    def add_estimate(self, estimate: PoseEstimate) -> None:
        """Add an estimate, accepted or not. Never blocks."""
        self._estimates.append((time.monotonic(), estimate))

    def _run(self) -> None:
        while True:
            stopping = self._stop.wait(_PERIOD_S)
            self.last_tick_ns = time.monotonic_ns()
            try:
                self._report()
            except Exception:  # or the heartbeats would go on with the last level for ever
                if not self._failures:
                    _log.exception("the health could not be reported")
                self._failures += 1
            if stopping:
                return

    def _report(self) -> None:
        status = self.assess()
        if self._ended:
            if self._stop.is_set():
                self._bridge.report_alert(alert(AlertId.ENDING))
                self._write("ended", f"{self._ended}; {self._last_state(status)}", ())
            return
        self._bridge.set_health(status.level, status.alerts, tell=not status.is_reported)
        self._write(status.level.value, status.line, status.alerts)

    def _last_state(self, status: HealthStatus) -> str:
        """Text of the state before the end. If the camera ended earlier, the state before that."""
        if status.alerts[0].id is AlertId.NO_FRAME:
            arrived, estimate = self._estimates[-1]
            age_s = time.monotonic() - arrived
            before = body(_state_alert(estimate)[1])
            return f"{before} until {age_s:.0f} s before, then {status.line}"
        return f"{status.line} until then"

    def assess(self) -> HealthStatus:
        """Rank the conditions and return the current health."""
        feed = self._feed_state()
        if feed in _OF_FEED:
            level, of = _OF_FEED[feed]
            return HealthStatus(level, (alert(of),))
        if not self._bridge.state().connected:
            return HealthStatus(HealthLevel.DEGRADED, (alert(AlertId.FC_SILENT),), is_reported=True)
        status = self._localization(self._engine_health())
        return replace(status, alerts=(*status.alerts, *self._notes(feed)))

    def _localization(self, engine: EngineHealth) -> HealthStatus:
        """Health of the localization, without the notes."""
        if not self._estimates:
            waiting = _waiting_for(engine, self._search_obstacle(engine))
            return HealthStatus(HealthLevel.STARTING, (alert(waiting),))
        arrived, estimate = self._estimates[-1]
        is_old = time.monotonic() - arrived > _STALE_S
        # The error of a lost position stands in health.json; this is what to act on.
        if estimate.state is TrackingState.LOST:
            return HealthStatus(HealthLevel.FAILED, self._lost(estimate, engine))
        if is_old:
            failed = alert(_error(engine)) if engine.last_error else None
            news = failed or alert(AlertId.NO_FRAME)
            return HealthStatus(HealthLevel.DEGRADED, (news,))
        return self._tracking(estimate, engine)

    def _tracking(self, estimate: PoseEstimate, engine: EngineHealth) -> HealthStatus:
        """Health while frames are processed and the position is not lost."""
        level, news = _state_alert(estimate)
        overload = self._overload(engine)
        monitor = self._inputs.integrity_monitor
        held = monitor.reason if monitor is not None else None
        if held is not None:  # the monitor told it
            return HealthStatus(HealthLevel.FAILED, (held,), is_reported=True)
        if level is not HealthLevel.OK:
            return HealthStatus(level, (news,))
        fault, lacks = self._bridge.injection_fault, self._search_obstacle(engine)
        if fault is not None:  # the bridge told it
            return HealthStatus(HealthLevel.DEGRADED, (fault,), is_reported=True)
        if lacks in _LASTING:
            overload = alert(lacks)
        if overload is not None:
            return HealthStatus(HealthLevel.DEGRADED, (overload,))
        return HealthStatus(level, (news,))

    def _notes(self, feed: StreamState) -> tuple[Alert, ...]:
        """Further active alerts: unreadable parts of the map, scaled video, incomplete record."""
        notes = (
            (self._inputs.unreadable_nodes() > 0, AlertId.MAP_UNREADABLE),
            (feed is StreamState.SCALED, AlertId.VIDEO_SCALED),
            (not self._inputs.is_recorded(), AlertId.RECORD_INCOMPLETE),
        )
        return tuple(alert(of) for holds, of in notes if holds)

    def _overload(self, engine: EngineHealth) -> Alert | None:
        """Alert if fewer than 3 frames/s are localized of at least 6 received; otherwise None."""
        now_s, came = time.monotonic(), engine.frames_in
        self._came.append((now_s, came))
        while now_s - self._came[0][0] > _RATE_S:
            self._came.popleft()
        begun_s, before = self._came[0]
        if now_s - begun_s < 0.7 * _RATE_S:
            return None
        offered, done = (came - before) / (now_s - begun_s), self._rate()
        if done >= _LEAST_HZ or offered < 2.0 * _LEAST_HZ:
            return None
        return alert(AlertId.OVERLOADED, done=done, offered=offered)

    def _lost(self, estimate: PoseEstimate, engine: EngineHealth) -> tuple[Alert, ...]:
        """Alerts of a lost position: duration, the autopilot's uncertainty, and why no search is
        possible.

        A running search is not reported here. A search begins and ends every few seconds, and each
        time the loss would be reported again (`engine.searching` in health.json shows it).
        """
        fix_ns = estimate.last_fix_ns
        since_s = 0.0 if fix_ns is None else (time.monotonic_ns() - fix_ns) * 1e-9
        alerts = [alert(AlertId.LOST, seconds=since_s)]
        sigma_m, lacks = self._inputs.position_sigma_m(), self._search_obstacle(engine)
        if sigma_m is not None:
            alerts.append(alert(AlertId.EKF_UNCERTAIN, metres=2.0 * sigma_m))
        if lacks is not None:
            alerts.append(alert(lacks))
        return tuple(alerts)

    def _search_obstacle(self, engine: EngineHealth) -> AlertId | None:
        """Why the map cannot be searched now; None if it can."""
        return AlertId.SEARCH_HANGS if engine.search_hangs else self._inputs.search_lacks()

    def _write(self, level: str, text: str, alerts: tuple[Alert, ...]) -> None:
        score = self._bridge.shadow_score()
        report: dict[str, Any] = {
            "level": level,
            "text": text,
            "alerts": {a.id.value: values_by_name(a) for a in alerts},
            "time_ns": time.monotonic_ns(),
            "pid": os.getpid(),
            "engine": asdict(self._engine_health()),
            "rate_hz": self._rate(),
            "stages_ms": _stages([e for _, e in list(self._estimates)]),
            "bridge": self._bridge.counters(),
            "shadow": {"ready": score.ready, "text": score.line()},
            "guardian": _monitor_report(self._inputs.integrity_monitor),
            "map_shift": self._inputs.map_shift(),
            "targets": self._inputs.targets(),
        }
        self.newest = report
        if self._file is not None:
            self._file.put(json.dumps(json_value(report), indent=1))

    def _rate(self) -> float:
        """Localized frames per second over the last few seconds."""
        now = time.monotonic()
        return sum(1 for t, _ in list(self._estimates) if now - t < _RATE_S) / _RATE_S


def _monitor_report(monitor: IntegrityMonitor | None) -> dict[str, Any] | None:
    """Active alerts with their values, and the newest protection level."""
    if monitor is None:
        return None
    level = monitor.level
    return {
        "findings": monitor.active_values(),
        "hpl_m": None if level is None else level.horizontal_m,
        "vpl_m": None if level is None else level.vertical_m,
    }


def _health_file(folder: Path, event: Callable[[str, str], None]) -> NewestFile:
    """Writer of ``health.json``; a failing disk is reported once."""
    path = folder / "health.json"
    return NewestFile(path, lambda e: event("warning", f"{path} cannot be written: {e}"))


def _stages(estimates: list[PoseEstimate]) -> dict[str, dict[str, float]]:
    """p50 and p95 of each stage's duration in the estimates, ms."""
    recent = [e.stage_ms for e in estimates]
    stages = {name for stage_ms in recent for name in stage_ms}
    return {
        name: {
            "p50": float(np.percentile([s[name] for s in recent if name in s], 50)),
            "p95": float(np.percentile([s[name] for s in recent if name in s], 95)),
        }
        for name in sorted(stages)
    }


def _error(engine: EngineHealth) -> AlertId:
    return AlertId.NO_MAP_IN_VIEW if engine.no_map_in_view else AlertId.LOCALIZATION_FAILED


def _waiting_for(engine: EngineHealth, lacks: AlertId | None) -> AlertId:
    """Alert that says what is missing before the first estimate. lacks: why no search is possible,
    or None.
    """
    if engine.searching or (lacks is not None and engine.searches):
        return lacks or AlertId.SEARCHING
    if engine.last_error:
        return _error(engine)
    if engine.searches:  # between two searches
        return AlertId.SEARCHING
    return AlertId.WAITING_FOR_PRIOR if engine.frames_in > 0 else AlertId.WAITING_FOR_VIDEO


def _state_alert(estimate: PoseEstimate) -> tuple[HealthLevel, Alert]:
    """Health level and alert of the tracking state. BRIDGING: duration and 95 % bound of the error.

    BRIDGING of less than two seconds counts as TRACKING: the cause may be a cloud's shadow, or a
    car that fills the frame.
    """
    if estimate.state is TrackingState.LOST:
        return HealthLevel.FAILED, alert(AlertId.LOST, seconds=0.0)
    if estimate.state is not TrackingState.BRIDGING:
        level, of = _OF_STATE[estimate.state]
        return level, alert(of)
    since_ns = estimate.exposure_time_ns - (estimate.last_fix_ns or estimate.exposure_time_ns)
    if since_ns < _SHORT_BRIDGE_NS:
        return HealthLevel.OK, alert(AlertId.TRACKING)
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(estimate.covariance[:2, :2])[-1]))
    bridging = alert(AlertId.BRIDGING, seconds=since_ns * 1e-9, metres=2.0 * sigma_m)
    return HealthLevel.DEGRADED, bridging
