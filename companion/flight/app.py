"""The companion process: builds, starts and stops the components of the table in order.

Data flows one way: feed -> engine -> (bridge, targets, recorder), over the channels of
`companion.flight.channels`. What runs stands in `companion.flight.component_table`.
"""

from __future__ import annotations

import gc
import logging
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any

from companion.config import CompanionConfig
from companion.errors import CompanionError, redacted
from companion.flight.channels import Feed
from companion.flight.component_table import COMPONENTS
from companion.flight.components import Assembly, Component
from companion.flight.health import HealthMonitor
from companion.flight.recorder import RecordKeeper
from companion.integrity_monitor.integrity_monitor import IntegrityMonitor
from companion.supervision.processes import Pulse, without_lost_disks
from localizer.errors import LocalizerError
from localizer.tracking.engine import DualThreadEngine
from localizer.tracking.opening import MapStack
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.bridge import Bridge

_log = logging.getLogger(__name__)
# How long a thread may keep the interpreter from another that woke up. Python's 5 ms, several times
# between an estimate and the autopilot, would be 7 ms in the median (benchmarks.bridge).
_SWITCH_S = 0.0002


class Companion:
    """The flight process of one deployment.

    `run` blocks until `stop` is called or the feed ends. pulse: file descriptor of the supervisor's
    pipe, see `Pulse`; None without a supervisor. restart: whether an earlier process of this flight
    died. lost_settings: why `config` is not that of the deployment file; "" if it is.
    """

    def __init__(
        self,
        config: CompanionConfig,
        parts: Sequence[Component[Any]] = COMPONENTS,
        pulse: int | None = None,
        *,
        restart: bool = False,
        lost_settings: str = "",
    ) -> None:
        self._config, self._restart = config, restart
        self._lost_settings = lost_settings
        self._parts = Assembly(config, parts)
        self._pulse = pulse
        self._up = ExitStack()
        self._is_stopping = False
        self._is_up = False

    def prepare(self) -> None:
        """Build what takes long and needs neither link nor camera, for a later `run`; called by a
        standby. On an error, what was built is closed; `run` then builds everything.
        """
        try:
            self._parts.make(self._up, ahead=True)
        except BaseException:
            self.discard_prepared()
            raise

    def discard_prepared(self) -> None:
        """Close and forget the components that `prepare` built."""
        self._up.close()
        self._parts.forget()

    def run(self) -> None:
        """Build and start all components, fly until stopped, then stop them.

        Raises the error that ended the video, after the shutdown. If the start fails, all
        components that were started are stopped, because a remaining thread would keep the process
        alive; if building fails, the empty record is removed too.
        """
        sys.setswitchinterval(_SWITCH_S)
        self._parts.channels.events.subscribe(_log_event)
        lost = ""
        if self._restart:
            self._parts.config, lost = without_lost_disks(self._config)
        with self._up as up:
            try:
                self._parts.make(up)
                # What the imports and compilers left is never garbage: searching it for garbage
                # would stop every thread for a tenth of a second now and then.
                gc.collect()
                gc.freeze()
                self._is_up = True
            except BaseException:
                up.close()
                self.discard_record()
                raise
            try:
                feed = self._fly(up, lost)
            except BaseException:
                self._parts.hand_over()
                raise
            if feed.error is not None and not self._is_stopping:
                self._parts.hand_over()
        if feed.error is not None:
            raise feed.error

    def _fly(self, up: ExitStack, lost: str) -> Feed:
        """Start the components; wait for the end of the video or `stop`. lost: disks left out."""
        self._parts.start(up)
        integrity_monitor = self._parts.get(IntegrityMonitor)
        if integrity_monitor is not None:
            integrity_monitor.watch(self._unsupervised_ticks)
        if self._pulse is not None:
            pulse = Pulse(self._last_ticks, self._pulse)
            pulse.start()
            # First of all: what comes down takes no turns.
            up.push(lambda error, *_: pulse.stop(clean_shutdown=self._is_clean_shutdown(error)))
        self._report_start(lost)
        feed = self._parts[Feed]
        # In slices: signals are handled between them.
        while not (self._is_stopping or feed.ended.wait(0.2)):
            pass
        health = self._parts.get(HealthMonitor)
        if health is not None:
            error = "" if feed.error is None else f": {feed.error}"
            how = "stopped" if self._is_stopping else f"the feed ended{error}"
            health.end(how, is_failure=bool(error) and not self._is_stopping)
        return feed

    def stop(self) -> bool:
        """Make `run` end soon, with a clean shutdown; returns at once.
        Returns False while `run` still builds: it ends only after that. For a signal handler: it
        takes no lock, because the interrupted code may hold it.
        """
        self._is_stopping = True
        return self._is_up

    def discard_record(self) -> None:
        """Remove a failed start's record, if it has no row; at any time, also repeatedly."""
        for undo in self._parts.abandonments:
            undo()

    def _is_clean_shutdown(self, error: type[BaseException] | None) -> bool:
        """Whether `run` ends normally. error: what ended it, or None."""
        return error is None and self._parts[Feed].error is None

    def _last_ticks(self) -> dict[str, int]:
        """Time of the last run of each thread that is needed for a position, ns, by name."""
        parts, last_ticks_ns = self._parts, self._parts[DualThreadEngine].last_ticks_ns()
        last_ticks_ns |= {"feed": parts[Feed].last_tick_ns, **parts[Bridge].last_ticks_ns()}
        health, integrity_monitor = parts.get(HealthMonitor), parts.get(IntegrityMonitor)
        last_ticks_ns |= {} if health is None else {"health": health.last_tick_ns}
        if integrity_monitor is not None:
            last_ticks_ns["integrity monitor"] = integrity_monitor.last_tick_ns
        return last_ticks_ns

    def _unsupervised_ticks(self) -> dict[str, int]:
        """Time of the last run of the threads that no other component monitors."""
        health = self._parts.get(HealthMonitor)
        ends = self._is_stopping or self._parts[Feed].ended.is_set()
        return {} if health is None or ends else {"health": health.last_tick_ns}

    def _report_start(self, lost: str) -> None:
        events = self._parts.channels.events
        events.send("info", f"map {self._config.map}, feed {redacted(self._config.camera.source)}")
        events.send("info", f"renderer {self._parts[MapStack].renderer.name}")
        keeper = self._parts.get(RecordKeeper)
        if keeper is not None and keeper.folder is not None:
            events.send("info", f"record {keeper.folder}")
        if keeper is not None and lost:
            events.send("warning", f"left out, since it was gone at the restart: {lost}")
            keeper.mark_incomplete("disk gone")
        bridge = self._parts.get(Bridge)
        if bridge is not None and self._lost_settings:
            bridge.report_alert(alert(AlertId.DEPLOYMENT_LOST))
            events.send("warning", f"flown as before the restart, since {self._lost_settings}")


def released_companion(
    config: CompanionConfig,
    *,
    standby: bool,
    pulse: int | None,
    restart: bool = False,
    lost_settings: str = "",
) -> Companion | None:
    """The flight process, not yet running. A standby is prepared here, without link and feed, and
    returned when a line comes on standard input, from the supervisor; None if the input ends
    without one.
    pulse, restart, lost_settings: see `Companion`. For a standby, restart is always true.
    """
    companion = Companion(
        config, pulse=pulse, restart=restart or standby, lost_settings=lost_settings
    )
    if not standby:
        return companion
    try:
        companion.prepare()
    except (CompanionError, LocalizerError, OSError) as error:  # the flight will say so, then
        _log.warning("standby is not warm: %s", error)
    if sys.stdin.readline():
        return companion
    companion.discard_prepared()
    return None


def _log_event(level: str, text: str) -> None:
    _log.log(logging.WARNING if level == "warning" else logging.INFO, "%s", text)
