"""Detects that the EKF rejects positions or jumps."""

from __future__ import annotations

import math

from companion.integrity_monitor.debouncer import CheckResult
from mavlink_bridge.messages import VehicleState

_REFUSED = 1.0  # the innovation test's own threshold
_JUMP_M = 3.0
_FASTEST_MPS2 = 15.0
_GAP_S = 1.0
_CONFIRMS_S = 10.0  # of agreement with the IMU after a jump


class EkfWatch:
    """Checks the EKF's output; called ten times a second with the state, from one thread."""

    def __init__(self) -> None:
        self._last: VehicleState | None = None
        self._unconfirmed_m = 0.0
        self._agreed_since_ns: int | None = None

    def check_rejection(self, state: VehicleState) -> CheckResult:
        """Bad if the EKF's innovation test rejects positions (EKF_STATUS_REPORT, 193)."""
        ratio = state.ekf_horizontal_variance
        if ratio is None or math.isinf(ratio):
            return CheckResult(None)
        return CheckResult(ratio > _REFUSED, ratio)

    def check_jump(self, state: VehicleState, now_ns: int, *, agrees: bool) -> CheckResult:
        """Bad after a jump of the EKF's position (figure: metres), until the IMU has agreed for 10
        s.

        agrees: whether there is evidence that vision moves as the IMU; False without evidence. A
        jump on the ground is ignored, because an EKF jumps from its origin to its first position
        there.
        """
        leap_m = self._leap(state)
        if not state.armed:
            self._unconfirmed_m = 0.0
        elif leap_m > 0.0:
            self._unconfirmed_m, self._agreed_since_ns = leap_m, None
        if not agrees:
            self._agreed_since_ns = None
        elif self._agreed_since_ns is None:
            self._agreed_since_ns = now_ns
        elif now_ns - self._agreed_since_ns >= _CONFIRMS_S * 1e9:
            self._unconfirmed_m = 0.0
        return CheckResult(self._unconfirmed_m > 0.0, self._unconfirmed_m)

    def _leap(self, state: VehicleState) -> float:
        """Distance of the EKF's position from the one predicted by its last velocity, metres; 0 in
        normal flight.
        """
        last = self._last
        if state.local_position_ned is None or state.local_velocity_ned is None:
            self._last = None
            return 0.0
        if last is not None and state.local_time_ns == last.local_time_ns:
            return 0.0
        self._last = state
        if last is None or last.local_position_ned is None or last.local_velocity_ned is None:
            return 0.0
        dt = (state.local_time_ns - last.local_time_ns) * 1e-9
        if not 0.0 < dt < _GAP_S:
            return 0.0
        before, after, speed = (
            last.local_position_ned,
            state.local_position_ned,
            last.local_velocity_ned,
        )
        off = math.hypot(*(after[i] - before[i] - speed[i] * dt for i in range(2)))
        return off if off > _JUMP_M + 0.5 * _FASTEST_MPS2 * dt * dt else 0.0
