"""Checks whether the EKF follows the sent positions, and why not."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.config import InjectionMessage
from mavlink_bridge.messages import VehicleState

_SETTLE_NS = 3_000_000_000
_WINDOW_NS = 3_000_000_000
_SILENT_NS = 1_000_000_000
_COMPARE_AFTER_NS = 300_000_000
_SIGMAS = 5.0
_SLACK_M = 2.0
_MINIMUM_HZ = 4.0
_GPS_MINIMUM_HZ = 4.65  # an average gap over 215 ms makes ArduPilot's receiver unhealthy
_VARIANCE_LIMIT = 1.0  # the innovation test's own threshold
_TAKES_NS = 200_000_000  # from arrival to where the EKF's output shows a jump
_JUMP_SAMPLES = 3
_JUMP_SIGMAS, _JUMP_SLACK_M = 3.0, 1.0  # to announce it once too often costs nothing
_MOST_REPEATS = 5


@dataclass(frozen=True)
class LoopVerdict:
    """Whether the EKF follows the sent positions. reason: why not, else None.

    difference_m: median horizontal distance between sent and estimated position.
    """

    used: bool
    reason: Alert | None
    difference_m: float | None


class ClosedLoopCheck:
    """Compares sent positions with the EKF's; one thread. message: kind of the sent messages.

    jumping: the EKF was not yet seen at the positions after the last announced jump.
    """

    def __init__(self, message: InjectionMessage) -> None:
        self.jumping = False
        self._message = message
        self._sent: deque[tuple[int, float, float, float]] = deque(maxlen=256)
        self._pending: deque[tuple[int, float, float, float]] = deque(maxlen=256)
        self._differences: deque[tuple[int, float, float, int]] = deque(maxlen=256)
        self._began_ns: int | None = None
        self._reset_counter: int | None = None
        self._jump_ns: int | None = None
        self._announced_ns = 0
        self._repeats = 0

    def add_sent(
        self,
        stamp_ns: int,
        now_ns: int,
        north: float,
        east: float,
        sigma_m: float,
        reset_counter: int = 0,
    ) -> None:
        """Add a position that was sent at now_ns: valid at stamp_ns, metres north and east of the
        EKF origin, with a horizontal sigma. A reset_counter unlike the one before announces a jump.
        """
        if self._reset_counter not in (None, reset_counter):
            self._jump_ns = now_ns + _TAKES_NS
            self._announced_ns, self.jumping = now_ns, True
        self._reset_counter = reset_counter
        if not self._sent or now_ns - self._sent[-1][0] > _SETTLE_NS:
            self._began_ns = now_ns
        self._sent.append((now_ns, north, east, sigma_m))
        self._pending.append((stamp_ns, north, east, sigma_m))

    def verdict(
        self,
        now_ns: int,
        state: VehicleState,
        local_at: Callable[[int], tuple[float, ...] | None],
    ) -> LoopVerdict | None:
        """The verdict of the last 3 s; None before, or while nothing is sent. local_at: the EKF's
        position (north, east, down) at a time, m.
        """
        self._compare(now_ns, local_at)
        recent = [s for s in self._sent if now_ns - s[0] < _WINDOW_NS]
        if not recent or self._began_ns is None or now_ns - self._began_ns < _SETTLE_NS:
            return None
        if now_ns - recent[-1][0] > _SILENT_NS:
            return None  # that nothing is sent is told by who does not send it
        differences = sorted(d for t, d, *_ in self._differences if now_ns - t < _WINDOW_NS)
        difference = differences[len(differences) // 2] if differences else None
        span_s = (recent[-1][0] - recent[0][0]) * 1e-9
        rate = (len(recent) - 1) / span_s if span_s > 0.0 else 0.0
        sigma = recent[-1][3]
        reason = self._reason(rate, state, difference, sigma)
        after_jump = now_ns - self._announced_ns > _WINDOW_NS + _COMPARE_AFTER_NS + _TAKES_NS
        if after_jump and difference is not None and _is_there(difference, sigma):
            self.jumping, self._repeats = False, 0  # another jump may be missed as often
        return LoopVerdict(reason is None, reason, difference)

    def is_jump_missed(self) -> bool:
        """Whether an announced jump must be announced again, because the EKF did not follow: True
        once for each announcement, up to five times.

        In each of its steps ArduPilot's EKF uses only the newest measurement. If two arrive
        together, it never uses the first one, which had the new reset_counter. It then refuses all
        positions, for 7 s (VISION_POSITION_ESTIMATE) or without end (ODOMETRY).
        """
        if self._jump_ns is None:
            return False
        after = [(d, sigma) for _, d, sigma, stamp in self._differences if stamp >= self._jump_ns]
        if len(after) < _JUMP_SAMPLES:
            return False
        self._jump_ns = None
        distance, sigma = sorted(after)[len(after) // 2]
        if _is_there(distance, sigma):
            self._repeats = 0
            return False
        self._repeats += 1
        return self._repeats <= _MOST_REPEATS

    def _compare(self, now_ns: int, local_at: Callable[[int], tuple[float, ...] | None]) -> None:
        """Compare each sent position with the EKF's at the same time, 0.3 s after that time."""
        while self._pending and now_ns - self._pending[0][0] > _COMPARE_AFTER_NS:
            stamp_ns, north, east, sigma = self._pending.popleft()
            local = local_at(stamp_ns)
            if local is not None:
                distance = math.hypot(local[0] - north, local[1] - east)
                self._differences.append((now_ns, distance, sigma, stamp_ns))

    def _reason(
        self, rate: float, state: VehicleState, difference: float | None, sigma: float
    ) -> Alert | None:
        needed = _GPS_MINIMUM_HZ if self._message == "gps_input" else _MINIMUM_HZ
        flags = state.ekf_flags
        no_init = bool(flags & mavlink.EKF_UNINITIALIZED) and state.autopilot == "ardupilot"
        off_m = difference or 0.0
        found = (
            (rate < needed, alert(AlertId.FIX_RATE_LOW, hertz=rate, needed=needed)),
            (no_init, alert(AlertId.EKF_NOT_INITIALISED)),
            (bool(flags & mavlink.EKF_CONST_POS_MODE), alert(AlertId.EKF_NO_SOURCE)),
            (difference is None, alert(AlertId.EKF_NO_POSITION)),
            (off_m > _SIGMAS * sigma + _SLACK_M, alert(AlertId.EKF_OFF_FIXES, metres=off_m)),
            (
                (state.ekf_horizontal_variance or 0.0) > _VARIANCE_LIMIT,
                alert(AlertId.EKF_REJECTS_FIXES),
            ),
        )
        return next((reason for holds, reason in found if holds), None)


def _is_there(distance_m: float, sigma_m: float) -> bool:
    """Whether the EKF is at the sent position, so that it has followed an announced jump."""
    return distance_m <= _JUMP_SIGMAS * sigma_m + _JUMP_SLACK_M
