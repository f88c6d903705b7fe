"""Steps of the position that nothing explains, and what they leave in doubt until it is settled.

A stream that begins to lag shows it once: the position steps back by the delay times the speed.
From then on it moves as the IMU does, until the speed or the course changes. A second place beside
the true one looks the same. Whichever it is, one of the two positions is wrong by the step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

STEP_M = 1.0  # what is less is within any level
_MOVES_MPS = 1.0  # below it late stamps explain no step


@dataclass(frozen=True)
class Step:
    """A position off from where the one before led. offset_m, velocity: (north, east), m, m/s."""

    time_ns: int
    offset_m: tuple[float, float]
    velocity: tuple[float, float]


class StepDoubt:
    """The sum of the steps, along and across the way: a step back takes a doubt away again."""

    def __init__(self, most_m: float) -> None:
        """most_m: what is larger is a jump, and held."""
        self._most_m = most_m
        self._along_m = self._across_m = self._speed = 0.0

    @property
    def delay_s(self) -> float:
        """By how much the stamps are late if that is what the steps along the way mean."""
        return abs(self._along_m) / self._speed if self._speed else 0.0

    @property
    def metres(self) -> float:
        """By how much the position may be wrong."""
        return min(math.hypot(self._along_m, self._across_m), self._most_m)

    def add(self, step: Step) -> None:
        """Another step."""
        (north, east), (v_north, v_east) = step.offset_m, step.velocity
        speed = math.hypot(v_north, v_east)
        if speed >= _MOVES_MPS:
            self._speed = speed
            self._leave(
                self._along_m + (north * v_north + east * v_east) / speed,
                self._across_m + (east * v_north - north * v_east) / speed,
            )
        else:
            self._leave(self._along_m, self._across_m + math.hypot(north, east))

    def stamps_are_right(self) -> None:
        """Known since the last step: it was no delay, so what lies along the way is none."""
        self._leave(0.0, self._across_m)

    def is_found_anew(self) -> None:
        """The place was searched and confirmed: what lies across the way is settled."""
        self._leave(self._along_m, 0.0)

    def begins_anew(self) -> None:
        """Another flight: what was in doubt before does not matter."""
        self._leave(0.0, 0.0)

    def _leave(self, along_m: float, across_m: float) -> None:
        small = math.hypot(along_m, across_m) < STEP_M
        self._along_m, self._across_m = (0.0, 0.0) if small else (along_m, across_m)
