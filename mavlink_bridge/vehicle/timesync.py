"""TIMESYNC (111): answers the flight controller's requests and sends ours."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.alerts.catalogue import alert, cleared
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.link.clock import monotonic_ns
from mavlink_bridge.link.link import Link
from mavlink_bridge.status import StatusNotifier
from mavlink_bridge.vehicle.tracker import VehicleTracker

_PERIOD_NS = 1_000_000_000
_PENDING = 8
# Questions that nobody answers while the vehicle is heard. The clocks drift apart by up to 0.2 ms a
# second from then on, and positions are as late: 1 m in ten minutes at 10 m/s.
_UNANSWERED_NS = 15_000_000_000


class TimeSync:
    """Requests the vehicle's clock at 1 Hz and passes each answer to the tracker; one thread.

    Reports when the answers stop.
    """

    def __init__(
        self,
        tracker: VehicleTracker,
        component: int,
        notifier: StatusNotifier,
        clock: Callable[[], int] = monotonic_ns,
    ) -> None:
        self._tracker, self._clock = tracker, clock
        self._notifier = notifier
        self._component = component
        self._sent: dict[int, int] = {}
        self._next_ns = 0
        self._asking_ns = self._turn_ns = 0

    def reset(self) -> None:
        """Ignore answers to earlier requests, because the link was opened."""
        self._next_ns = 0
        self._sent.clear()

    def on_message(self, link: Link, message: Any, time_ns: int) -> bool:
        """Process a TIMESYNC received at time_ns: answer a request (unless the link is congested),
        or use the answer to our own request for the clock offset. True if an answer shows that the
        autopilot has rebooted.
        """
        if message.tc1 == 0:
            if link.congested:
                return False  # as if lost: a flood of questions costs no position its place
            answer = mavlink.MAVLink_timesync_message(self._clock(), message.ts1)
            link.send(answer, self._component)
            return False
        sent_ns = self._sent.pop(message.ts1, None)
        return sent_ns is not None and self._tracker.timesync(message.tc1, sent_ns, time_ns)

    def tick(self, link: Link, now_ns: int) -> None:
        """Send the request that is due; called only while the vehicle's heartbeat is received."""
        if now_ns - self._turn_ns > _PERIOD_NS:
            self._asking_ns = now_ns  # after a silence, for which nobody owes an answer
        self._turn_ns = now_ns
        if now_ns < self._next_ns:
            return
        self._next_ns = now_ns + _PERIOD_NS
        while len(self._sent) >= _PENDING:
            del self._sent[next(iter(self._sent))]
        sent_ns = self._clock()
        self._sent[sent_ns] = sent_ns
        link.send(mavlink.MAVLink_timesync_message(0, sent_ns), self._component)

        answered_ns = self._tracker.clock.answered_ns
        if answered_ns is not None:
            is_silent = now_ns - max(answered_ns, self._asking_ns) > _UNANSWERED_NS
            problem = alert(AlertId.TIMESYNC_UNANSWERED) if is_silent else None
            self._notifier.notify("timesync", problem, cleared(AlertId.TIMESYNC_UNANSWERED))
