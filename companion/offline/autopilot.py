"""The autopilot's telemetry of a recorded flight, replayed up to a time."""

from __future__ import annotations

from companion.recorded.flight import LogBeside
from companion.sources.zoom import ZoomTable
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.link.tlog import read_tlog
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.vehicle.tracker import VehicleTracker


class RecordedAutopilot(VehicleTracker):
    """The vehicle's telemetry from a record's messages, replayed to any later time: call `advance`
    before each look. start_ns: messages before it, CLOCK_MONOTONIC, are left out. `TlogError` if
    the log cannot be read.
    """

    def __init__(self, bridge: BridgeConfig, log: LogBeside, start_ns: int) -> None:
        super().__init__(bridge)
        self._now_ns = start_ns
        dated = ((utc - log.ahead_ns, m) for utc, m in read_tlog(log.path))
        # A .tlog is appended to: earlier flights may stand before this one.
        self._messages = (item for item in dated if item[0] >= start_ns)
        self._next = next(self._messages, None)

    def advance(self, time_ns: int) -> None:
        """Process all messages that had arrived by `time_ns`, CLOCK_MONOTONIC."""
        self._now_ns = time_ns
        while self._next is not None and self._next[0] <= time_ns:
            received_ns, message = self._next
            if self.accepts(message):
                if message.get_type() != "TIMESYNC":
                    self.handle(message, received_ns)
                elif message.tc1 != 0:  # an answer; ts1 is our own time of the question
                    self.timesync(message.tc1, message.ts1, received_ns)
            self._next = next(self._messages, None)

    def zoom_factor(self, zoom: ZoomTable | None, time_ns: int) -> float | None:
        """Multiple of the model's focal length by the log; 1 if the camera has no zoom, None if the
        log has no value.
        """
        if zoom is None:
            return 1.0
        level = self.zoom_at(time_ns, zoom.hold_s)
        return None if level is None else zoom.factor(level)

    def state(self) -> VehicleState:
        """The vehicle's state at the current replay time."""
        return self.snapshot(self._now_ns)
