"""The autopilot's data of a recorded flight, as known at a time."""

from __future__ import annotations

import numpy as np

from companion.recorded.flight import LogBeside
from mavlink_bridge import quaternion as quat
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.link.tlog import read_tlog
from mavlink_bridge.messages import Attitude, GimbalAttitude, InertialSample, VehicleState
from mavlink_bridge.vehicle.tracker import VehicleTracker


class RecordedAutopilot:
    """The vehicle's state at a time, from the recorded messages."""

    def __init__(self, bridge: BridgeConfig, log: LogBeside, start_ns: int) -> None:
        c = bridge.camera
        mount = quat.from_euler(*np.radians([c.mount_roll_deg, c.mount_pitch_deg, c.mount_yaw_deg]))
        self._now_ns = start_ns
        self._tracker = VehicleTracker(
            bridge.system_id,
            mount,
            bridge.camera.mount == "fixed",
            (bridge.camera.gimbal_component, bridge.camera.gimbal_device),
        )
        dated = ((utc - log.ahead_ns, m) for utc, m in read_tlog(log.path))
        # A .tlog is appended to: earlier flights may stand before this one.
        self._messages = (item for item in dated if item[0] >= start_ns)
        self._next = next(self._messages, None)

    def advance(self, time_ns: int) -> None:
        """Process all messages that had arrived by `time_ns`, CLOCK_MONOTONIC."""
        self._now_ns = time_ns
        while self._next is not None and self._next[0] <= time_ns:
            received_ns, message = self._next
            if self._tracker.accepts(message):
                if message.get_type() != "TIMESYNC":
                    self._tracker.handle(message, received_ns)
                elif message.tc1 != 0:  # an answer; ts1 is our own time of the question
                    self._tracker.timesync(message.tc1, message.ts1, received_ns)
            self._next = next(self._messages, None)

    def state(self) -> VehicleState:
        """What the vehicle said about itself."""
        return self._tracker.snapshot(self._now_ns)

    def attitude_at(self, time_ns: int) -> Attitude | None:
        """The vehicle's attitude at a CLOCK_MONOTONIC time."""
        return self._tracker.attitude_at(time_ns)

    def gimbal_at(self, time_ns: int) -> GimbalAttitude | None:
        """The camera's attitude to NED at a CLOCK_MONOTONIC time."""
        return self._tracker.gimbal_at(time_ns)

    def zoom_at(self, time_ns: int, hold_s: float) -> float | None:
        """The camera's reported zoom at a time, per cent of its range."""
        return self._tracker.zoom_at(time_ns, hold_s)

    def local_at(self, time_ns: int) -> tuple[float, ...] | None:
        """The EKF's NED position from its origin at a time."""
        return self._tracker.local_at(time_ns)

    def global_at(self, time_ns: int) -> tuple[float, ...] | None:
        """The EKF's (latitude, longitude in degrees, altitude AMSL) at a time."""
        return self._tracker.global_at(time_ns)

    def inertial_since(self, time_ns: int) -> tuple[InertialSample, ...]:
        """What the IMU read after a time, oldest first; at most the last 10 s."""
        return self._tracker.inertial_since(time_ns)
