"""Reports once for all links that the flight controller is found, lost or back."""

from __future__ import annotations

import threading
from collections.abc import Callable

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.link.clock import monotonic_ns
from mavlink_bridge.messages import VehicleState

_PATIENCE_NS = 5_000_000_000
_TWIN_WINDOW_NS = 5_000_000_000
_TWIN_SWITCHES = 40  # in a window: even a line that damages every third frame is far below
_NEWS = {
    "there": AlertId.FC_FOUND,
    "lost": AlertId.FC_LOST,
    "silent": AlertId.FC_SILENT,
}


class VehicleWatch:
    """Reports found and lost vehicles. Every link calls `check` at each tick.

    report: sends an alert to the operator. first: called after the first of these alerts. clock:
    CLOCK_MONOTONIC, ns.
    """

    def __init__(
        self,
        report: Callable[[Alert], None],
        first: Callable[[], None] = lambda: None,
        clock: Callable[[], int] = monotonic_ns,
    ) -> None:
        self._report, self._first, self._clock = report, first, clock
        self._lock = threading.Lock()
        # Of the first tick: an application may compile for minutes before it starts the bridge.
        self._begun_ns: int | None = None
        self._known = "nothing"

    def check(self, state: VehicleState) -> None:
        """Report whether the vehicle was found, lost or is back, or silent from the start."""
        now_ns = self._clock()
        with self._lock:
            before, self._begun_ns = self._known, self._begun_ns or now_ns
            if state.connected:
                self._known = "there"
            elif before == "there":
                self._known = "lost"
            elif before == "nothing" and now_ns - self._begun_ns > _PATIENCE_NS:
                self._known = "silent"
            if self._known == before:
                return
        self._report(Alert(AlertId.FC_BACK if before == "lost" else _NEWS[self._known]))
        if before == "nothing":
            self._first()


class DuplicateSystemIdMonitor:
    """Detects two vehicles with the same ids on one link: their boot times alternate."""

    def __init__(self) -> None:
        self._begun_ns = 0
        self._count = 0

    def is_duplicate(self, now_ns: int, ran_back: int) -> bool:
        """Whether the boot time decreased 40 times in 5 s. ran_back: how often it has so far."""
        many = ran_back - self._count >= _TWIN_SWITCHES
        if many or now_ns - self._begun_ns >= _TWIN_WINDOW_NS:
            self._begun_ns, self._count = now_ns, ran_back
        return many
