"""The scripted ground station that flies either vehicle, and the record of what it truly did.

One thread reads the vehicle's first serial port and stamps what it receives; the calls block until
the vehicle has done, or refused, what was asked. Seconds are simulated seconds, truth and gimbal
are looked up on CLOCK_MONOTONIC.
"""

from __future__ import annotations

import bisect
import contextlib
import math
import queue
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.embedded.geodesy import Location
from sitl.embedded.rotation import euler
from sitl.errors import SimulationError

Array = NDArray[np.float64]

_SYSTEM, _COMPONENT = 255, 190  # of the ground station
_VEHICLE, _AUTOPILOT = 1, 1
_HEARTBEAT_S = 0.5  # wall time
_STREAMS = {  # message id -> Hz
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 50.0,
    mavlink.MAVLINK_MSG_ID_SIM_STATE: 50.0,
    mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS: 50.0,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 25.0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 5.0,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 2.0,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: 5.0,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: 2.0,
}
_CLOCK_WINDOW = 25  # samples over which the least latency is taken
_SECONDS_KEPT = 60 * 60
_WALL_MARGIN_S = 30.0
# Wall time. A busy machine may let one of the two wait for seconds: an answer that comes costs
# nothing, and only a vehicle that is alive and silent takes that long.
_REPEAT_S = 1.5
_TRIES = 20
_SHOWN_S = 30.0  # simulated, until the next heartbeat shows what was accepted
_GUIDED_POSITION = 0xDF8  # position only
_GIMBAL_YAW_LOCK = 16.0

MODES = {"STABILIZE": 0, "AUTO": 3, "GUIDED": 4, "LOITER": 5, "RTL": 6, "LAND": 9}
_MODE_NAMES = {number: name for name, number in MODES.items()}


class PilotError(SimulationError):
    """The vehicle refused, or did not do in time, what the pilot asked."""


@dataclass(frozen=True)
class Truth:
    """The vehicle's true state. altitude: AMSL; quaternion: (4,) w, x, y, z, FRD to NED;
    velocity_ned: (3,) m/s; time_ns: CLOCK_MONOTONIC; boot_s: simulated seconds since boot.
    """

    time_ns: int
    boot_s: float
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    quaternion: Array
    velocity_ned: Array

    @property
    def location(self) -> Location:
        """Latitude, longitude, altitude AMSL."""
        return Location(self.latitude_deg, self.longitude_deg, self.altitude_m)

    @property
    def roll_pitch_yaw(self) -> tuple[float, float, float]:
        """Euler angles in radians."""
        return euler(self.quaternion)


@dataclass(frozen=True)
class GimbalState:
    """GIMBAL_DEVICE_ATTITUDE_STATUS: quaternion (4,) with earth-frame roll and pitch; the yaw is
    from the vehicle's nose, or from north, as the flags say.
    """

    time_ns: int
    quaternion: Array
    flags: int

    @property
    def yaw_in_vehicle_frame(self) -> bool:
        """By the YAW_IN_* flags; where neither is set, by YAW_LOCK."""
        if self.flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME:
            return True
        if self.flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME:
            return False
        return not self.flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK

    @property
    def roll_pitch_yaw(self) -> tuple[float, float, float]:
        """Euler angles in radians, in the frames that the flags name."""
        return euler(self.quaternion)


@dataclass(frozen=True)
class EkfSample:
    """LOCAL_POSITION_NED with the EKF origin and flags of its time; times as in `Truth`."""

    time_ns: int
    boot_s: float
    position_ned: tuple[float, float, float]
    velocity_ned: tuple[float, float, float]
    origin: Location | None
    flags: int

    @property
    def location(self) -> Location | None:
        """Where the EKF says the vehicle is."""
        return self.origin.offset(*self.position_ned) if self.origin else None


@dataclass(frozen=True)
class StatusText:
    """A STATUSTEXT of any component."""

    time_ns: int
    severity: int
    text: str
    component: int


@dataclass(frozen=True)
class MissionStep:
    """A mission item; build it with the functions below."""

    command: int
    parameters: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    latitude_deg: float = 0.0
    longitude_deg: float = 0.0
    altitude_m: float = 0.0  # above home
    raw_x: int | None = None  # param5 of a command that is not a place


def takeoff_step(height_m: float) -> MissionStep:
    """Climb to a height above home."""
    return MissionStep(mavlink.MAV_CMD_NAV_TAKEOFF, altitude_m=height_m)


def waypoint_step(
    latitude_deg: float, longitude_deg: float, height_m: float, hold_s: float = 0.0
) -> MissionStep:
    """Fly to a place at a height above home."""
    return MissionStep(
        mavlink.MAV_CMD_NAV_WAYPOINT,
        (hold_s, 0.0, 0.0, 0.0),
        latitude_deg,
        longitude_deg,
        height_m,
    )


def speed_step(speed_m_s: float) -> MissionStep:
    """Change the ground speed."""
    return MissionStep(mavlink.MAV_CMD_DO_CHANGE_SPEED, (1.0, speed_m_s, -1.0, 0.0))


def gimbal_step(pitch_deg: float, yaw_deg: float) -> MissionStep:
    """Point the gimbal; yaw from the vehicle's nose."""
    return MissionStep(
        mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW,
        (pitch_deg, yaw_deg, 0.0, 0.0),
        raw_x=0,
    )


def return_step() -> MissionStep:
    """Return to launch and land."""
    return MissionStep(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH)


def land_step() -> MissionStep:
    """Land where the vehicle is."""
    return MissionStep(mavlink.MAV_CMD_NAV_LAND)


class BootClock:
    """Maps the vehicle's boot time to CLOCK_MONOTONIC by the least latency lately seen."""

    def __init__(self, speedup: float) -> None:
        self._scale = 1e6 / speedup  # ns of wall time per ms of simulated time
        self._offsets: deque[float] = deque(maxlen=_CLOCK_WINDOW)

    def restart(self, speedup: float) -> None:
        """Simulated time runs at another speed from now on."""
        self._scale = 1e6 / speedup
        self._offsets.clear()

    def observe(self, boot_ms: int, received_ns: int) -> None:
        """A message of boot time boot_ms was received."""
        self._offsets.append(received_ns - boot_ms * self._scale)

    def monotonic_ns(self, boot_ms: int) -> int:
        """CLOCK_MONOTONIC at a boot time."""
        return round(boot_ms * self._scale + min(self._offsets, default=0.0))


class Track:
    """Samples in time order, safe between one writer and many readers."""

    def __init__(self, limit: int) -> None:
        self._lock = threading.Lock()
        self._times: list[int] = []
        self._samples: list[Any] = []
        self._limit = limit

    def add(self, sample: Any) -> None:
        """Append a sample; it must carry `time_ns`, and be newer than the last."""
        with self._lock:
            if self._times and sample.time_ns <= self._times[-1]:
                return
            self._times.append(sample.time_ns)
            self._samples.append(sample)
            if len(self._times) > 2 * self._limit:
                del self._times[: self._limit]
                del self._samples[: self._limit]

    def around(self, time_ns: int) -> tuple[Any, Any] | None:
        """The samples before and after a time; None outside the track."""
        with self._lock:
            i = bisect.bisect_left(self._times, time_ns)
            if i == len(self._times) or (i == 0 and self._times[0] != time_ns):
                return None
            return self._samples[max(i - 1, 0)], self._samples[i]

    def all(self) -> list[Any]:
        """A copy of the track."""
        with self._lock:
            return list(self._samples)

    @property
    def newest(self) -> Any | None:
        """The last sample."""
        with self._lock:
            return self._samples[-1] if self._samples else None


class Pilot:
    """Flies a vehicle at a MAVLink endpoint ("tcp:127.0.0.1:5760").

    speedup: simulated seconds per real second, as the vehicle was started.
    alive: asked while waiting; it raises when the vehicle has died (`VehicleProcess.check`).
    """

    def __init__(
        self,
        endpoint: str,
        speedup: float = 1.0,
        alive: Callable[[], None] = lambda: None,
    ) -> None:
        self._endpoint, self._speedup, self._alive = endpoint, speedup, alive
        self._link: Any = None
        self._send_lock = threading.Lock()
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._boxes: list[tuple[frozenset[str], queue.SimpleQueue[Any]]] = []
        self._clock = BootClock(speedup)
        self._boot_ms = 0
        self._attitude_ms: int | None = None
        self._flags = 0
        self._subscribers: list[Callable[[Truth], None]] = []
        self._truth = Track(_SECONDS_KEPT * 50)
        self._gimbal = Track(_SECONDS_KEPT * 50)
        self._ekf = Track(_SECONDS_KEPT * 25)
        self.origin: Location | None = None
        self.latest: dict[str, Any] = {}
        self.texts: list[StatusText] = []
        self.reached: list[int] = []
        self.mode: str | None = None
        self.armed = False

    # --- life --------------------------------------------------------------------------------

    def connect(self, timeout_s: float = 90.0) -> None:
        """Connect, wait for the autopilot's heartbeat and ask for its streams."""
        deadline = time.monotonic() + timeout_s
        while self._link is None:
            self._alive()
            try:
                self._link = mavutil.mavlink_connection(
                    self._endpoint,
                    source_system=_SYSTEM,
                    source_component=_COMPONENT,
                    dialect="ardupilotmega",
                    retries=0,
                    robust_parsing=True,
                )
            except OSError as error:
                if time.monotonic() > deadline:
                    raise PilotError(
                        f"no vehicle listens at {self._endpoint}: {error}; is it started?"
                    ) from error
                time.sleep(0.1)
        self._thread = threading.Thread(target=self._read, name="pilot", daemon=True)
        self._thread.start()
        if not self._wait_wall(lambda: self.mode is not None, deadline - time.monotonic()):
            raise PilotError(f"no autopilot heartbeat at {self._endpoint} in {timeout_s:g} s")
        for message_id, hertz in _STREAMS.items():
            self._request_stream(message_id, hertz)
        self.wait(lambda: "SIM_STATE" in self.latest, 20.0, "the vehicle's true state (SIM_STATE)")

    def close(self) -> None:
        """Stop reading and disconnect."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=2.0)
        if self._link is not None:
            self._link.close()

    def __enter__(self) -> Pilot:
        self.connect()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    # --- what is known -----------------------------------------------------------------------

    @property
    def time_s(self) -> float:
        """Simulated seconds since the vehicle's boot."""
        return self._boot_ms / 1000.0

    @property
    def truth(self) -> Truth:
        """The newest true state."""
        newest = self._truth.newest
        if newest is None:
            raise PilotError("no truth has been received: connect first")
        return newest

    @property
    def ekf(self) -> EkfSample | None:
        """The newest position that the EKF reports; None while it reports none."""
        return self._ekf.newest

    @property
    def ekf_flags(self) -> int:
        """EKF_STATUS_FLAGS as last reported."""
        return self._flags

    def truth_at(self, time_ns: int) -> Truth | None:
        """The true state at a CLOCK_MONOTONIC time, interpolated; None outside the record."""
        pair = self._truth.around(time_ns)
        if pair is None:
            return None
        a, b = pair
        t = _share(a.time_ns, b.time_ns, time_ns)
        return Truth(
            time_ns,
            a.boot_s + t * (b.boot_s - a.boot_s),
            a.latitude_deg + t * (b.latitude_deg - a.latitude_deg),
            a.longitude_deg + t * (b.longitude_deg - a.longitude_deg),
            a.altitude_m + t * (b.altitude_m - a.altitude_m),
            _slerp(a.quaternion, b.quaternion, t),
            a.velocity_ned + t * (b.velocity_ned - a.velocity_ned),
        )

    def gimbal_at(self, time_ns: int) -> GimbalState | None:
        """The gimbal at a CLOCK_MONOTONIC time, interpolated; None outside the record."""
        pair = self._gimbal.around(time_ns)
        if pair is None:
            return None
        a, b = pair
        t = _share(a.time_ns, b.time_ns, time_ns)
        return GimbalState(time_ns, _slerp(a.quaternion, b.quaternion, t), b.flags)

    def newest_common_ns(self) -> int | None:
        """The latest time at which both truth and gimbal are known."""
        truth, gimbal = self._truth.newest, self._gimbal.newest
        return min(truth.time_ns, gimbal.time_ns) if truth and gimbal else None

    def truth_track(self) -> list[Truth]:
        """Everything recorded of the true state."""
        return self._truth.all()

    def gimbal_track(self) -> list[GimbalState]:
        """Everything recorded of the gimbal."""
        return self._gimbal.all()

    def ekf_track(self) -> list[EkfSample]:
        """Everything recorded of the EKF's position."""
        return self._ekf.all()

    def ekf_pairs(self) -> Iterator[tuple[EkfSample, Location]]:
        """Every position that the EKF reported, with where the vehicle truly was then."""
        # Paired by the vehicle's own clock: CLOCK_MONOTONIC stamps move when simulated time stalls.
        truth = self.truth_track()
        times = np.array([t.boot_s for t in truth])
        for sample in self.ekf_track():
            i = int(np.searchsorted(times, sample.boot_s))
            if sample.location is None or not 0 < i < len(times):
                continue
            a, b = truth[i - 1].location, truth[i].location
            t = (sample.boot_s - times[i - 1]) / (times[i] - times[i - 1])
            leg = a.ned_of(b)
            yield sample, a.offset(t * leg[0], t * leg[1], t * leg[2])

    def ekf_errors(self, since_ns: int = 0, until_ns: int = 1 << 62) -> Array:
        """NED errors (N, 3) in metres of the EKF's positions against the truth of their times."""
        errors = [
            true.ned_of(sample.location)
            for sample, true in self.ekf_pairs()
            if sample.location is not None and since_ns <= sample.time_ns <= until_ns
        ]
        return np.array(errors, dtype=np.float64).reshape(-1, 3)

    def subscribe(self, callback: Callable[[Truth], None]) -> None:
        """Call back with every new true state, from the reading thread: be quick."""
        self._subscribers.append(callback)

    def has_text(self, part: str, since_ns: int = 0) -> bool:
        """Whether a status text containing `part` has come since a CLOCK_MONOTONIC time."""
        return any(part in t.text for t in list(self.texts) if t.time_ns >= since_ns)

    # --- waiting -----------------------------------------------------------------------------

    def wait(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Block until a condition holds; PilotError after timeout_s simulated seconds."""
        if not self._wait(condition, timeout_s):
            texts = "; ".join(t.text for t in self.texts[-4:])
            raise PilotError(
                f"waited {timeout_s:g} s in vain for {what} (mode {self.mode}, "
                f"{'armed' if self.armed else 'disarmed'}, last texts: {texts})"
            )

    def sleep(self, seconds: float) -> None:
        """Let simulated seconds pass."""
        self._wait(lambda: False, seconds)

    def _wait(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        start, wall = self.time_s, time.monotonic()
        limit = _WALL_MARGIN_S + 4.0 * timeout_s / min(self._speedup, 1.0)
        while not condition():
            self._alive()
            if self.time_s - start >= timeout_s and start > 0:
                return condition()
            if time.monotonic() - wall > limit:
                return False
            with self._changed:
                self._changed.wait(0.05)
        return True

    def _wait_wall(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        deadline = time.monotonic() + timeout_s
        while not condition():
            self._alive()
            if time.monotonic() > deadline:
                return False
            with self._changed:
                self._changed.wait(0.05)
        return True

    # --- flying ------------------------------------------------------------------------------

    @contextlib.contextmanager
    def fast_forward(self, speedup: float = 10.0) -> Iterator[None]:
        """Run simulated time faster for a while (SIM_SPEEDUP), as for waiting on the ground."""
        normal = self._speedup
        self._set_speed(speedup)
        try:
            yield
        finally:
            self._set_speed(normal)

    def wait_ready(self, timeout_s: float = 120.0) -> None:
        """Wait until the EKF has a position and the vehicle would arm in GUIDED."""
        self.wait(self._has_position, timeout_s, "an EKF position")
        self.set_mode("GUIDED")
        bit = mavlink.MAV_SYS_STATUS_PREARM_CHECK
        self.wait(
            lambda: bool(self.latest["SYS_STATUS"].onboard_control_sensors_health & bit),
            timeout_s,
            "the pre-arm checks",
        )
        self.read_origin()

    def _has_position(self) -> bool:
        wanted = mavlink.ESTIMATOR_POS_HORIZ_ABS | mavlink.ESTIMATOR_POS_HORIZ_REL
        return bool(self._flags & wanted) and not self._flags & mavlink.ESTIMATOR_CONST_POS_MODE

    def set_mode(self, name: str) -> None:
        """Change mode and wait until the heartbeat says so."""
        self.command(mavlink.MAV_CMD_DO_SET_MODE, 1, MODES[name])
        self.wait(lambda: self.mode == name, _SHOWN_S, f"mode {name}")

    def arm(self, timeout_s: float = 60.0) -> None:
        """Arm, asking again until the checks pass; PilotError with the refusals otherwise."""
        start_s, start_ns = self.time_s, time.monotonic_ns()
        while True:
            if self.try_command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == 0:
                break
            if self.time_s - start_s > timeout_s:
                reasons = {t.text for t in self.texts if t.time_ns > start_ns and "rm: " in t.text}
                raise PilotError(f"not armed in {timeout_s:g} s: {'; '.join(sorted(reasons))}")
            self.sleep(1.0)
        self.wait(lambda: self.armed, _SHOWN_S, "the armed heartbeat")

    def disarm(self, *, force: bool = False) -> None:
        """Disarm; `force` also in flight."""
        self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 21196.0 if force else 0.0)

    def reboot(self) -> None:
        """Reboot the autopilot (disarmed); it is another vehicle's life then: connect anew."""
        self.command(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1)

    def takeoff(self, height_m: float, timeout_s: float = 120.0) -> None:
        """Take off in GUIDED and wait for the height (above the launch place, in truth)."""
        ground = self.truth.altitude_m
        self.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, height_m)
        self.wait(
            lambda: self.truth.altitude_m > ground + height_m - 2.0,
            timeout_s,
            f"the take-off to {height_m:g} m",
        )

    def go_to(self, latitude_deg: float, longitude_deg: float, height_m: float) -> None:
        """Send the vehicle to a place at a height above home, in GUIDED; does not wait."""
        self._send(
            mavlink.MAVLink_set_position_target_global_int_message(
                0,
                _VEHICLE,
                _AUTOPILOT,
                mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
                _GUIDED_POSITION,
                round(latitude_deg * 1e7),
                round(longitude_deg * 1e7),
                height_m,
                *([0.0] * 8),
            )
        )

    def fly_to(
        self,
        latitude_deg: float,
        longitude_deg: float,
        height_m: float,
        *,
        within_m: float = 3.0,
        timeout_s: float = 120.0,
    ) -> None:
        """As `go_to`, and wait until the EKF says that the vehicle is there."""
        self.go_to(latitude_deg, longitude_deg, height_m)

        def there() -> bool:
            where = self.ekf.location if self.ekf else None
            if where is None:
                return False
            north, east, _ = where.ned_of(Location(latitude_deg, longitude_deg, 0.0))
            return math.hypot(north, east) < within_m

        self.wait(there, timeout_s, "the guided target")

    def land(self, timeout_s: float = 180.0) -> None:
        """Land and wait until the vehicle has disarmed."""
        self.set_mode("LAND")
        self.wait(lambda: not self.armed, timeout_s, "the landing")

    def gps(self, on: bool) -> None:
        """Switch the simulated receiver."""
        self.set_parameter("SIM_GPS1_ENABLE", 1.0 if on else 0.0)

    def use_source_set(self, number: int) -> None:
        """MAV_CMD_SET_EKF_SOURCE_SET."""
        self.command(mavlink.MAV_CMD_SET_EKF_SOURCE_SET, number)

    def set_origin(self, origin: Location) -> None:
        """Set the EKF origin (needed where there is no GNSS), and read back which one holds."""
        self._send(
            mavlink.MAVLink_set_gps_global_origin_message(
                _VEHICLE,
                round(origin.latitude_deg * 1e7),
                round(origin.longitude_deg * 1e7),
                round(origin.altitude_m * 1000),
            )
        )
        if not self._wait_wall(lambda: self.read_origin() is not None, 60.0):
            raise PilotError("the vehicle took no EKF origin")

    def read_origin(self) -> Location | None:
        """The EKF origin; None while there is none."""
        self.try_command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)
        return self.origin

    def point_gimbal(self, pitch_deg: float, yaw_deg: float, *, earth_yaw: bool = False) -> None:
        """MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW; yaw from the nose, or from north."""
        flags = _GIMBAL_YAW_LOCK if earth_yaw else 0.0
        self.command(
            mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW,
            pitch_deg,
            yaw_deg,
            math.nan,
            math.nan,
            flags,
        )

    # --- missions ----------------------------------------------------------------------------

    def upload_mission(self, steps: Sequence[MissionStep]) -> None:
        """Replace the vehicle's mission; the first step becomes item 1, after home."""
        home = MissionStep(mavlink.MAV_CMD_NAV_WAYPOINT)
        items = [home, *steps]
        kinds = ("MISSION_REQUEST", "MISSION_REQUEST_INT", "MISSION_ACK")
        with self._expect(*kinds) as box:
            self._send(mavlink.MAVLink_mission_count_message(_VEHICLE, _AUTOPILOT, len(items)))
            while True:
                message = self._next(box, "the mission upload")
                if message.get_type() == "MISSION_ACK":
                    if message.type != mavlink.MAV_MISSION_ACCEPTED:
                        raise PilotError(f"the mission was refused (MISSION_ACK {message.type})")
                    return
                self._send_item(message.seq, items[message.seq])

    def _send_item(self, sequence: int, step: MissionStep) -> None:
        x = step.raw_x if step.raw_x is not None else round(step.latitude_deg * 1e7)
        self._send(
            mavlink.MAVLink_mission_item_int_message(
                _VEHICLE,
                _AUTOPILOT,
                sequence,
                mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,
                step.command,
                0,
                1,
                *step.parameters,
                x,
                round(step.longitude_deg * 1e7),
                step.altitude_m,
            )
        )

    def download_mission(self) -> list[Any]:
        """The vehicle's mission as MISSION_ITEM_INT messages, home first."""
        with self._expect("MISSION_COUNT", "MISSION_ITEM_INT") as box:
            self._send(mavlink.MAVLink_mission_request_list_message(_VEHICLE, _AUTOPILOT))
            size = self._next(box, "the mission's size").count
            items = []
            for sequence in range(size):
                self._send(
                    mavlink.MAVLink_mission_request_int_message(_VEHICLE, _AUTOPILOT, sequence)
                )
                items.append(self._next(box, f"mission item {sequence}"))
        return items

    def start_mission(self) -> None:
        """Fly the uploaded mission in AUTO from its first step."""
        self.reached.clear()
        self.set_mode("AUTO")

    # --- parameters --------------------------------------------------------------------------

    def set_parameter(self, name: str, value: float) -> None:
        """Set a parameter and wait until the vehicle confirms it."""
        with self._expect("PARAM_VALUE") as box:
            for _ in range(_TRIES):
                self._send(
                    mavlink.MAVLink_param_set_message(
                        _VEHICLE, _AUTOPILOT, name.encode(), value, mavlink.MAV_PARAM_TYPE_REAL32
                    )
                )
                if self._parameter_from(box, name) is not None:
                    return
        raise PilotError(f"the vehicle did not confirm {name} = {value:g}; does it know it?")

    def parameter(self, name: str, tries: int = _TRIES) -> float:
        """Read a parameter, asking so many times: a vehicle does not answer for one it lacks."""
        with self._expect("PARAM_VALUE") as box:
            for _ in range(tries):
                self._send(
                    mavlink.MAVLink_param_request_read_message(
                        _VEHICLE, _AUTOPILOT, name.encode(), -1
                    )
                )
                value = self._parameter_from(box, name)
                if value is not None:
                    return value
        raise PilotError(f"the vehicle has no parameter {name}")

    def _parameter_from(self, box: queue.SimpleQueue[Any], name: str) -> float | None:
        answer = self._answer(box, lambda m: bool(m.param_id == name))
        return None if answer is None else float(answer.param_value)

    def _answer(self, box: queue.SimpleQueue[Any], fits: Callable[[Any], bool]) -> Any | None:
        """The first message that fits; None after `_REPEAT_S`."""
        self._alive()
        deadline = time.monotonic() + _REPEAT_S
        while (left := deadline - time.monotonic()) > 0:
            with contextlib.suppress(queue.Empty):
                message = box.get(timeout=left)
                if fits(message):
                    return message
        return None

    def _set_speed(self, speedup: float) -> None:
        self.set_parameter("SIM_SPEEDUP", speedup)
        self._speedup = speedup
        self._clock.restart(speedup)

    # --- commands ----------------------------------------------------------------------------

    def command(self, number: int, *parameters: float) -> None:
        """COMMAND_LONG; PilotError unless it is accepted."""
        started = time.monotonic_ns()
        result = self.try_command(number, *parameters)
        if result != mavlink.MAV_RESULT_ACCEPTED:
            texts = "; ".join(t.text for t in self.texts if t.time_ns > started)
            raise PilotError(f"command {number} was refused (MAV_RESULT {result}): {texts}")

    def try_command(self, number: int, *parameters: float) -> int | None:
        """COMMAND_LONG; its MAV_RESULT, or None without an answer."""
        filled = [*parameters, *([0.0] * (7 - len(parameters)))]
        with self._expect("COMMAND_ACK") as box:
            for attempt in range(_TRIES):
                self._send(
                    mavlink.MAVLink_command_long_message(
                        _VEHICLE, _AUTOPILOT, number, attempt, *filled
                    )
                )
                answer = self._answer(box, lambda m: bool(m.command == number))
                if answer is not None:
                    return int(answer.result)
        return None

    def _request_stream(self, message_id: int, hertz: float) -> None:
        self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, 1e6 / hertz)

    @contextlib.contextmanager
    def _expect(self, *kinds: str) -> Iterator[queue.SimpleQueue[Any]]:
        """A box that receives the autopilot's messages of some kinds from now on."""
        box: queue.SimpleQueue[Any] = queue.SimpleQueue()
        entry = (frozenset(kinds), box)
        self._boxes = [*self._boxes, entry]
        try:
            yield box
        finally:
            self._boxes = [e for e in self._boxes if e is not entry]

    def _next(self, box: queue.SimpleQueue[Any], what: str) -> Any:
        try:
            return box.get(timeout=_TRIES * _REPEAT_S)
        except queue.Empty:
            self._alive()
            raise PilotError(f"the vehicle was silent during {what}") from None

    def _send(self, message: Any) -> None:
        with self._send_lock:
            self._link.mav.send(message)

    # --- the reading thread ------------------------------------------------------------------

    def _read(self) -> None:
        next_heartbeat = 0.0
        while not self._stop.is_set():
            now = time.monotonic()
            if now >= next_heartbeat:
                next_heartbeat = now + _HEARTBEAT_S
                self._beat()
            try:
                messages = self._receive()
            except OSError:  # the socket is being closed, or the vehicle died
                if not self._stop.is_set():
                    time.sleep(0.05)
                continue
            for message in messages:
                self._take(message, time.monotonic_ns())
            if messages:
                with self._changed:
                    self._changed.notify_all()

    def _receive(self) -> list[Any]:
        """What has come, after waiting for up to 0.1 s."""
        port = self._link.port
        if port.fileno() < 0 or not select.select([port], [], [], 0.1)[0]:
            return []
        if not port.recv(1, socket.MSG_PEEK):
            time.sleep(0.05)  # closed by the vehicle; pymavlink would report that in a tight loop
            return []
        messages = []
        while (message := self._link.recv_msg()) is not None:
            messages.append(message)
        return messages

    def _beat(self) -> None:
        with contextlib.suppress(OSError):
            self._send(
                mavlink.MAVLink_heartbeat_message(
                    mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3
                )
            )

    def _take(self, message: Any, received_ns: int) -> None:
        kind = message.get_type()
        if kind == "STATUSTEXT":
            self.texts.append(
                StatusText(received_ns, message.severity, message.text, message.get_srcComponent())
            )
        if message.get_srcSystem() != _VEHICLE or message.get_srcComponent() != _AUTOPILOT:
            return
        self.latest[kind] = message
        for kinds, box in self._boxes:
            if kind in kinds:
                box.put(message)
        handler = _HANDLERS.get(kind)
        if handler is not None:
            handler(self, message, received_ns)

    def _take_heartbeat(self, message: Any, _received_ns: int) -> None:
        self.mode = _MODE_NAMES.get(message.custom_mode, str(message.custom_mode))
        self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)

    def _take_attitude(self, message: Any, received_ns: int) -> None:
        self._boot_ms = self._attitude_ms = message.time_boot_ms
        self._clock.observe(message.time_boot_ms, received_ns)

    def _take_sim_state(self, message: Any, _received_ns: int) -> None:
        # SIM_STATE has no time stamp; the ATTITUDE streamed just before it does.
        if self._attitude_ms is None:
            return
        truth = Truth(
            self._clock.monotonic_ns(self._attitude_ms),
            self._attitude_ms / 1000.0,
            message.lat_int / 1e7,
            message.lon_int / 1e7,
            message.alt,
            np.array([message.q1, message.q2, message.q3, message.q4]),
            np.array([message.vn, message.ve, message.vd]),
        )
        self._truth.add(truth)
        for callback in self._subscribers:
            callback(truth)

    def _take_gimbal(self, message: Any, _received_ns: int) -> None:
        self._gimbal.add(
            GimbalState(
                self._clock.monotonic_ns(message.time_boot_ms),
                np.array(message.q, dtype=np.float64),
                message.flags,
            )
        )

    def _take_position(self, message: Any, _received_ns: int) -> None:
        self._ekf.add(
            EkfSample(
                self._clock.monotonic_ns(message.time_boot_ms),
                message.time_boot_ms / 1000.0,
                (message.x, message.y, message.z),
                (message.vx, message.vy, message.vz),
                self.origin,
                self._flags,
            )
        )

    def _take_ekf(self, message: Any, _received_ns: int) -> None:
        self._flags = message.flags

    def _take_origin(self, message: Any, _received_ns: int) -> None:
        self.origin = Location(
            message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1000.0
        )

    def _take_reached(self, message: Any, _received_ns: int) -> None:
        self.reached.append(message.seq)


_HANDLERS: dict[str, Callable[[Pilot, Any, int], None]] = {
    "HEARTBEAT": Pilot._take_heartbeat,
    "ATTITUDE": Pilot._take_attitude,
    "SIM_STATE": Pilot._take_sim_state,
    "GIMBAL_DEVICE_ATTITUDE_STATUS": Pilot._take_gimbal,
    "LOCAL_POSITION_NED": Pilot._take_position,
    "EKF_STATUS_REPORT": Pilot._take_ekf,
    "GPS_GLOBAL_ORIGIN": Pilot._take_origin,
    "MISSION_ITEM_REACHED": Pilot._take_reached,
}


def _share(before_ns: int, after_ns: int, time_ns: int) -> float:
    return (time_ns - before_ns) / (after_ns - before_ns) if after_ns > before_ns else 0.0


def _slerp(a: Array, b: Array, t: float) -> Array:
    """Between two unit quaternions that are close (20 ms apart): normalised linear is exact to
    far below sensor noise.
    """
    if float(a @ b) < 0:
        b = -b
    q = a + t * (b - a)
    return np.asarray(q / np.linalg.norm(q))
