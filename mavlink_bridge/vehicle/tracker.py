"""What the vehicle says: state, attitude and gimbal, on our clock and interpolated to any time."""

from __future__ import annotations

import math
import threading
from dataclasses import replace
from typing import Any

from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge import quaternion as quat
from mavlink_bridge.link.clock import BootClock
from mavlink_bridge.messages import Attitude, GimbalAttitude, Origin, VehicleState
from mavlink_bridge.vehicle.buffers import (
    GIMBAL_SOURCES,
    AttitudeBuffer,
    GimbalBuffer,
    GimbalSample,
    VectorBuffer,
    attitude,
)
from mavlink_bridge.vehicle.profile import autopilot_name, decode_version, select_profile

_HEARTBEAT_LOST_NS = 3_000_000_000
_OLD_NS = 2_000_000_000


def gimbal_in_earth_frame(flags: int) -> bool:
    """Whether GIMBAL_DEVICE_ATTITUDE_STATUS gives yaw from north: YAW_IN_* first, then YAW_LOCK."""
    if flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME:
        return False
    if flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME:
        return True
    return bool(flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK)


class VehicleTracker:
    """Follows one vehicle's messages. `handle` runs in the link's thread, the rest anywhere."""

    def __init__(self, system_id: int | None, mount: quat.Quaternion, fixed_camera: bool) -> None:
        self.clock = BootClock()
        self._lock = threading.Lock()
        self._state = VehicleState()
        self._wanted_id = system_id
        self._mount = mount
        self._fixed = fixed_camera
        self._heartbeat_ns: int | None = None
        self._attitudes = AttitudeBuffer()
        self._gimbals = GimbalBuffer()
        self._globals = VectorBuffer()
        self._locals = VectorBuffer()
        self.ignored = 0

    def snapshot(self, now_ns: int) -> VehicleState:
        """The state now."""
        with self._lock:
            age_ns = math.inf if self._heartbeat_ns is None else now_ns - self._heartbeat_ns
            return replace(
                self._state,
                connected=age_ns < _HEARTBEAT_LOST_NS,
                heartbeat_age_s=age_ns * 1e-9,
                reboots=self.clock.reboots,
                clock_offset_ns=self.clock.offset_ns,
                clock_source=self.clock.source,
            )

    def attitude_at(self, time_ns: int) -> Attitude | None:
        """The vehicle's attitude at a time."""
        with self._lock:
            return self._attitudes.at(time_ns)

    def gimbal_at(self, time_ns: int) -> GimbalAttitude | None:
        """The camera's attitude at a time: gimbal (or body, if fixed) and mounting, to NED."""
        with self._lock:
            body = self._attitudes.at(time_ns)
            sample = None if self._fixed else self._gimbals.at(time_ns)
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
        return GimbalAttitude(
            time_ns, roll, pitch, yaw, quat.wrap_pi(yaw - body.yaw_rad), q, source
        )

    def global_at(self, time_ns: int) -> tuple[float, ...] | None:
        """The EKF's (latitude, longitude in degrees, altitude AMSL) at a time."""
        with self._lock:
            return self._globals.at(time_ns)

    def local_at(self, time_ns: int) -> tuple[float, ...] | None:
        """The EKF's NED position from its origin at a time."""
        with self._lock:
            return self._locals.at(time_ns)

    def set_origin(self, origin: Origin | None) -> None:
        """What the origin keeper read."""
        with self._lock:
            self._state = replace(self._state, origin=origin)

    def accepts(self, message: Any) -> bool:
        """Whether the message is from the vehicle's autopilot; the first heartbeat decides."""
        system, component = message.get_srcSystem(), message.get_srcComponent()
        if self._state.system_id is not None:
            if system != self._state.system_id:
                return False
            # Gimbals of other vendors are components of their own.
            return component == self._state.component_id or message.get_type() in GIMBAL_SOURCES
        return self.is_autopilot(message) and self._wanted_id in (None, system)

    @staticmethod
    def is_autopilot(message: Any) -> bool:
        """Whether it is an autopilot's heartbeat: no ground station's, camera's or companion's."""
        return (
            message.get_type() == "HEARTBEAT"
            and message.autopilot != mavlink.MAV_AUTOPILOT_INVALID
            and message.type != mavlink.MAV_TYPE_GCS
            and message.get_srcSystem() != 0
        )

    def handle(self, message: Any, received_ns: int) -> bool:
        """Take in one accepted message; True if it shows that the flight controller rebooted."""
        rebooted = False
        stamp_ns = received_ns
        boot_ms = getattr(message, "time_boot_ms", None)
        if boot_ms is not None and message.get_srcComponent() == self._state.component_id:
            rebooted = self.clock.observe(boot_ms * 1_000_000, received_ns)
            stamp_ns = self.clock.to_monotonic(boot_ms * 1_000_000, received_ns)
        if rebooted:
            self._forget()
        with self._lock:
            handler = _HANDLERS.get(message.get_type())
            # An old frame that came late (or again) must not undo what newer ones said.
            if handler is None or received_ns - stamp_ns > _OLD_NS:
                self.ignored += handler is not None
                return rebooted
            try:
                handler(self, message, stamp_ns)
            except ValueError:  # not finite, or no rotation: estimators start up like that
                self.ignored += 1
        return rebooted

    def timesync(self, boot_ns: int, sent_ns: int, received_ns: int) -> bool:
        """Take in a TIMESYNC answer; True if it shows that the flight controller rebooted."""
        rebooted = self.clock.timesync(boot_ns, sent_ns, received_ns)
        if rebooted:
            self._forget()
        return rebooted

    def _forget(self) -> None:
        """What was dated by the clock before a reboot, and the origin, are void."""
        with self._lock:
            for buffer in (self._attitudes, self._gimbals, self._globals, self._locals):
                buffer.clear()
            self._state = replace(self._state, origin=None)

    # --- one method per message, under the lock --------------------------------------------------

    def _heartbeat(self, m: Any, time_ns: int) -> None:
        if not self.is_autopilot(m):
            return
        self._heartbeat_ns = time_ns
        autopilot = autopilot_name(m.autopilot)
        self._state = replace(
            self._state,
            system_id=m.get_srcSystem(),
            component_id=m.get_srcComponent(),
            autopilot=autopilot,
            vehicle_type=m.type,
            armed=bool(m.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED),
            custom_mode=m.custom_mode,
            mode=mavutil.mode_string_v10(m),
            system_status=m.system_status,
            profile=select_profile(autopilot, self._state.version).name,
        )

    def _version(self, m: Any, _: int) -> None:
        version = decode_version(m.flight_sw_version)
        name = select_profile(self._state.autopilot, version).name
        self._state = replace(self._state, version=version, profile=name)

    def _attitude_euler(self, m: Any, time_ns: int) -> None:
        _check_finite(m.roll, m.pitch, m.yaw, m.rollspeed, m.pitchspeed, m.yawspeed)
        q = quat.from_euler(m.roll, m.pitch, m.yaw)
        rates = (m.rollspeed, m.pitchspeed, m.yawspeed)
        self._attitudes.add(Attitude(time_ns, m.roll, m.pitch, m.yaw, q, rates))

    def _attitude_quaternion(self, m: Any, time_ns: int) -> None:
        _check_finite(m.rollspeed, m.pitchspeed, m.yawspeed)
        q = quat.normalise((m.q1, m.q2, m.q3, m.q4))
        self._attitudes.add(attitude(time_ns, q, (m.rollspeed, m.pitchspeed, m.yawspeed)))

    def _gimbal_device(self, m: Any, time_ns: int) -> None:
        earth = gimbal_in_earth_frame(m.flags)
        self._gimbals.add(GimbalSample(time_ns, quat.normalise(m.q), earth, GIMBAL_SOURCES[0]))

    def _mount_orientation(self, m: Any, time_ns: int) -> None:
        _check_finite(m.roll, m.pitch, m.yaw)
        roll, pitch, yaw = (math.radians(a) for a in (m.roll, m.pitch, m.yaw))
        q = quat.from_euler(roll, pitch, yaw)
        self._gimbals.add(GimbalSample(time_ns, q, False, GIMBAL_SOURCES[1]))

    def _mount_status(self, m: Any, time_ns: int) -> None:
        # pointing_a, b, c: pitch, roll, yaw in centidegrees, yaw from the vehicle's nose.
        pitch, roll, yaw = (
            math.radians(0.01 * a) for a in (m.pointing_a, m.pointing_b, m.pointing_c)
        )
        q = quat.from_euler(roll, pitch, yaw)
        self._gimbals.add(GimbalSample(time_ns, q, False, GIMBAL_SOURCES[2]))

    def _local_position(self, m: Any, time_ns: int) -> None:
        _check_finite(m.x, m.y, m.z, m.vx, m.vy, m.vz)
        self._locals.add(time_ns, (m.x, m.y, m.z))
        self._state = replace(
            self._state,
            local_position_ned=(m.x, m.y, m.z),
            local_velocity_ned=(m.vx, m.vy, m.vz),
            local_time_ns=time_ns,
        )

    def _global_position(self, m: Any, time_ns: int) -> None:
        if m.lat == 0 and m.lon == 0:
            return  # what firmwares send before they have a position
        if abs(m.lat) > 900_000_000 or abs(m.lon) > 1_800_000_000:
            raise ValueError(f"no place on Earth: {m.lat}, {m.lon}")
        self._globals.add(time_ns, (m.lat * 1e-7, m.lon * 1e-7, m.alt * 1e-3))
        self._state = replace(
            self._state,
            latitude_deg=m.lat * 1e-7,
            longitude_deg=m.lon * 1e-7,
            altitude_amsl_m=m.alt * 1e-3,
            altitude_relative_m=m.relative_alt * 1e-3,
            position_time_ns=time_ns,
        )

    def _ekf_status(self, m: Any, _: int) -> None:
        self._state = replace(
            self._state,
            ekf_flags=m.flags,
            ekf_velocity_variance=m.velocity_variance,
            ekf_horizontal_variance=m.pos_horiz_variance,
            ekf_vertical_variance=m.pos_vert_variance,
            ekf_compass_variance=m.compass_variance,
        )

    def _estimator_status(self, m: Any, _: int) -> None:
        # PX4's innovation test ratios; the flags share their first bits with EKF_STATUS_REPORT.
        self._state = replace(
            self._state,
            ekf_flags=m.flags,
            ekf_velocity_variance=m.vel_ratio,
            ekf_horizontal_variance=m.pos_horiz_ratio,
            ekf_vertical_variance=m.pos_vert_ratio,
            ekf_compass_variance=m.mag_ratio,
        )

    def _gps(self, m: Any, time_ns: int) -> None:
        accuracy = getattr(m, "h_acc", 0)
        self._state = replace(
            self._state,
            gps_fix_type=m.fix_type,
            gps_satellites=0 if m.satellites_visible == 255 else m.satellites_visible,
            gps_latitude_deg=m.lat * 1e-7,
            gps_longitude_deg=m.lon * 1e-7,
            gps_h_accuracy_m=accuracy * 1e-3 if accuracy else math.nan,
            gps_time_ns=time_ns,
        )

    def _rc(self, m: Any, time_ns: int) -> None:
        channels = tuple(getattr(m, f"chan{i}_raw") for i in range(1, 19))
        self._state = replace(self._state, rc_channels_us=channels, rc_time_ns=time_ns)

    def _text(self, m: Any, _: int) -> None:
        self._state = replace(self._state, last_text=str(m.text))


def _check_finite(*values: float) -> None:
    if not all(math.isfinite(value) for value in values):
        raise ValueError(f"{values} is not finite")


_HANDLERS = {
    "HEARTBEAT": VehicleTracker._heartbeat,
    "AUTOPILOT_VERSION": VehicleTracker._version,
    "ATTITUDE": VehicleTracker._attitude_euler,
    "ATTITUDE_QUATERNION": VehicleTracker._attitude_quaternion,
    "GIMBAL_DEVICE_ATTITUDE_STATUS": VehicleTracker._gimbal_device,
    "MOUNT_ORIENTATION": VehicleTracker._mount_orientation,
    "MOUNT_STATUS": VehicleTracker._mount_status,
    "LOCAL_POSITION_NED": VehicleTracker._local_position,
    "GLOBAL_POSITION_INT": VehicleTracker._global_position,
    "EKF_STATUS_REPORT": VehicleTracker._ekf_status,
    "ESTIMATOR_STATUS": VehicleTracker._estimator_status,
    "GPS_RAW_INT": VehicleTracker._gps,
    "RC_CHANNELS": VehicleTracker._rc,
    "STATUSTEXT": VehicleTracker._text,
}
MESSAGES_IN: tuple[str, ...] = tuple(_HANDLERS)
