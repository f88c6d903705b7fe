"""What the vehicle says: state, attitude and gimbal, on our clock and interpolated to any time."""

from __future__ import annotations

import math
import threading
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass, replace
from typing import Any

from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge import quaternion as quat
from mavlink_bridge.clock import BootClock
from mavlink_bridge.messages import Attitude, GimbalAttitude, Origin, VehicleState
from mavlink_bridge.profile import autopilot_name, decode_version, select_profile

_BUFFER = 512
_MAX_GAP_NS = 500_000_000
_MAX_EXTRAPOLATION_NS = 100_000_000
_GIMBAL_FALLBACK_NS = 1_000_000_000
_HEARTBEAT_LOST_NS = 3_000_000_000

# Best first: a poorer source is only used while no better one speaks.
_GIMBAL_SOURCES = ("GIMBAL_DEVICE_ATTITUDE_STATUS", "MOUNT_ORIENTATION", "MOUNT_STATUS")


@dataclass(frozen=True)
class GimbalSample:
    """One gimbal message: gimbal to the horizon frame that points to north or to the nose.

    earth_frame: yaw is from true north, else from the vehicle's heading.
    """

    time_ns: int
    quaternion: quat.Quaternion
    earth_frame: bool
    source: str


def gimbal_in_earth_frame(flags: int) -> bool:
    """Whether GIMBAL_DEVICE_ATTITUDE_STATUS gives yaw from north: YAW_IN_* first, then YAW_LOCK."""
    if flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME:
        return False
    if flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME:
        return True
    return bool(flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK)


class AttitudeBuffer:
    """The last attitudes, in time order, interpolated between samples."""

    def __init__(self) -> None:
        self._samples: deque[Attitude] = deque(maxlen=_BUFFER)

    def clear(self) -> None:
        """Forget all."""
        self._samples.clear()

    def add(self, sample: Attitude) -> None:
        """Append; one that is not newer than the newest is dropped."""
        if not self._samples or sample.time_ns > self._samples[-1].time_ns:
            self._samples.append(sample)

    def at(self, time_ns: int) -> Attitude | None:
        """Attitude at a time, None outside the buffer or inside a gap of more than 0.5 s."""
        samples = list(self._samples)
        if not samples or time_ns < samples[0].time_ns:
            return None
        newest = samples[-1]
        if time_ns >= newest.time_ns:
            ahead = time_ns - newest.time_ns
            if ahead > _MAX_EXTRAPOLATION_NS:
                return None
            q = quat.turn(newest.quaternion, newest.rates, ahead * 1e-9)
            return _attitude(time_ns, q, newest.rates)
        index = bisect_left(samples, time_ns, key=lambda sample: sample.time_ns)
        before, after = samples[max(index - 1, 0)], samples[index]
        span = after.time_ns - before.time_ns
        if span > _MAX_GAP_NS:
            return None
        t = (time_ns - before.time_ns) / span if span else 1.0
        q = quat.slerp(before.quaternion, after.quaternion, t)
        return _attitude(time_ns, q, after.rates if t > 0.5 else before.rates)


class GimbalBuffer:
    """The last gimbal attitudes of the best source that speaks."""

    def __init__(self) -> None:
        self._samples: deque[GimbalSample] = deque(maxlen=_BUFFER)

    def clear(self) -> None:
        """Forget all."""
        self._samples.clear()

    def add(self, sample: GimbalSample) -> None:
        """Append, unless a better source spoke within the last second."""
        if self._samples:
            newest = self._samples[-1]
            if sample.source != newest.source:
                rank = _GIMBAL_SOURCES.index(sample.source)
                worse = rank > _GIMBAL_SOURCES.index(newest.source)
                if worse and sample.time_ns - newest.time_ns < _GIMBAL_FALLBACK_NS:
                    return
                self._samples.clear()
            elif sample.time_ns <= newest.time_ns or sample.earth_frame != newest.earth_frame:
                if sample.time_ns <= newest.time_ns:
                    return
                self._samples.clear()
        self._samples.append(sample)

    def at(self, time_ns: int) -> GimbalSample | None:
        """Interpolated sample; the newest is held for 0.5 s (a gimbal moves slowly)."""
        samples = list(self._samples)
        if not samples or time_ns < samples[0].time_ns:
            return None
        if time_ns >= samples[-1].time_ns:
            return samples[-1] if time_ns - samples[-1].time_ns <= _MAX_GAP_NS else None
        index = bisect_left(samples, time_ns, key=lambda sample: sample.time_ns)
        before, after = samples[max(index - 1, 0)], samples[index]
        span = after.time_ns - before.time_ns
        if span > 2 * _MAX_GAP_NS:
            return None
        t = (time_ns - before.time_ns) / span if span else 1.0
        return replace(
            before, time_ns=time_ns, quaternion=quat.slerp(before.quaternion, after.quaternion, t)
        )


def _attitude(time_ns: int, q: quat.Quaternion, rates: quat.Vector) -> Attitude:
    return Attitude(time_ns, *quat.to_euler(q), quaternion=q, rates=rates)


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
            return component == self._state.component_id or message.get_type() in _GIMBAL_SOURCES
        return self._is_autopilot(message) and self._wanted_id in (None, system)

    @staticmethod
    def _is_autopilot(message: Any) -> bool:
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
        with self._lock:
            if rebooted:
                self._attitudes.clear()
                self._gimbals.clear()
                self._state = replace(self._state, origin=None)
            handler = _HANDLERS.get(message.get_type())
            if handler is not None:
                handler(self, message, stamp_ns)
        return rebooted

    # --- one method per message, under the lock --------------------------------------------------

    def _heartbeat(self, m: Any, time_ns: int) -> None:
        if not self._is_autopilot(m):
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
        q = quat.from_euler(m.roll, m.pitch, m.yaw)
        rates = (m.rollspeed, m.pitchspeed, m.yawspeed)
        self._attitudes.add(Attitude(time_ns, m.roll, m.pitch, m.yaw, q, rates))

    def _attitude_quaternion(self, m: Any, time_ns: int) -> None:
        q = quat.normalise((m.q1, m.q2, m.q3, m.q4))
        self._attitudes.add(_attitude(time_ns, q, (m.rollspeed, m.pitchspeed, m.yawspeed)))

    def _gimbal_device(self, m: Any, time_ns: int) -> None:
        earth = gimbal_in_earth_frame(m.flags)
        self._gimbals.add(GimbalSample(time_ns, quat.normalise(m.q), earth, _GIMBAL_SOURCES[0]))

    def _mount_orientation(self, m: Any, time_ns: int) -> None:
        roll, pitch, yaw = (math.radians(a) for a in (m.roll, m.pitch, m.yaw))
        q = quat.from_euler(roll, pitch, yaw)
        self._gimbals.add(GimbalSample(time_ns, q, False, _GIMBAL_SOURCES[1]))

    def _mount_status(self, m: Any, time_ns: int) -> None:
        # pointing_a, b, c: pitch, roll, yaw in centidegrees, yaw from the vehicle's nose.
        pitch, roll, yaw = (
            math.radians(0.01 * a) for a in (m.pointing_a, m.pointing_b, m.pointing_c)
        )
        q = quat.from_euler(roll, pitch, yaw)
        self._gimbals.add(GimbalSample(time_ns, q, False, _GIMBAL_SOURCES[2]))

    def _local_position(self, m: Any, time_ns: int) -> None:
        self._state = replace(
            self._state,
            local_position_ned=(m.x, m.y, m.z),
            local_velocity_ned=(m.vx, m.vy, m.vz),
            local_time_ns=time_ns,
        )

    def _global_position(self, m: Any, time_ns: int) -> None:
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
