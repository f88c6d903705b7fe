"""Tracks the vehicle's telemetry on CLOCK_MONOTONIC: state, attitude and gimbal, interpolated."""

from __future__ import annotations

import math
import threading
from dataclasses import replace
from typing import Any

from mavlink_bridge import quaternion as quat
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.link.clock import BootClock
from mavlink_bridge.messages import (
    Attitude,
    GimbalAttitude,
    InertialSample,
    Origin,
    VehicleState,
)
from mavlink_bridge.vehicle.buffers import GIMBAL_SOURCES
from mavlink_bridge.vehicle.readings import (
    MESSAGES_IN,
    VehicleReadings,
    boot_time_ns,
    is_autopilot,
)

_COMPONENTS_SAY = (*GIMBAL_SOURCES, "CAMERA_SETTINGS")
_HEARTBEAT_LOST_NS = 3_000_000_000
_OLD_NS = 2_000_000_000


class VehicleTracker:
    """Processes one vehicle's messages. `accepts`, `handle` and `timesync` run in the link's
    thread; other methods in any. config: says which vehicle (without `system_id` the first that is
    heard), which gimbal, and how the camera is mounted.
    """

    def __init__(self, config: BridgeConfig) -> None:
        camera = config.camera
        self.clock = BootClock()
        self._lock = threading.Lock()
        self._readings = VehicleReadings((camera.gimbal_component, camera.gimbal_device))
        self.arming = self._readings.arming
        self._wanted_id = config.system_id
        angles = (camera.mount_roll_deg, camera.mount_pitch_deg, camera.mount_yaw_deg)
        self._mount = quat.from_euler(*map(math.radians, angles))
        self._fixed = camera.mount == "fixed"
        self.ignored = 0

    def snapshot(self, now_ns: int) -> VehicleState:
        """The newest state; `connected` if a heartbeat came in the 3 s before now_ns."""
        with self._lock:
            heartbeat_ns = self._readings.heartbeat_ns
            age_ns = None if heartbeat_ns is None else now_ns - heartbeat_ns
            return replace(
                self._readings.state,
                connected=age_ns is not None and age_ns < _HEARTBEAT_LOST_NS,
                reboots=self.clock.reboots,
                clock_offset_ns=self.clock.offset_ns,
                clock_source=self.clock.source,
            )

    @property
    def other_gimbals(self) -> tuple[tuple[int, int], ...]:
        """Gimbals that also send but are not used: (component, device)."""
        with self._lock:
            return () if self._fixed else tuple(sorted(self._readings.gimbals.others))

    @property
    def impostors(self) -> int:
        """Number of messages with the vehicle's ids but of another vehicle type or firmware."""
        with self._lock:
            return self._readings.impostors

    def attitude_at(self, time_ns: int) -> Attitude | None:
        """The vehicle's attitude at a time; None if unknown."""
        with self._lock:
            return self._readings.attitudes.at(time_ns)

    def gimbal_at(self, time_ns: int) -> GimbalAttitude | None:
        """The camera's attitude to NED at a time: the gimbal's (fixed camera: the vehicle's),
        turned by `mount`. None if the vehicle's or the gimbal's is unknown then.
        """
        with self._lock:
            body = self._readings.attitudes.at(time_ns)
            sample = None if self._fixed else self._readings.gimbals.at(time_ns)
        if body is None:
            return None
        heading = quat.from_euler(0.0, 0.0, body.yaw_rad)
        if self._fixed:
            q, source = body.quaternion, "fixed"
        elif sample is None:
            return None
        elif sample.earth_frame:
            q, source = sample.quaternion, sample.source
        else:
            q, source = quat.multiply(heading, sample.quaternion), sample.source
        q = quat.normalise(quat.multiply(q, self._mount))
        roll, pitch, yaw = quat.to_euler(q)
        return GimbalAttitude(time_ns, roll, pitch, yaw, q, source)

    def zoom_at(self, time_ns: int, hold_s: float) -> float | None:
        """The camera's zoom level at a time, per cent of its range; see `ZoomBuffer.at`."""
        with self._lock:
            return self._readings.zooms.at(time_ns, hold_s)

    def global_at(self, time_ns: int) -> tuple[float, ...] | None:
        """The EKF's (latitude, longitude in degrees, altitude AMSL in m) at a time; or None."""
        with self._lock:
            return self._readings.globals.at(time_ns)

    def local_at(self, time_ns: int) -> tuple[float, ...] | None:
        """The EKF's NED position from its origin at a time, m; None if unknown."""
        with self._lock:
            return self._readings.locals.at(time_ns)

    def inertial_since(self, time_ns: int) -> tuple[InertialSample, ...]:
        """IMU samples after a time, oldest first; the newest 512 at most (10 s at 50 Hz)."""
        with self._lock:
            return self._readings.inertial.since(time_ns)

    def set_origin(self, origin: Origin | None) -> None:
        """Set the EKF origin in the state; None: unknown."""
        with self._lock:
            self._readings.set_origin(origin)

    def accepts(self, message: Any) -> bool:
        """Whether a message is from the system that the first heartbeat selected for good: from its
        autopilot, or angles and zoom of its other components.
        """
        system, component = message.get_srcSystem(), message.get_srcComponent()
        state = self._readings.state
        if state.system_id is not None:
            if system != state.system_id:
                return False
            # Gimbals of other vendors, and cameras, are components of their own.
            return component == state.component_id or message.get_type() in _COMPONENTS_SAY
        return is_autopilot(message) and self._wanted_id in (None, system)

    def handle(self, message: Any, received_ns: int) -> bool:
        """Process an accepted message (old, impossible: only `ignored`); True after a reboot."""
        rebooted = False
        stamp_ns = received_ns
        boot_ns = boot_time_ns(message)
        if boot_ns is not None and message.get_srcComponent() == self._readings.state.component_id:
            rebooted = self.clock.observe(boot_ns, received_ns)
            stamp_ns = self.clock.to_monotonic(boot_ns, received_ns)
            if self.clock.is_stamp_doubtful:
                stamp_ns = received_ns - 2 * _OLD_NS  # of which time it is, nobody knows
        if rebooted:
            self._forget()
        with self._lock:
            known = message.get_type() in MESSAGES_IN
            # An old frame that came late (or again) must not undo what newer ones said.
            if not known or received_ns - stamp_ns > _OLD_NS:
                self.ignored += known
                return rebooted
            try:
                self._readings.update(message, stamp_ns)
            except ValueError:  # no measurement, or no rotation: estimators start up like that
                self.ignored += 1
        return rebooted

    def timesync(self, boot_ns: int, sent_ns: int, received_ns: int) -> bool:
        """Process a TIMESYNC answer; True if it shows that the flight controller rebooted."""
        rebooted = self.clock.timesync(boot_ns, sent_ns, received_ns)
        if rebooted:
            self._forget()
        return rebooted

    def _forget(self) -> None:
        """Drop everything that was dated by the clock before a reboot, and the origin."""
        with self._lock:
            self._readings.forget()
