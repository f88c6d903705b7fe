"""The shadow check: would vision have been accurate enough to fly on? While GNSS is healthy, every
fix is compared with the autopilot's global position at the fix's exposure time.

The result is ready or not ready, with reasons.

Interlock: the EKF accepts a map with a 20 m offset without a warning. While there is GNSS, nothing
is sent before the shadow check has passed. Without GNSS from the start (an indoor vehicle, a
restart) vision cannot be compared; injection then begins with an alert.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import CATALOGUE, alert, reason
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.config import BridgeConfig, Mode
from mavlink_bridge.injection.propagate import PropagatedFix
from mavlink_bridge.injection.restart_memory import ShadowFailureMemory
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.status import StatusNotifier
from mavlink_bridge.vehicle.origin import north_east
from mavlink_bridge.vehicle.sensor_errors import VEHICLE_SENSORS

_PERIOD_NS = 1_000_000_000
_WITHOUT_GNSS_NS = 2_000_000_000  # GPS_RAW_INT comes five times a second
_BEFORE_LAST_NS = 30_000_000_000  # a jammed receiver spoils the score's end
_GO_NS = 600_000_000_000


class ShadowInterlock:
    """Decides at each step whether fixes may be injected; one thread.

    score: gives the result of the shadow check at a time. compared_ns: when a fix was last compared
    with GNSS, 0 if never. inhibited_by: active alerts that inhibit injection. A failed shadow check
    is kept over a restart, beside `state_file`.
    """

    def __init__(
        self,
        config: BridgeConfig,
        score: Callable[[int], ShadowScore],
        compared_ns: Callable[[], int],
        notifier: StatusNotifier,
    ) -> None:
        self._force, file = config.injection.force, config.state_file
        self._memory: ShadowFailureMemory | None = None
        if file is not None:
            self._memory = ShadowFailureMemory(file.with_name("shadow-no-go.json"))
        self._score = score
        self._compared_ns = compared_ns
        self._notifier = notifier
        self.inhibited_by: frozenset[AlertId] = frozenset()
        self._next_ns = 0
        self._without_since_ns: int | None = None
        self._go_ns: int | None = None
        self._against: Alert | None = None
        self._reason: Alert | None = alert(AlertId.SHADOW_NOT_COMPARED)
        self._open = False

    def set_map_id(self, map_id: str) -> None:
        """Set the id of the map; called before `recall`."""
        if self._memory is not None:
            self._memory.about = map_id

    def recall(self) -> None:
        """Restore the failed shadow check of a process that was killed, and report it; before the
        link starts.
        """
        if self._memory is not None and self._memory.recall():
            self._against = self._reason = alert(AlertId.SHADOW_RESTORED)
            self._notifier.report(self._against)

    def end(self, *, clean_shutdown: bool = True) -> None:
        """End the memory; a clean shutdown deletes the stored failure. The first call counts."""
        if self._memory is not None:
            self._memory.stop(clean_shutdown=clean_shutdown)

    def mode(self, wanted: Mode, state: VehicleState, now_ns: int, *, by_pilot: bool) -> Mode:
        """The mode that is allowed: ``shadow`` for ``inject`` until injection may begin, after that
        always ``inject``. by_pilot: the mode is ``rc``; the pilot's ``inject`` is followed,
        reported if the shadow check has not passed, and ended by the pilot's ``shadow``.
        """
        self._update(state, now_ns)
        if wanted != "inject":
            if by_pilot:
                self._open = False  # its next opening is reported again
            self._remember()
            return wanted
        if not self._open and state.connected:
            self._open = self._may_begin(now_ns, by_pilot=by_pilot)
        self._remember()
        return "inject" if self._open else "shadow"

    def _remember(self) -> None:
        """Store the failure for a restart, unless injection runs: injection that has started is not
        stopped by a restart or a spoofed receiver.
        """
        if self._memory is not None:
            self._memory.store(not self._open and self._against is not None)

    @property
    def reason(self) -> Alert | None:
        """Why nothing is injected in mode ``inject``; None if the interlock is not the reason."""
        if self._open:
            return None
        if self.inhibited_by:
            first = min(self.inhibited_by, key=lambda of: CATALOGUE[of].title)
            return alert(AlertId.INHIBITED, alert=first)
        return self._reason

    def may_switch(self, now_ns: int) -> bool:
        """Whether the EKF may switch to vision: by `force`; or, while no alert inhibits, if the
        shadow check has passed in the last 10 min and at most 30 s before the last comparison, or
        if injection runs and nothing was ever compared.
        """
        if self._force:
            return True
        if self.inhibited_by:
            return False
        unproven = self._open and not self._compared_ns() and not self._against
        return self._recent_go(now_ns) if self._go_ns is not None else unproven

    def _recent_go(self, now_ns: int) -> bool:
        if self._go_ns is None:
            return False
        before_last_ns = self._compared_ns() - self._go_ns
        return before_last_ns <= _BEFORE_LAST_NS and now_ns - self._go_ns <= _GO_NS

    def _may_begin(self, now_ns: int, *, by_pilot: bool) -> bool:
        """Whether injection may start; reports a start without a passed check. Never revoked."""
        since_ns = self._without_since_ns
        without = since_ns is not None and now_ns - since_ns >= _WITHOUT_GNSS_NS
        if self._recent_go(now_ns) and not self.inhibited_by:
            return True
        if self._force:
            self._notifier.report(alert(AlertId.INJECTION_FORCED))
        elif by_pilot:
            self._notifier.report(alert(AlertId.INJECTION_NOT_READY))
        elif without and not self._against and not self.inhibited_by:
            self._notifier.report(alert(AlertId.INJECTION_UNCHECKED))
        else:
            return False
        return True

    def _update(self, state: VehicleState, now_ns: int) -> None:
        """Update the time without GNSS, and once a second the result of the shadow check."""
        if gnss_healthy(state, now_ns) or not state.connected:
            self._without_since_ns = None
        elif self._without_since_ns is None:
            self._without_since_ns = now_ns
        if now_ns < self._next_ns:
            return
        self._next_ns = now_ns + _PERIOD_NS
        score = self._score(now_ns)
        if score.ready:
            self._go_ns, self._against = self._compared_ns(), None
        elif score.samples >= MINIMUM_SAMPLES:
            # It stays when its samples age: a wrong map is wrong without GNSS, too. A low rate
            # says nothing about the map; `Injector` checks it.
            self._against = score.against[0] if score.against else None
        self._reason = self._against or (score.reasons[0] if score.reasons else None)


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
