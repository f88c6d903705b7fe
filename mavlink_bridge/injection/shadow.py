"""The shadow check: would vision have been accurate enough to fly on? While GNSS is healthy, every
fix is compared with the autopilot's global position at the fix's exposure time.

The result is ready or not ready, with reasons.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from dataclasses import dataclass

import numpy as np

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert, reason
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.injection.propagate import PropagatedFix
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.vehicle.origin import north_east
from mavlink_bridge.vehicle.sensor_errors import VEHICLE_SENSORS

_WINDOW_NS = 120_000_000_000
_LENGTH = 4096
_GNSS_FRESH_NS = 1_500_000_000
_MINIMUM_FIX = 3
MINIMUM_SAMPLES = 50
_MEDIAN_LIMIT_M = 3.0
_P95_LIMIT_M = 6.0
_RATE_LIMIT_HZ = 4.0
# A chi-square of two degrees of freedom is 1.39 in the median; three times the claimed sigma is 9x.
_HEIGHT_LIMIT_M = 10.0  # barometer and GNSS heights differ by metres, wrong geoids by tens
_CONSISTENCY_LIMIT = 9.0 * 1.39


@dataclass(frozen=True)
class ShadowScore:
    """Comparison of vision with GNSS over the last two minutes; errors are horizontal.

    ready: the check has passed. Without samples the figures are None. bias_ne_m: mean north and
    east difference, vision minus GNSS. height_m: median difference of the heights likewise,
    positive if vision is higher. consistency: median squared Mahalanobis distance (1.4 is ideal).
    reasons: why the check has not passed; empty if it has. against: those of the reasons that show
    wrong positions, and not only too few.
    """

    ready: bool
    samples: int
    reasons: tuple[Alert, ...]
    median_m: float | None = None
    p95_m: float | None = None
    bias_ne_m: tuple[float, float] | None = None
    height_m: float | None = None
    consistency: float | None = None
    rate_hz: float | None = None
    against: tuple[Alert, ...] = ()

    def line(self) -> str:
        """Whether it is ready, the reasons and the errors, as one line for the operator."""
        figures = ""
        if self.median_m is not None and self.p95_m is not None:
            figures = f"median {self.median_m:.1f} m, p95 {self.p95_m:.1f} m, n {self.samples}"
        if self.ready:
            return f"ready: {figures}"
        why = "; ".join(reason(of) for of in self.reasons)
        return f"not ready: {why}" + (f" ({figures})" if figures else "")


def gnss_healthy(state: VehicleState, now_ns: int) -> bool:
    """Whether the receiver has reported a 3D fix in the last 1.5 s."""
    fresh = now_ns - state.gps_time_ns < _GNSS_FRESH_NS
    return fresh and state.gps_fix_type >= _MINIMUM_FIX


class ShadowScorer:
    """Collects comparisons in one thread; `score` may be called from any."""

    def __init__(self, geoid_separation_m: float) -> None:
        self._geoid_m = geoid_separation_m
        self._lock = threading.Lock()
        self._samples: deque[tuple[int, float, float, float, float]] = deque(maxlen=_LENGTH)

    def compare(self, fix: PropagatedFix, reference: tuple[float, ...]) -> None:
        """Add a fix and the autopilot's position at the fix's time to the samples of the shadow
        check. reference: latitude, longitude (degrees), altitude above mean sea level (m).
        Thread-safe.
        """
        difference = np.array(
            north_east(reference[0], reference[1], fix.latitude_deg, fix.longitude_deg)
        )
        P = fix.covariance_ned[:2, :2] + np.eye(2) * VEHICLE_SENSORS.ekf_on_gnss_m**2
        distance = float(difference @ np.linalg.solve(P, difference))
        north, east = (float(d) for d in difference)
        up = fix.height_m - self._geoid_m - reference[2]
        with self._lock:
            self._samples.append((fix.time_ns, north, east, distance, up))

    def score(self, now_ns: int, refused_yaw_rad: float | None) -> ShadowScore:
        """The result of the last two minutes. refused_yaw_rad: None unless the yaw guard blocks."""
        with self._lock:
            samples = np.array([s for s in self._samples if now_ns - s[0] < _WINDOW_NS])
        if not len(samples):
            return ShadowScore(False, 0, (alert(AlertId.SHADOW_NOT_COMPARED),))
        errors = np.hypot(samples[:, 1], samples[:, 2])
        median, p95 = float(np.median(errors)), float(np.percentile(errors, 95))
        consistency = float(np.median(samples[:, 3]))
        span_s = float(samples[-1, 0] - samples[0, 0]) * 1e-9
        rate = (len(samples) - 1) / span_s if span_s > 0 else 0.0
        reasons: list[Alert] = []
        against: list[Alert] = []
        if len(samples) < MINIMUM_SAMPLES:
            few = alert(AlertId.SHADOW_FEW_FIXES, fixes=len(samples), needed=MINIMUM_SAMPLES)
            reasons.append(few)
        elif rate < _RATE_LIMIT_HZ:
            reasons.append(alert(AlertId.SHADOW_RATE, hertz=rate, needed=_RATE_LIMIT_HZ))
        if median > _MEDIAN_LIMIT_M:
            against.append(alert(AlertId.SHADOW_MEDIAN, metres=median))
        if p95 > _P95_LIMIT_M:
            against.append(alert(AlertId.SHADOW_P95, metres=p95))
        if consistency > _CONSISTENCY_LIMIT:
            against.append(alert(AlertId.SHADOW_COVARIANCE))
        height = float(np.median(samples[:, 4]))
        if abs(height) > _HEIGHT_LIMIT_M:
            against.append(alert(AlertId.SHADOW_HEIGHT, metres=height))
        if refused_yaw_rad is not None:
            against.append(alert(AlertId.SHADOW_YAW, degrees=math.degrees(refused_yaw_rad)))
        reasons += against
        bias = (float(samples[:, 1].mean()), float(samples[:, 2].mean()))
        return ShadowScore(
            not reasons, len(samples), tuple(reasons), median, p95, bias, height, consistency, rate,
            tuple(against),
        )  # fmt: skip
