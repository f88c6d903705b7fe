"""One picture of the process's health, once a second: to the bridge, the record and the log."""

from __future__ import annotations

import json
import logging
import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from companion.ending import joined
from companion.flight.search import NOT_READY
from companion.integrity_monitor.integrity_monitor import IntegrityMonitor
from companion.sources import StreamState
from companion.writing import NewestFile
from localizer.tracking.engine_health import EngineHealth
from localizer.types import PoseEstimate, TrackingState
from mavlink_bridge.alerts.catalogue import body
from mavlink_bridge.bridge import Bridge
from mavlink_bridge.messages import HealthLevel

_log = logging.getLogger(__name__)
_PERIOD_S = 1.0
_WINDOW = 200
_STALE_S = 2.0
_RATE_S = 5.0
_LEAST_HZ = 3.0  # below 4 an EKF does without; a frame or two more or less is no news
_SHORT_BRIDGE_NS = 2_000_000_000
_NOTICE = 5  # MAV_SEVERITY_NOTICE
_NOT_USED = "vision not used: "
_TOLD = (_NOT_USED, "output held: ")
_SILENT_VEHICLE = "no heartbeat from the flight controller"

_NO_FRAME = "no frame is being localized"
_SEARCH_HANGS = "the search hangs"
_OF_FEED = {
    StreamState.FAILED: (HealthLevel.FAILED, "video feed failed"),
    StreamState.MISFIT: (HealthLevel.FAILED, "video size does not fit the calibration"),
    StreamState.STALLED: (HealthLevel.DEGRADED, "video feed stalled"),
}
_OF_STATE = {
    TrackingState.INITIALIZING: (HealthLevel.STARTING, "localization initializing"),
    TrackingState.TRACKING: (HealthLevel.OK, "localization tracking"),
    TrackingState.DEGRADED: (HealthLevel.DEGRADED, "localization degraded"),
    TrackingState.BRIDGING: (HealthLevel.DEGRADED, "bridging"),
    TrackingState.LOST: (HealthLevel.FAILED, "localization lost"),
}


@dataclass(frozen=True)
class HealthInputs:
    """What else may say how well it goes: is the record complete, the autopilot's own idea of its
    position's sigma in metres, the monitor, nodes of the map that cannot be read, the map's shift,
    counts of targets, why a lost place cannot be searched.
    """

    is_recorded: Callable[[], bool] = lambda: True
    position_sigma_m: Callable[[], float | None] = lambda: None
    integrity_monitor: IntegrityMonitor | None = None
    unreadable_nodes: Callable[[], int] = lambda: 0
    map_shift: Callable[[], dict[str, float | bool] | None] = lambda: None
    targets: Callable[[], dict[str, int]] = dict
    search_lacks: Callable[[], str] = lambda: ""


class HealthMonitor:
    """Watches the parts and reports transitions, and keeps ``health.json``."""

    def __init__(
        self,
        engine_health: Callable[[], EngineHealth],
        bridge: Bridge,
        feed_state: Callable[[], StreamState],
        event: Callable[[str, str], None],
        record_folder: Path | None,
        inputs: HealthInputs | None = None,
    ) -> None:
        inputs = inputs or HealthInputs()
        self._engine_health = engine_health
        self._bridge = bridge
        self._feed_state = feed_state
        self._is_recorded = inputs.is_recorded
        self._position_sigma_m = inputs.position_sigma_m
        self._integrity_monitor = inputs.integrity_monitor
        self._unreadable_nodes = inputs.unreadable_nodes
        self._map_shift, self._targets = inputs.map_shift, inputs.targets
        self._search_lacks = inputs.search_lacks
        self._ended = ""
        self.newest: dict[str, Any] = {"level": "starting", "text": "starting"}
        """The newest report, as health.json has it."""
        self._file = _file(record_folder, event) if record_folder is not None else None
        self._estimates: deque[tuple[float, PoseEstimate]] = deque(maxlen=_WINDOW)
        self._came: deque[tuple[float, int]] = deque(maxlen=_WINDOW)
        self._failures = 0
        self.last_tick_ns = time.monotonic_ns()
        """When its thread began its newest turn, CLOCK_MONOTONIC."""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="health", daemon=True)

    def start(self) -> None:
        """Start watching."""
        if self._file is not None:
            self._file.start()
        self.last_tick_ns = (
            time.monotonic_ns()
        )  # since it was made, kernels were compiled for a minute
        self._thread.start()

    def stop(self) -> None:
        """Stop, after one last report."""
        self._stop.set()
        joined(self._thread)
        if self._file is not None:
            self._file.stop()

    def end(self, how: str) -> None:
        """The flight ends, and how: the last report says it instead of what was true until then."""
        self._ended = how

    def add_estimate(self, estimate: PoseEstimate) -> None:
        """Note an estimate. Never blocks."""
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
        level, text = self.assess()
        # The bridge logs and records what it tells; a silent vehicle it tells by itself, and what
        # keeps positions from the EKF; the monitor tells what it withholds.
        if self._ended:
            if self._stop.is_set():
                self._bridge.say(_NOTICE, "PiLoT: ending, nothing is injected any more")
                self._write("ended", f"{self._ended}; {self._last_state(text)}")
            return
        known = text == _SILENT_VEHICLE or text.startswith(_TOLD)
        self._bridge.set_health(level, text, tell=not known)
        self._write(level.value, text)

    def _last_state(self, text: str) -> str:
        """What was true until the end. A camera that ended before says nothing of the flight."""
        if text.startswith(_NO_FRAME):
            arrived, estimate = self._estimates[-1]
            age_s = time.monotonic() - arrived
            return f"{_OF_STATE[estimate.state][1]} until {age_s:.0f} s before, then {text}"
        return f"{text} until then"

    def assess(self) -> tuple[HealthLevel, str]:
        """The worst thing that is true now, in one line."""
        feed = self._feed_state()
        if feed in _OF_FEED:
            return _OF_FEED[feed]
        if not self._bridge.state().connected:
            return HealthLevel.DEGRADED, _SILENT_VEHICLE
        engine = self._engine_health()
        if not self._estimates:
            return HealthLevel.STARTING, _waiting_for(engine, self._lacks(engine))
        arrived, estimate = self._estimates[-1]
        if time.monotonic() - arrived > _STALE_S:
            if _is_lost(estimate):  # the error stands in health.json; this is what to act on
                return HealthLevel.FAILED, "localization lost" + self._since(estimate, engine)
            nothing = self._overload(engine) or _NO_FRAME
            return HealthLevel.DEGRADED, engine.last_error or nothing
        level, text = _OF_STATE[estimate.state]
        if estimate.state is TrackingState.BRIDGING:
            level, text = _bridging(estimate)
        injection_fault = self._bridge.injection_fault
        if level is HealthLevel.OK and injection_fault:
            level, text = HealthLevel.DEGRADED, _NOT_USED + injection_fault
        if level is HealthLevel.OK and (lacks := self._lacks(engine)) not in ("", NOT_READY):
            level, text = HealthLevel.DEGRADED, f"tracking, but {lacks}"
        overload = self._overload(engine)
        if overload and level is HealthLevel.OK:
            level, text = HealthLevel.DEGRADED, overload
        held = self._integrity_monitor.reason if self._integrity_monitor is not None else None
        withheld = body(held) if held is not None else ""
        if withheld and not _is_lost(estimate):
            level, text = HealthLevel.FAILED, withheld
        if _is_lost(estimate):
            text += self._since(estimate, engine)
        # The map stands in by coarser levels, as far as they are in memory.
        text += ", map unreadable" if self._unreadable_nodes() else ""
        text += ", video scaled" if feed is StreamState.SCALED else ""
        return level, text + ("" if self._is_recorded() else ", record incomplete")

    def _overload(self, engine: EngineHealth) -> str:
        """Too few frames are localized of those that come; empty where they are enough."""
        now_s, came = time.monotonic(), engine.frames_in
        self._came.append((now_s, came))
        while now_s - self._came[0][0] > _RATE_S:
            self._came.popleft()
        begun_s, before = self._came[0]
        if now_s - begun_s < 0.7 * _RATE_S:
            return ""
        offered, done = (came - before) / (now_s - begun_s), self._rate()
        if done >= _LEAST_HZ or offered < 2.0 * _LEAST_HZ:
            return ""
        return f"overloaded, {done:.0f} of {offered:.0f} frames/s"

    def _since(self, estimate: PoseEstimate, engine: EngineHealth) -> str:
        """Since when there is no fix, how far off the autopilot may be, and that no search will
        answer.

        Not whether the map is being searched: that begins and ends every few seconds, and each time
        the loss would be told again (`engine.searching` in health.json has it).
        """
        text = ""
        if estimate.last_fix_ns is not None:
            text = f" {(time.monotonic_ns() - estimate.last_fix_ns) * 1e-9:.0f} s"
        sigma_m = self._position_sigma_m()
        text += f", +-{2.0 * sigma_m:.0f} m" if sigma_m is not None else ""
        lacks = self._lacks(engine)
        return text + (f", {lacks}" if lacks else "")

    def _lacks(self, engine: EngineHealth) -> str:
        """Why a lost place cannot be searched now; empty where it can."""
        return _SEARCH_HANGS if engine.search_hangs else self._search_lacks()

    def _write(self, level: str, text: str) -> None:
        report: dict[str, Any] = {
            "level": level,
            "text": text,
            "time_ns": time.monotonic_ns(),
            "pid": os.getpid(),
            "engine": asdict(self._engine_health()),
            "rate_hz": self._rate(),
            "stages_ms": _stages([e for _, e in list(self._estimates)]),
            "bridge": self._bridge.counters(),
            "shadow": self._bridge.shadow_score().line(),
            "guardian": self._guardian_report(),
            "map_shift": self._map_shift(),
            "targets": self._targets(),
        }
        self.newest = report
        if self._file is not None:
            self._file.put(json.dumps(_finite(report), indent=1, default=str))

    def _guardian_report(self) -> dict[str, Any] | None:
        """Standing findings with their figures, and the newest protection level."""
        if self._integrity_monitor is None:
            return None
        level = self._integrity_monitor.level
        return {
            "findings": self._integrity_monitor.standing(),
            "hpl_m": None if level is None else level.horizontal_m,
            "vpl_m": None if level is None else level.vertical_m,
        }

    def _rate(self) -> float:
        """Localized frames per second over the last few seconds."""
        now = time.monotonic()
        return sum(1 for t, _ in list(self._estimates) if now - t < _RATE_S) / _RATE_S


def _file(folder: Path, event: Callable[[str, str], None]) -> NewestFile:
    """``health.json``, told once where a full disk does not take it."""
    path = folder / "health.json"
    return NewestFile(path, lambda e: event("warning", f"{path} cannot be written: {e}"))


def _stages(estimates: list[PoseEstimate]) -> dict[str, dict[str, float]]:
    """p50 and p95 of each stage, ms."""
    recent = [e.stage_ms for e in estimates]
    stages = {name for stage_ms in recent for name in stage_ms}
    return {
        name: {
            "p50": float(np.percentile([s[name] for s in recent if name in s], 50)),
            "p95": float(np.percentile([s[name] for s in recent if name in s], 95)),
        }
        for name in sorted(stages)
    }


def _waiting_for(engine: EngineHealth, lacks: str) -> str:
    """What is missing before the first estimate. lacks: for a search of the map."""
    if engine.searching or (lacks and engine.searches):
        return lacks or "searching the map"
    seen = engine.frames_in > 0
    return engine.last_error or f"waiting for {'a pose prior' if seen else 'video'}"


def _bridging(estimate: PoseEstimate) -> tuple[HealthLevel, str]:
    """How long the odometry has carried the pose on, and how far off it may be (95 %).

    A second or two is no news: a shadow of a cloud, a car that fills the picture.
    """
    since_ns = estimate.exposure_time_ns - (estimate.last_fix_ns or estimate.exposure_time_ns)
    if since_ns < _SHORT_BRIDGE_NS:
        return _OF_STATE[TrackingState.TRACKING]
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(estimate.covariance[:2, :2])[-1]))
    text = f"bridging {since_ns * 1e-9:.0f} s, {2.0 * sigma_m:.0f} m"
    return HealthLevel.DEGRADED, text


def _is_lost(estimate: PoseEstimate) -> bool:
    return estimate.state is TrackingState.LOST


def _finite(value: Any) -> Any:
    """What is no finite number as null: JSON has none, and strict readers refuse it."""
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
