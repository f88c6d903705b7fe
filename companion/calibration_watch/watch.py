"""The calibration watch: observations in, estimates out. No threads and no clock."""

from __future__ import annotations

import copy
import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.calibration_watch.observation import (
    AutopilotObservation,
    CalibrationEstimate,
    CalibrationObservation,
)
from companion.calibration_watch.position_filter import AXES, AttitudeFilter, PositionFilter
from companion.geometry import GIMBAL_FROM_CAMERA
from companion.inertial import InertialDisplacement, InertialTrack
from localizer.geometry.pose import matrix_from_quaternion, so3_log
from mavlink_bridge.alerts.words import CalibrationError
from mavlink_bridge.bridge import Bridge
from mavlink_bridge.messages import GimbalAttitude, VehicleState
from mavlink_bridge.vehicle.origin import north_east

Array = NDArray[np.float64]
# A value above its limit and four of its sigmas raises an alert and inhibits injection.
FOCAL_SHARE = 0.025  # focal length error
BORESIGHT_DEG = 3.0  # boresight error against gimbal and autopilot
TIME_S = 0.08  # time offset
_WAITS_NS = 700_000_000  # until what the vehicle says of the exposure is there
_GAP_S = 3.0
_RATE_NS = 100_000_000  # to both sides of an exposure, for the turn rate
_QUEUE = 64
_HISTORY = 64
_STALE_NS = 1_500_000_000
_FROM_GNSS_M = 3.0  # an EKF farther from the receiver follows something else
_LOW_M = 10.0  # above ground; the first metres show neither focal length nor place
_SPEAKS_AGAINST = 1.5  # sigmas between two accounts of one lateness, of which only one is sure
_KEEPS_NS, _KEPT = 1_000_000_000, 20  # what was known at earlier times


@dataclass(frozen=True)
class CalibrationFigures:
    """The current estimates. focal: relative error, positive: too long; late_s: delay of the
    timestamps, from the more certain of two filters; boresight_deg: the largest angle, about
    `axis`.
    """

    focal: CalibrationEstimate
    late_s: CalibrationEstimate
    boresight_deg: CalibrationEstimate
    axis: CalibrationError


@dataclass(frozen=True)
class _Known:
    """Saved state of the filters, to restore later."""

    time_ns: int
    position: PositionFilter
    attitude: AttitudeFilter


class CalibrationWatch:
    """Estimates calibration errors; one thread. Call `add`, then `step`."""

    def __init__(self) -> None:
        self._position, self._attitude = PositionFilter(), AttitudeFilter()
        self._waiting: deque[CalibrationObservation] = deque(maxlen=_QUEUE)
        self._last: InertialDisplacement | None = None
        self._last_ns = 0
        self._restarts = 0
        self._anchor: tuple[float, float] | None = None
        self._gnss_heights = _History()
        self._pressures = _History()
        self._depth_m = 0.0
        self._fixed = self._on_gnss = False
        self._kept: deque[_Known] = deque(maxlen=_KEPT)
        self._doubted_ns: int | None = None

    def add(self, observation: CalibrationObservation) -> None:
        """Queue a registered frame that was accepted against the map, for `step`."""
        self._waiting.append(observation)

    def exclude_since(self, since_ns: int) -> None:
        """Exclude frames from since_ns on, because they are frozen or repeated, and undo what the
        filters learned from them. Call it as long as this lasts.
        """
        self._waiting = deque((s for s in self._waiting if s.time_ns <= since_ns), _QUEUE)
        if self._last_ns <= since_ns:
            return
        while self._kept and self._kept[-1].time_ns > since_ns:
            self._kept.pop()
        known = _Known(0, PositionFilter(), AttitudeFilter())
        known = copy.deepcopy(self._kept[-1]) if self._kept else known
        self._position, self._attitude = known.position, known.attitude
        self._last, self._last_ns = None, since_ns

    def suspect_timestamps(self, since_ns: int) -> None:
        """Discard the estimated time offset: timestamps may have changed at since_ns. It is unknown
        until frames from then on are processed.
        """
        self._doubted_ns = since_ns

    def step(self, now_ns: int, vehicle: Bridge, track: InertialTrack) -> None:
        """Process the observations that are 0.7 s old, when the autopilot's data of their time is
        there; called a few times a second. track: already integrated (`InertialTrack.follow`).
        """
        state = vehicle.state()
        gnss_m = state.gps_height_m if state.gps_height_m is not None else state.gps_altitude_amsl_m
        if state.gps_fix_type >= 3:
            self._gnss_heights.add(state.gps_time_ns, gnss_m)
        self._pressures.add(state.pressure_time_ns, state.pressure_altitude_m)
        while self._waiting and now_ns - self._waiting[0].time_ns >= _WAITS_NS:
            seen = self._waiting.popleft()
            if seen.time_ns > self._last_ns and seen.depth_m >= _LOW_M:
                self._take(seen, state, vehicle, track)

    def figures(self) -> CalibrationFigures:
        """The current estimates; unknown ones have a large or infinite sigma."""
        angles = self._attitude.boresight_rad
        worst = max(range(3), key=lambda i: abs(angles[i].value) / max(angles[i].sigma, 1e-6))
        angle, late = angles[worst], self._lateness()
        # An EKF that follows late positions turns its own heading away (5 degrees in 8 s at 10 m/s,
        # ArduPilot): then nobody can tell whether the camera is off, or the EKF.
        sigma = (
            math.inf if not self._on_gnss and _is_significant(late) else math.degrees(angle.sigma)
        )
        boresight = CalibrationEstimate(math.degrees(angle.value), sigma)
        return CalibrationFigures(self._position.focal, late, boresight, AXES[worst])

    def position_error_m(self, speed_mps: float, *, focal: bool, time: bool) -> float:
        """Position error, m, caused by the estimated focal length error (if `focal`) at the newest
        frame's depth, and by the estimated time offset (if `time`) at this speed.
        """
        focal_m = abs(self._position.focal.value) * self._depth_m if focal else 0.0
        return focal_m + (abs(self._lateness().value) * speed_mps if time else 0.0)

    def _lateness(self) -> CalibrationEstimate:
        """Time offset from the motion over ground; that from the camera's rotation is used only if
        it agrees.

        The angles of a gimbal may be late themselves. A camera without gimbal rotates with the
        autopilot's own attitude. There the more certain of both estimates is used, if the other one
        does not contradict it.
        """
        if self._doubted_ns is not None:
            return CalibrationEstimate(0.0, math.inf)
        way, turns = self._position.late_s, self._attitude.late_s
        if not self._fixed:
            return _fused(way, turns) if _is_significant(way) and _agree(way, turns) else way
        surer, other = (way, turns) if way.sigma <= turns.sigma else (turns, way)
        # The autopilot's own attitude may lag, too: then the turns are sure of a time that the way
        # over ground does not have, long before the way is sure of its own.
        contradicted = other.is_within(TIME_S) or not _agree(surer, other, _SPEAKS_AGAINST)
        return (
            CalibrationEstimate(0.0, math.inf) if surer.exceeds(TIME_S) and contradicted else surer
        )

    def _take(
        self,
        seen: CalibrationObservation,
        state: VehicleState,
        vehicle: Bridge,
        track: InertialTrack,
    ) -> None:
        gap_s = (seen.time_ns - self._last_ns) * 1e-9
        self._last_ns = seen.time_ns
        self._depth_m = seen.depth_m
        if self._doubted_ns is not None and seen.time_ns >= self._doubted_ns:
            self._doubted_ns = None
            for kept in (_Known(0, self._position, self._attitude), *self._kept):
                kept.position.forget_time_offset()
                kept.attitude.forget_time_offset()
        if not self._kept or seen.time_ns - self._kept[-1].time_ns >= _KEEPS_NS:
            known_now = _Known(seen.time_ns - 1, self._position, self._attitude)
            self._kept.append(copy.deepcopy(known_now))
        known = self._evidence(seen, state, vehicle)
        self._on_gnss = known.north_east_m is not None
        self._attitude.add(seen, known, gap_s)
        moved = track.at(seen.time_ns)
        if moved is None:
            self._last = None
            return
        last, self._last = self._last, moved
        if last is None or gap_s > _GAP_S or track.restarts != self._restarts:
            self._position.forget_motion()
        else:
            h = (moved.time_ns - last.time_ns) * 1e-9
            way = moved.position - last.position - last.velocity * h
            self._position.predict(way, moved.velocity - last.velocity, h)
        self._restarts = track.restarts
        if self._anchor is None:
            self._anchor = seen.place[:2]
        place = np.array(north_east(*self._anchor, *seen.place[:2]))
        climb = -(state.local_velocity_ned or (0.0, 0.0, 0.0))[2]
        self._position.add(place, seen, known, climb)

    def _evidence(
        self, seen: CalibrationObservation, state: VehicleState, vehicle: Bridge
    ) -> AutopilotObservation:
        t = seen.time_ns
        reported = [vehicle.gimbal_at(t + dt) for dt in (0, -_RATE_NS, _RATE_NS)]
        self._fixed = reported[0] is not None and reported[0].source == "fixed"
        now, before, after = (_camera(gimbal) for gimbal in reported)
        turn = None
        if before is not None and after is not None:
            turn = so3_log(after @ before.T) * (1e9 / (2 * _RATE_NS))
        return AutopilotObservation(
            now,
            turn,
            _gnss_offset(seen, state, vehicle.gnss_place_at(t)),
            self._gnss_heights.at(t),
            self._pressures.at(t),
        )


class _History:
    """A height over time, linear between reports."""

    def __init__(self) -> None:
        self._rows: deque[tuple[int, float]] = deque(maxlen=_HISTORY)

    def add(self, time_ns: int, value: float | None) -> None:
        if value is not None and (not self._rows or time_ns > self._rows[-1][0]):
            self._rows.append((time_ns, value))

    def at(self, time_ns: int) -> float | None:
        """The interpolated value; None without a report near that time."""
        if not self._rows or not self._rows[0][0] <= time_ns <= self._rows[-1][0] + _STALE_NS:
            return None
        times, values = zip(*self._rows, strict=True)
        return float(np.interp(time_ns, times, values))


def _is_significant(figure: CalibrationEstimate) -> bool:
    """Whether the estimate differs from zero significantly."""
    return abs(figure.value) > 2.0 * figure.sigma


def _agree(a: CalibrationEstimate, b: CalibrationEstimate, sigmas: float = 3.0) -> bool:
    return abs(a.value - b.value) < sigmas * math.hypot(a.sigma, b.sigma)


def _fused(a: CalibrationEstimate, b: CalibrationEstimate) -> CalibrationEstimate:
    """Combine both estimates, weighted by their variances."""
    wa, wb = 1.0 / a.sigma**2, 1.0 / b.sigma**2
    return CalibrationEstimate((wa * a.value + wb * b.value) / (wa + wb), 1.0 / math.sqrt(wa + wb))


def _camera(gimbal: GimbalAttitude | None) -> Array | None:
    if gimbal is None:
        return None
    return np.asarray(matrix_from_quaternion(gimbal.quaternion) @ GIMBAL_FROM_CAMERA)


def _gnss_offset(
    seen: CalibrationObservation, state: VehicleState, place: tuple[float, ...] | None
) -> tuple[float, float] | None:
    """North and east offset of the EKF from the observation, if the EKF agrees with the
    receiver.
    """
    if place is None or state.gps_latitude_deg is None or state.gps_longitude_deg is None:
        return None
    if state.latitude_deg is None or state.longitude_deg is None:
        return None
    apart = north_east(
        state.latitude_deg, state.longitude_deg, state.gps_latitude_deg, state.gps_longitude_deg
    )
    speed = math.hypot(*(state.local_velocity_ned or (0.0, 0.0, 0.0))[:2])
    if math.hypot(*apart) > _FROM_GNSS_M + 0.5 * speed:
        return None
    north, east = north_east(*seen.place[:2], place[0], place[1])
    return north, east
