"""Histories of telemetry over seconds, interpolated between samples."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import deque
from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

from mavlink_bridge import quaternion as quat
from mavlink_bridge.messages import Attitude, InertialSample
from mavlink_bridge.vehicle.origin import wrap_degrees

_LENGTH = 512
MAX_GAP_NS = 500_000_000
_MAX_EXTRAPOLATION_NS = 100_000_000
_GIMBAL_FALLBACK_NS = 1_000_000_000
_GIMBAL_GONE_NS = 3_000_000_000
_MOST_OTHERS = 8
_LONGEST_NS = 1 << 62  # no gap is longer

# Best first: a poorer source is only used while no better one speaks.
GIMBAL_SOURCES = ("GIMBAL_DEVICE_ATTITUDE_STATUS", "MOUNT_ORIENTATION", "MOUNT_STATUS")


class TimedValue(Protocol):
    """A value with the time at which it was valid."""

    @property
    def time_ns(self) -> int:
        """CLOCK_MONOTONIC, ns."""


_Sample = TypeVar("_Sample", bound=TimedValue)


@dataclass(frozen=True)
class VectorSample:
    """Numbers that were valid at a time."""

    time_ns: int
    values: tuple[float, ...]


@dataclass(frozen=True)
class GimbalSample:
    """Attitude of the gimbal's housing in one message: to NED, or to the horizontal frame of the
    vehicle's nose.

    earth_frame: whether yaw counts from true north; otherwise from the vehicle's heading. source:
    name of the message. device: component and gimbal_device_id of the sender.
    """

    time_ns: int
    quaternion: quat.Quaternion
    earth_frame: bool
    source: str
    device: tuple[int, int] = (0, 0)


def attitude(
    time_ns: int, q: quat.Quaternion, rates: quat.Vector, gyro_heading_rad: float = 0.0
) -> Attitude:
    """Make an `Attitude` from a quaternion (body to NED) and body rates (rad/s)."""
    return Attitude(time_ns, *quat.to_euler(q), q, rates, gyro_heading_rad)


def heading_rate(sample: Attitude) -> float:
    """Rate of the heading, rad/s, clockwise positive, from body rates and attitude."""
    _, q, r = sample.rates
    cos_pitch = max(math.cos(sample.pitch_rad), 0.1)
    return (q * math.sin(sample.roll_rad) + r * math.cos(sample.roll_rad)) / cos_pitch


class _Buffer(Generic[_Sample]):
    """History of samples in time order."""

    def __init__(self) -> None:
        self._samples: deque[_Sample] = deque(maxlen=_LENGTH)

    def clear(self) -> None:
        """Empty the buffer."""
        self._samples.clear()

    def add(self, sample: _Sample) -> None:
        """Append; a sample that is not newer than the newest is dropped."""
        if not self._samples or sample.time_ns > self._samples[-1].time_ns:
            self._samples.append(sample)

    @property
    def _newest(self) -> _Sample | None:
        return self._samples[-1] if self._samples else None

    def _around(self, time_ns: int, gap_ns: int) -> tuple[_Sample, _Sample, float] | None:
        """The samples before and after a time, and its share of the interval; None outside the
        buffer or in a gap of more than gap_ns.
        """
        samples = list(self._samples)
        if not samples or not samples[0].time_ns <= time_ns <= samples[-1].time_ns:
            return None
        index = bisect_left(samples, time_ns, key=lambda sample: sample.time_ns)
        before, after = samples[max(index - 1, 0)], samples[index]
        span = after.time_ns - before.time_ns
        if span > gap_ns:
            return None
        return before, after, (time_ns - before.time_ns) / span if span else 1.0


class VectorBuffer(_Buffer[VectorSample]):
    """History of vectors such as positions, with linear interpolation."""

    def at(self, time_ns: int) -> tuple[float, ...] | None:
        """Values interpolated at a time; None outside the buffer or in a gap of more than 0.5 s."""
        found = self._around(time_ns, MAX_GAP_NS)
        return None if found is None else self._between(found[0].values, found[1].values, found[2])

    def _between(self, a: tuple[float, ...], b: tuple[float, ...], t: float) -> tuple[float, ...]:
        return tuple(x + t * (y - x) for x, y in zip(a, b, strict=True))


class PlaceBuffer(VectorBuffer):
    """History of latitude, longitude (degrees) and altitude; interpolates across the date line."""

    def _between(self, a: tuple[float, ...], b: tuple[float, ...], t: float) -> tuple[float, ...]:
        near = a[1] + wrap_degrees(b[1] - a[1])
        latitude, longitude, altitude = super()._between(a, (b[0], near, b[2]), t)
        return latitude, wrap_degrees(longitude), altitude


class ZoomBuffer(_Buffer[VectorSample]):
    """Zoom levels (0 to 100 %) of the camera component that first reported one."""

    _component: int | None = None

    def clear(self) -> None:
        """Empty the buffer; the camera that reports next is then used."""
        super().clear()
        self._component = None

    def add_level(self, time_ns: int, component: int, level: float) -> None:
        """Append a level; NaN: the camera does not know it. Ignored from another component."""
        if self._component is None:
            self._component = component
        if component == self._component:
            self.add(VectorSample(time_ns, (level,)))

    def at(self, time_ns: int, hold_s: float) -> float | None:
        """The level at a time, linear between reports; None if unknown. The newest report is valid
        for hold_s, but only for 0.5 s while the level changes.
        """
        hold_ns, samples = round(1e9 * hold_s), list(self._samples)  # another thread appends
        if samples and time_ns > samples[-1].time_ns:
            newest = samples[-1]
            held_ns = MAX_GAP_NS if samples[-2:][0].values != newest.values else hold_ns
            level = newest.values[0] if time_ns - newest.time_ns <= held_ns else math.nan
            return level if math.isfinite(level) else None
        found = self._around(time_ns, _LONGEST_NS)
        if found is None:
            return None
        before, after, t = found
        if before.values != after.values and after.time_ns - before.time_ns > hold_ns:
            return None  # it changed at some time between the two
        level = before.values[0] + t * (after.values[0] - before.values[0])
        return level if math.isfinite(level) else None


class AttitudeBuffer(_Buffer[Attitude]):
    """History of attitudes with spherical interpolation."""

    def add(self, sample: Attitude) -> None:
        """Append, with its gyro heading integrated; one that is not newer is dropped."""
        if self._samples:
            last = self._samples[-1]
            dt = (sample.time_ns - last.time_ns) * 1e-9
            if dt <= 0.0:
                return
            turned = 0.5 * (heading_rate(last) + heading_rate(sample)) * dt
            if dt > MAX_GAP_NS * 1e-9:
                # What the gyros did in a gap is unknown; the estimator's yaw went through it.
                turned = quat.wrap_pi(sample.yaw_rad - last.yaw_rad)
            sample = replace(sample, gyro_heading_rad=last.gyro_heading_rad + turned)
        self._samples.append(sample)

    def at(self, time_ns: int) -> Attitude | None:
        """Attitude at a time; None outside the buffer or in a gap of more than 0.5 s.

        Up to 0.1 s after the newest sample, that is rotated on at its rates.
        """
        newest = self._newest
        if newest is not None and time_ns >= newest.time_ns:
            ahead = time_ns - newest.time_ns
            if ahead > _MAX_EXTRAPOLATION_NS:
                return None
            seconds = ahead * 1e-9
            q = quat.rotated(newest.quaternion, newest.rates, seconds)
            heading = newest.gyro_heading_rad + heading_rate(newest) * seconds
            return attitude(time_ns, q, newest.rates, heading)
        found = self._around(time_ns, MAX_GAP_NS)
        if found is None:
            return None
        before, after, t = found
        q = quat.slerp(before.quaternion, after.quaternion, t)
        heading = before.gyro_heading_rad + t * (after.gyro_heading_rad - before.gyro_heading_rad)
        return attitude(time_ns, q, after.rates if t > 0.5 else before.rates, heading)


class InertialBuffer(_Buffer[InertialSample]):
    """History of IMU samples in time order."""

    def since(self, time_ns: int) -> tuple[InertialSample, ...]:
        """The samples after a time, oldest first."""
        samples = list(self._samples)
        return tuple(samples[bisect_right(samples, time_ns, key=lambda s: s.time_ns) :])


class GimbalBuffer(_Buffer[GimbalSample]):
    """History of one gimbal's attitude, from the best source available.

    It uses the first gimbal that sends, as long as it sends, because mixed angles of two gimbals
    are wrong. device: the (component, gimbal_device_id) to use, 0 for any. others: the other
    gimbals that have sent, at most eight.
    """

    def __init__(self, device: tuple[int, int] = (0, 0)) -> None:
        super().__init__()
        self._wanted = device
        self.others: set[tuple[int, int]] = set()

    @property
    def device(self) -> tuple[int, int] | None:
        """Component and device id of the gimbal that is used; None before the first."""
        return self._samples[-1].device if self._samples else None

    def add(self, sample: GimbalSample) -> None:
        """Append, unless a better source (1 s) or the selected gimbal (3 s) has reported lately."""
        if not self._is_wanted(sample.device):
            self._add_other(sample.device)
            return
        if self._samples:
            newest = self._samples[-1]
            if sample.source == newest.source and sample.device != newest.device:
                self._add_other(sample.device)
                if sample.time_ns - newest.time_ns < _GIMBAL_GONE_NS:
                    return
                self._samples.clear()
                self._samples.append(sample)
                return
            rank = GIMBAL_SOURCES.index(sample.source)
            worse = rank > GIMBAL_SOURCES.index(newest.source)
            age = sample.time_ns - newest.time_ns
            if age <= 0 or (worse and age < _GIMBAL_FALLBACK_NS):
                return
            if sample.source != newest.source or sample.earth_frame != newest.earth_frame:
                # Angles of two frames cannot be interpolated.
                self._samples.clear()
        self._samples.append(sample)

    def _add_other(self, device: tuple[int, int]) -> None:
        if len(self.others) < _MOST_OTHERS:
            self.others.add(device)

    def _is_wanted(self, device: tuple[int, int]) -> bool:
        pairs = zip(self._wanted, device, strict=True)
        return all(wanted in (0, given) for wanted, given in pairs)

    def at(self, time_ns: int) -> GimbalSample | None:
        """Attitude interpolated at a time; the newest is valid for 0.5 s. None if unknown."""
        newest = self._newest
        if newest is not None and time_ns >= newest.time_ns:
            return newest if time_ns - newest.time_ns <= MAX_GAP_NS else None
        found = self._around(time_ns, 2 * MAX_GAP_NS)
        if found is None:
            return None
        before, after, t = found
        q = quat.slerp(before.quaternion, after.quaternion, t)
        return replace(before, time_ns=time_ns, quaternion=q)
