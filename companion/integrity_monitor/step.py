"""Detects unexplained steps of the position, and keeps the resulting uncertainty until it is
resolved.

A step lasts. Two honest fixes may be farther apart than four of their sigmas once in some thousand;
the means of those before and after are not.

A stream that begins to lag shows it once: the position steps back by the delay times the speed.
From then on it moves as the IMU does, until the speed or the course changes. A second place beside
the true one looks the same. Whichever it is, one of the two positions is wrong by the step.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

STEP_M = 1.0  # what is less is within any level
UNREPORTED_JUMP_M = 3.0  # unannounced jumps above this are held
_MOVES_MPS = 1.0  # below it late stamps explain no step
_SOON_S = 1.0
_FIXES = 5  # on either side, whose means are compared
_LEAST_BEFORE = 3  # to which the one before led: the velocity of an EKF just found is not known
_DECIDES_S = 2.0  # at latest, however often it steps meanwhile
_SIGMAS = 4.0
_SPEED_MPS = 1.0  # what leads from one to the next may be off by


@dataclass(frozen=True)
class PositionStep:
    """Offset of a fix from the position that was predicted for it.

    offset_m, velocity: (north, east), m, m/s; sigma_m: of the position; allowed_m: largest
    explained offset; growth_m: part of it caused by the elapsed time after_s, s.
    """

    time_ns: int
    offset_m: tuple[float, float]
    velocity: tuple[float, float]
    sigma_m: float = 0.0
    allowed_m: float = 0.0
    growth_m: float = 0.0
    after_s: float = 0.0

    @property
    def is_predicted(self) -> bool:
        """Whether the fix came within 1 s of the last one and near the prediction."""
        return self.after_s <= _SOON_S and math.hypot(*self.offset_m) <= self.allowed_m

    @property
    def is_suspect(self) -> bool:
        """Whether the step exceeds what noise and elapsed time explain, and `STEP_M`."""
        return math.hypot(*self.offset_m) > max(self.allowed_m, STEP_M)


@dataclass(frozen=True)
class _Offset:
    """Sum of all steps up to a time, (north, east) m: the position minus dead reckoning."""

    time_ns: int
    north: float
    east: float
    sigma_m: float


class StepDetector:
    """Detects steps of accepted positions that last."""

    def __init__(self) -> None:
        self._north = self._east = 0.0
        self._before: deque[_Offset] = deque(maxlen=_FIXES)
        self._after: list[_Offset] = []
        self._suspect: PositionStep | None = None

    @property
    def suspected_m(self) -> float:
        """Size of the newest step while it is not yet known whether it lasts, m; otherwise 0."""
        if self._suspect is None:
            return 0.0
        before, newest = _mean(self._before), self._after[-1]
        return math.hypot(newest.north - before.north, newest.east - before.east)

    def add(self, step: PositionStep) -> PositionStep | None:
        """Add the offset of a fix that the jump check passed; returns a step once it has lasted."""
        self._north += step.offset_m[0]
        self._east += step.offset_m[1]
        here = _Offset(step.time_ns, self._north, self._east, step.sigma_m)
        if step.is_suspect:
            if len(self._before) < _LEAST_BEFORE:
                self.forget()
            elif self._suspect is None:
                self._suspect = step
            elif step.time_ns - self._suspect.time_ns < _DECIDES_S * 1e9:
                self._after.clear()  # from here on it may last; what was before it stays
        if self._suspect is None:
            self._before.append(here)
            return None
        self._after.append(here)
        return self._decided(self._suspect) if len(self._after) >= _FIXES else None

    def forget(self) -> None:
        """Reset: the next position has no predecessor."""
        self._before.clear()
        self._after.clear()
        self._suspect = None

    def _decided(self, suspect: PositionStep) -> PositionStep | None:
        before, after = _mean(self._before), _mean(self._after)
        north, east = after.north - before.north, after.east - before.east
        apart_s = (after.time_ns - before.time_ns) * 1e-9
        noise = math.hypot(before.sigma_m, after.sigma_m)
        drift_mps = max(_SPEED_MPS, _drift(self._before), _drift(self._after))
        most_m = _SIGMAS * noise + suspect.growth_m + drift_mps * apart_s
        self._before = deque(self._after, maxlen=_FIXES)
        self._after, self._suspect = [], None
        if math.hypot(north, east) <= max(most_m, STEP_M):
            return None
        return replace(suspect, offset_m=(north, east))


def _drift(some: Sequence[_Offset]) -> float:
    """Speed at which the offsets grow, m/s, from the error of the prediction."""
    first, last = some[0], some[-1]
    span_s = (last.time_ns - first.time_ns) * 1e-9
    return math.hypot(last.north - first.north, last.east - first.east) / span_s if span_s else 0.0


def _mean(some: Sequence[_Offset]) -> _Offset:
    """The mean, and its sigma."""
    n = len(some)
    return _Offset(
        sum(one.time_ns for one in some) // n,
        sum(one.north for one in some) / n,
        sum(one.east for one in some) / n,
        max(one.sigma_m for one in some) / math.sqrt(n),
    )


class StepUncertainty:
    """Sums steps along and across the direction of flight. A step back reduces the sum."""

    def __init__(self) -> None:
        self._finder = StepDetector()
        self._along_m = self._across_m = self._speed = 0.0

    @property
    def delay_s(self) -> float:
        """Delay of the timestamps, s, that would explain the steps along the flight."""
        return abs(self._along_m) / self._speed if self._speed else 0.0

    @property
    def metres(self) -> float:
        """Position uncertainty from steps that lasted, m."""
        return min(math.hypot(self._along_m, self._across_m), UNREPORTED_JUMP_M)

    @property
    def possible_m(self) -> float:
        """As `metres`, with the newest step included before it has lasted."""
        return min(self.metres + self._finder.suspected_m, UNREPORTED_JUMP_M)

    def add(self, step: PositionStep) -> PositionStep | None:
        """Add the offset of a fix that the jump check passed, sent or not. Returns a step that has
        lasted now, with the time of its first fix; otherwise None.
        """
        found = self._finder.add(step)
        if found is not None:
            self._add_up(found)
        return found

    def _add_up(self, step: PositionStep) -> None:
        (north, east), (v_north, v_east) = step.offset_m, step.velocity
        speed = math.hypot(v_north, v_east)
        if speed >= _MOVES_MPS:
            self._speed = speed
            self._set(
                self._along_m + (north * v_north + east * v_east) / speed,
                self._across_m + (east * v_north - north * v_east) / speed,
            )
        else:
            self._set(self._along_m, self._across_m + math.hypot(north, east))

    def confirm_timestamps(self) -> None:
        """Clear the steps along the direction of flight: the calibration watch (not TIMESYNC) has
        measured that the frames' times lag less than these steps would need.
        """
        self._set(0.0, self._across_m)

    def confirm_position(self) -> None:
        """Clear steps across, and one that has not lasted: a search confirmed the position."""
        self._finder.forget()
        self._set(self._along_m, 0.0)

    def reset(self) -> None:
        """Clear all steps, before a new flight."""
        self._finder.forget()
        self._set(0.0, 0.0)

    def _set(self, along_m: float, across_m: float) -> None:
        small = math.hypot(along_m, across_m) < STEP_M
        self._along_m, self._across_m = (0.0, 0.0) if small else (along_m, across_m)
