"""Reports once for all links that the flight controller is found, lost or back."""

from __future__ import annotations

import threading
from collections.abc import Callable

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.link.clock import monotonic_ns
from mavlink_bridge.messages import VehicleState

_PATIENCE_NS = 5_000_000_000
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
