"""Time series of a vehicle: true states, gimbal angles and EKF positions.

Sample times are CLOCK_MONOTONIC; seconds since boot are simulated seconds.
"""

from __future__ import annotations

import bisect
import threading
from collections import deque
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.embedded.physics.rotation import euler
from sitl.geodesy import Location

Array = NDArray[np.float64]

_CLOCK_WINDOW = 25  # samples over which the least latency is taken


class TimedSample(Protocol):
    """A sample with a time on CLOCK_MONOTONIC."""

    @property
    def time_ns(self) -> int:
        """CLOCK_MONOTONIC time of the sample."""


_Sample = TypeVar("_Sample", bound=TimedSample)


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
        """Whether the yaw is from the nose, by the YAW_IN_* flags or else by YAW_LOCK."""
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
    """LOCAL_POSITION_NED with EKF origin (None: not set); times as in `Truth`."""

    time_ns: int
    boot_s: float
    position_ned: tuple[float, float, float]
    origin: Location | None

    @property
    def location(self) -> Location | None:
        """The location that the EKF reports; None without an origin."""
        return self.origin.offset(*self.position_ned) if self.origin else None


class LeastLatencyClock:
    """Converts the vehicle's boot time to CLOCK_MONOTONIC by the smallest recent latency."""

    def __init__(self, speedup: float) -> None:
        self._scale = 1e6 / speedup  # ns of wall time per ms of simulated time
        self._offsets: deque[float] = deque(maxlen=_CLOCK_WINDOW)

    def restart(self, speedup: float) -> None:
        """Reset after a change of the speed of simulated time."""
        self._scale = 1e6 / speedup
        self._offsets.clear()

    def observe(self, boot_ms: int, received_ns: int) -> None:
        """Learn from a message of boot time boot_ms that arrived at received_ns."""
        self._offsets.append(received_ns - boot_ms * self._scale)

    def monotonic_ns(self, boot_ms: int) -> int:
        """CLOCK_MONOTONIC at a boot time, once `observe` was called."""
        return round(boot_ms * self._scale + min(self._offsets, default=0.0))


class SampleTrack(Generic[_Sample]):
    """Samples in time order for one writing and many reading threads. It keeps the newest `limit`
    to 2 `limit` of them.
    """

    def __init__(self, limit: int) -> None:
        self._lock = threading.Lock()
        self._times: list[int] = []
        self._samples: list[_Sample] = []
        self._limit = limit

    def add(self, sample: _Sample) -> None:
        """Append a sample; one that is not newer than the last is dropped."""
        with self._lock:
            if self._times and sample.time_ns <= self._times[-1]:
                return
            self._times.append(sample.time_ns)
            self._samples.append(sample)
            if len(self._times) > 2 * self._limit:
                del self._times[: self._limit]
                del self._samples[: self._limit]

    def neighbours(self, time_ns: int) -> tuple[_Sample, _Sample] | None:
        """The samples before and after a time, for interpolation; None outside the track."""
        with self._lock:
            i = bisect.bisect_left(self._times, time_ns)
            if i == len(self._times) or (i == 0 and self._times[0] != time_ns):
                return None
            return self._samples[max(i - 1, 0)], self._samples[i]

    def samples(self) -> list[_Sample]:
        """A copy of the track."""
        with self._lock:
            return list(self._samples)

    @property
    def newest(self) -> _Sample | None:
        """The last sample; None without samples."""
        with self._lock:
            return self._samples[-1] if self._samples else None


def fraction(before_ns: int, after_ns: int, time_ns: int) -> float:
    """Position of a time between two others as a fraction, 0 to 1."""
    return (time_ns - before_ns) / (after_ns - before_ns) if after_ns > before_ns else 0.0


def slerp(a: Array, b: Array, t: float) -> Array:
    """Interpolate between close unit quaternions a (t = 0) and b (t = 1), 20 ms apart: normalised
    linear interpolation, whose error is far below sensor noise.
    """
    if float(a @ b) < 0:
        b = -b
    q = a + t * (b - a)
    return np.asarray(q / np.linalg.norm(q))


def interpolate(a: Truth, b: Truth, time_ns: int) -> Truth:
    """The true state at time_ns, interpolated linearly between a and b."""
    t = fraction(a.time_ns, b.time_ns, time_ns)
    return Truth(
        time_ns,
        a.boot_s + t * (b.boot_s - a.boot_s),
        a.latitude_deg + t * (b.latitude_deg - a.latitude_deg),
        a.longitude_deg + t * (b.longitude_deg - a.longitude_deg),
        a.altitude_m + t * (b.altitude_m - a.altitude_m),
        slerp(a.quaternion, b.quaternion, t),
        a.velocity_ned + t * (b.velocity_ned - a.velocity_ned),
    )
