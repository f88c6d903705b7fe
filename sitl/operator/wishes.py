"""What an operator asks for in one flight: clicks and rectangles in random order, stops between."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

_EVERY_S = (2.5, 5.0)
_STOPPED = 0.3  # share of the clicks after which something is stopped,
_ALL = 0.3  # and of those stops that end everything
_STOP_AFTER_S = 1.5
_POINTS = 0.5
_EDGE = 0.1  # of the picture: what is nearer to its rim is gone before it was looked at
_HALF = (0.01, 0.05)  # half a rectangle's side, of the picture's


@dataclass(frozen=True)
class Wish:
    """What is asked for, at_s seconds after the recorded part began.

    coordinates: x, y, or x and y of two corners, 0 to 1. which: 0 to 1, of the living targets one
    that is stopped; None: all of them.
    """

    kind: Literal["point", "rectangle", "stop"]
    at_s: float
    coordinates: tuple[float, ...] = ()
    which: float | None = None

    @property
    def middle(self) -> tuple[float, float]:
        """What is pointed at, 0 to 1."""
        x, y = self.coordinates[0::2], self.coordinates[1::2]
        return sum(x) / len(x), sum(y) / len(y)


def draw_wishes(seed: int, clicks: int) -> tuple[Wish, ...]:
    """So many clicks in a flight's order; the same for the same seed."""
    rng = np.random.default_rng([seed, 83])
    wishes, now_s = list[Wish](), 1.0
    for _ in range(clicks):
        middle, half = rng.uniform(_EDGE, 1.0 - _EDGE, 2), rng.uniform(*_HALF, 2)
        if rng.random() < _POINTS:
            wishes.append(Wish("point", now_s, tuple(float(c) for c in middle)))
        else:
            corners = (*(middle - half), *(middle + half))
            wishes.append(Wish("rectangle", now_s, tuple(float(c) for c in corners)))
        if rng.random() < _STOPPED:
            which = None if rng.random() < _ALL else float(rng.random())
            wishes.append(Wish("stop", now_s + _STOP_AFTER_S, which=which))
        now_s += float(rng.uniform(*_EVERY_S))
    return tuple(wishes)
