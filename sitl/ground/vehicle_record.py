"""Records what the vehicle reports: newest state, and time series since the connection."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.embedded.control.mode import Mode
from sitl.embedded.control.px4_modes import NUMBERS, custom_mode
from sitl.errors import PilotError
from sitl.geodesy import Location
from sitl.ground.tracks import (
    EkfSample,
    GimbalState,
    LeastLatencyClock,
    SampleTrack,
    Truth,
    fraction,
    interpolate,
    slerp,
)


@dataclass(frozen=True)
class StatusText:
    """A status text of any component, as far as its chunks have arrived."""

    time_ns: int
    severity: int
    text: str
    component: int


class TextLog:
    """Status texts in order of their first chunks; one thread fills it, any may read `lines`.

    A missing chunk is shown as three dots. An id may be used again for another text.
    """

    def __init__(self) -> None:
        self.lines: list[StatusText] = []
        self._open: dict[tuple[int, int], tuple[int, int, int]] = {}

    def add(self, message: Any, received_ns: int) -> None:
        """Add one STATUSTEXT: a new text, or the next chunk of one that is not complete."""
        source = (message.get_srcSystem(), message.get_srcComponent())
        number, chunk = message.id, message.chunk_seq
        line = StatusText(received_ns, message.severity, message.text, source[1])
        open_id, place, expected = self._open.get(source, (0, 0, 0))
        if number and number == open_id and chunk >= expected:
            gap = "..." if chunk > expected else ""
            begun = self.lines[place]
            self.lines[place] = replace(begun, text=begun.text + gap + line.text)
        else:
            place = len(self.lines)
            self.lines.append(replace(line, text="..." + line.text) if chunk else line)
        self._open[source] = (number, place, chunk + 1)


VEHICLE, AUTOPILOT = 1, 1  # system and component
_SECONDS_KEPT = 60 * 60

MODES = {mode.name: int(mode) for mode in Mode} | {"LOITER": 5}
_MODE_NAMES = {number: name for name, number in MODES.items()}
# PX4's main and sub mode under the names of ArduPilot's that do the same; GUIDED: Hold.
PX4_MODES = {mode.name: numbers for mode, numbers in NUMBERS.items()}
_PX4_MODE_NAMES = {custom_mode(mode): mode.name for mode in NUMBERS}


def from_autopilot(message: Any) -> bool:
    """Whether a message is from the vehicle's autopilot and not another component."""
    return bool(message.get_srcSystem() == VEHICLE and message.get_srcComponent() == AUTOPILOT)


class VehicleRecord:
    """Stores a vehicle's messages; one thread writes, any thread reads.

    latest: the autopilot's newest message of each type; ekf_flags: EKF_STATUS_FLAGS; reached: the
    mission items reached, in order; origin: the EKF's origin; mode: None before the first
    heartbeat; is_px4: known from the first heartbeat.
    """

    def __init__(self, speedup: float) -> None:
        self._clock = LeastLatencyClock(speedup)
        self._boot_ms = 0
        self._attitude_ms: int | None = None
        self.ekf_flags = 0
        self._truth: SampleTrack[Truth] = SampleTrack(_SECONDS_KEPT * 50)
        self._gimbal: SampleTrack[GimbalState] = SampleTrack(_SECONDS_KEPT * 50)
        self._ekf: SampleTrack[EkfSample] = SampleTrack(_SECONDS_KEPT * 25)
        self.origin: Location | None = None
        self.latest: dict[str, Any] = {}
        self._text_log = TextLog()
        self.reached: list[int] = []
        self.mode: str | None = None
        self.is_px4 = False
        self.armed = False
        self._handlers: dict[str, Callable[[Any, int], None]] = {
            "HEARTBEAT": self._take_heartbeat,
            "ATTITUDE": self._take_attitude,
            "SIM_STATE": self._take_sim_state,
            "GIMBAL_DEVICE_ATTITUDE_STATUS": self._take_gimbal,
            "LOCAL_POSITION_NED": self._take_position,
            "EKF_STATUS_REPORT": self._take_ekf,
            "ESTIMATOR_STATUS": self._take_ekf,
            "GPS_GLOBAL_ORIGIN": self._take_origin,
            "MISSION_ITEM_REACHED": self._take_reached,
        }

    # --- what is known -----------------------------------------------------------------------

    @property
    def texts(self) -> list[StatusText]:
        """The status texts of every component, oldest first."""
        return self._text_log.lines

    @property
    def time_s(self) -> float:
        """Simulated seconds since the vehicle's boot."""
        return self._boot_ms / 1000.0

    @property
    def truth(self) -> Truth:
        """The newest true state. `PilotError` if none was received."""
        newest = self._truth.newest
        if newest is None:
            raise PilotError("no truth has been received: connect first")
        return newest

    @property
    def ekf(self) -> EkfSample | None:
        """The newest position that the EKF reports; None while it reports none."""
        return self._ekf.newest

    def truth_at(self, time_ns: int) -> Truth | None:
        """The true state at a CLOCK_MONOTONIC time, interpolated; None outside the record."""
        pair = self._truth.neighbours(time_ns)
        if pair is None:
            return None
        return interpolate(*pair, time_ns)

    def gimbal_at(self, time_ns: int) -> GimbalState | None:
        """The gimbal at a CLOCK_MONOTONIC time, interpolated; None outside the record."""
        pair = self._gimbal.neighbours(time_ns)
        if pair is None:
            return None
        a, b = pair
        t = fraction(a.time_ns, b.time_ns, time_ns)
        return GimbalState(time_ns, slerp(a.quaternion, b.quaternion, t), b.flags)

    def newest_common_ns(self) -> int | None:
        """The newest time at which both true state and gimbal are known; None without it."""
        truth, gimbal = self._truth.newest, self._gimbal.newest
        return min(truth.time_ns, gimbal.time_ns) if truth and gimbal else None

    def ekf_pairs(self) -> Iterator[tuple[EkfSample, Location]]:
        """Yield every reported EKF position with the true location at the same time."""
        # Paired by the vehicle's own clock: CLOCK_MONOTONIC stamps move when simulated time stalls.
        truth = self._truth.samples()
        times = np.array([t.boot_s for t in truth])
        for sample in self._ekf.samples():
            i = int(np.searchsorted(times, sample.boot_s))
            if sample.location is None or not 0 < i < len(times):
                continue
            a, b = truth[i - 1].location, truth[i].location
            t = (sample.boot_s - times[i - 1]) / (times[i] - times[i - 1])
            leg = a.ned_of(b)
            yield sample, a.offset(t * leg[0], t * leg[1], t * leg[2])

    # --- messages ----------------------------------------------------------------------------

    def restart_clock(self, speedup: float) -> None:
        """Reset the clock after a change of the speed of simulated time."""
        self._clock.restart(speedup)

    def add(self, message: Any, received_ns: int) -> None:
        """Store a message received at a CLOCK_MONOTONIC time."""
        kind = message.get_type()
        if kind == "STATUSTEXT":
            self._text_log.add(message, received_ns)
        if not from_autopilot(message):
            return
        self.latest[kind] = message
        handler = self._handlers.get(kind)
        if handler is not None:
            handler(message, received_ns)

    def _take_heartbeat(self, message: Any, _received_ns: int) -> None:
        self.is_px4 = message.autopilot == mavlink.MAV_AUTOPILOT_PX4
        names = _PX4_MODE_NAMES if self.is_px4 else _MODE_NAMES
        self.mode = names.get(message.custom_mode, str(message.custom_mode))
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
                self.origin,
            )
        )

    def _take_ekf(self, message: Any, _received_ns: int) -> None:
        self.ekf_flags = message.flags

    def _take_origin(self, message: Any, _received_ns: int) -> None:
        self.origin = Location(
            message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1000.0
        )

    def _take_reached(self, message: Any, _received_ns: int) -> None:
        self.reached.append(message.seq)
