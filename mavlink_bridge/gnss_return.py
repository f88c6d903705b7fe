"""Checks whether a GNSS receiver that returns is right, while the EKF uses vision."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mavlink_bridge.alerts.words import GnssDisagreement
from mavlink_bridge.injection.propagate import PropagatedFix
from mavlink_bridge.injection.shadow import gnss_healthy
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.vehicle.origin import north_east
from mavlink_bridge.vehicle.sensor_errors import VEHICLE_SENSORS

_WINDOW_NS = 6_000_000_000
_ACCEPTED_NS = 5_000_000_000  # that the reports must span
_REFUSED_NS = 2_000_000_000
_REPORTS = 5  # of a stream of 1 Hz, too
_GAP_NS = 1_500_000_000
_SIGMAS = 3.0
_CLAIM_M = 5.0  # EKF3 does not use a receiver that claims to be worse, either
_LAG_S = 0.15  # of a report when it comes
_LAG_ERROR_S = 0.15
_DRIFT_MPS = 0.4
_SCATTER_M = 0.7

_Array = NDArray[np.float64]


@dataclass(frozen=True)
class GnssRefusal:
    """Why a receiver is not accepted. size: in the unit that `why` names."""

    size: float
    why: GnssDisagreement


@dataclass(frozen=True)
class _Report:
    """One report of the receiver; differences are north and east, metres. off_m: difference from
    vision at its time.

    slipped_m: difference from the integral of the EKF's velocity, with an arbitrary zero.
    claimed_m: the accuracy that the receiver states, None without one.
    """

    time_ns: int
    off_m: tuple[float, float]
    slipped_m: tuple[float, float]
    claimed_m: float | None
    sigma_m: float
    speed_mps: float


class GnssReturnCheck:
    """Compares the receiver with vision and with the inertial motion over some seconds.

    The receiver is accepted after 5 s in which four conditions hold: it is near vision, it does not
    drift against vision and the EKF's velocity, it scatters no more than its stated accuracy, and
    this accuracy is 5 m or better. One thread.
    """

    def __init__(self) -> None:
        self.refusal: GnssRefusal | None = None
        self.accepted = False
        self._reports: deque[_Report] = deque()
        self._anchor: tuple[float, float] | None = None
        self._moved = np.zeros(2)
        self._looked_ns = 0

    def reset(self) -> None:
        """Forget the receiver's reports and the result."""
        self._reports.clear()
        self.refusal, self.accepted, self._anchor = None, False, None

    def update(self, state: VehicleState, vision: PropagatedFix | None, now_ns: int) -> None:
        """Process the receiver's newest report; called ten times a second. vision: the last
        position, None while it is not reliable: nothing is accepted then, and the last refusal
        stays.
        """
        velocity = np.array((state.local_velocity_ned or (0.0, 0.0))[:2])
        passed_s = min((now_ns - self._looked_ns) * 1e-9, 1.0)
        self._moved, self._looked_ns = self._moved + velocity * passed_s, now_ns
        if not gnss_healthy(state, now_ns):
            self.reset()
            return
        if vision is None:
            self._reports.clear()
            self.accepted = False
            return
        last_ns = self._reports[-1].time_ns if self._reports else 0
        if state.gps_time_ns <= last_ns:
            return
        if state.gps_time_ns - last_ns > _GAP_NS:
            self._reports.clear()
        self._add(state, vision)
        self._decide()

    def _add(self, state: VehicleState, vision: PropagatedFix) -> None:
        latitude, longitude = state.gps_latitude_deg, state.gps_longitude_deg
        if latitude is None or longitude is None:
            return
        self._anchor = anchor = self._anchor or (latitude, longitude)
        older_s = (vision.time_ns - state.gps_time_ns) * 1e-9 + _LAG_S
        seen = north_east(vision.latitude_deg, vision.longitude_deg, latitude, longitude)
        off = np.array(seen) + vision.velocity_ned[:2] * older_s
        slipped = np.array(north_east(*anchor, latitude, longitude)) - self._moved
        if state.local_velocity_ned is None:
            slipped = off
        self._reports.append(
            _Report(
                state.gps_time_ns,
                (float(off[0]), float(off[1])),
                (float(slipped[0]), float(slipped[1])),
                state.gps_h_accuracy_m,
                vision.horizontal_sigma_m,
                math.hypot(*vision.velocity_ned[:2]),
            )
        )
        while state.gps_time_ns - self._reports[0].time_ns > _WINDOW_NS:
            self._reports.popleft()

    def _decide(self) -> None:
        span_ns = self._reports[-1].time_ns - self._reports[0].time_ns
        if len(self._reports) < _REPORTS or span_ns < _REFUSED_NS:
            return
        fault = self._fault()
        self.accepted = fault is None and span_ns >= _ACCEPTED_NS
        if fault is not None or self.accepted:
            self.refusal = fault

    def _fault(self) -> GnssRefusal | None:
        reports = self._reports
        claims = [VEHICLE_SENSORS.gnss_sigma_m(r.claimed_m, math.inf) for r in reports]
        if max(claims) > _CLAIM_M:
            return GnssRefusal(max(claims), GnssDisagreement.CLAIMED)
        accuracy = min(float(np.mean(claims)), VEHICLE_SENSORS.gnss_m)
        sigma = math.hypot(accuracy, float(np.mean([r.sigma_m for r in reports])))
        speed = float(np.mean([r.speed_mps for r in reports]))
        off = np.array([r.off_m for r in reports])
        times = np.array([(r.time_ns - reports[0].time_ns) * 1e-9 for r in reports])
        drift, drift_sigma, scatter, now = _motion(times, off)
        apart = max(float(np.hypot(*off.mean(axis=0))), now)  # what drifts away goes on
        if apart > _SIGMAS * sigma + speed * _LAG_ERROR_S:
            return GnssRefusal(apart, GnssDisagreement.OFF_VISION)
        if scatter > _SCATTER_M + sigma / 2:
            return GnssRefusal(scatter, GnssDisagreement.NOISE)
        slip, slip_sigma, *_ = _motion(times, np.array([r.slipped_m for r in reports]))
        if drift > _DRIFT_MPS + _SIGMAS * drift_sigma:
            return GnssRefusal(drift, GnssDisagreement.DRIFTS_FROM_VISION)
        if slip > _DRIFT_MPS + _SIGMAS * slip_sigma:
            return GnssRefusal(slip, GnssDisagreement.DRIFTS_FROM_IMU)
        return None


def _motion(times: _Array, positions: _Array) -> tuple[float, float, float, float]:
    """Speed of the straight line through positions (n, 2), its sigma, the rms distance of the
    positions to the line, and the distance of the line's end from zero; m/s and m.
    """
    t = times - times.mean()
    spread = float(t @ t)
    rate = t @ positions / spread
    left = positions - positions.mean(axis=0) - np.outer(t, rate)
    scatter = float(np.sqrt((left**2).sum(axis=1).mean()))
    end = float(np.hypot(*(positions.mean(axis=0) + t[-1] * rate)))
    return float(np.hypot(*rate)), scatter / math.sqrt(2 * spread), scatter, end
