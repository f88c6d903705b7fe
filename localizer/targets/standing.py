"""Detects whether a static target still looks as before, by its middle without the surroundings.

A whole template would match the surroundings with the target gone. The middle is compared with its
image a second ago: a changing view changes it slowly, a departure or an obstacle suddenly.
"""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.float32]  # of a chart

_MIDDLE = 0.45  # of a chart's half side
_SHIFT = 2  # cells by which the pose may err
_BEFORE_NS = 1_000_000_000
_DIFFERS = 9.0  # grey levels, root mean square: noise and compression stay below
_CELLS_OFF = 0.35  # what edges make of the rest of the pose's error, below a cell
_TIMES = 3.0  # what is usual at this place: edges differ by more as the view changes
_LEARNS_NS = 1_000_000_000  # what is usual, before anything is not
_LATELY = 0.2  # weight of the newest in what is usual


class StaticAppearance:
    """Appearance of one target over time. Not thread-safe. is_changed: whether it changed suddenly
    and has stayed so.
    """

    def __init__(self) -> None:
        self._kept: deque[tuple[int, Grey]] = deque()
        self._before: Grey | None = None
        self._usual = 0.0
        self._begun_ns = 0
        self.is_changed = False

    def update(self, time_ns: int, chart: Grey) -> None:
        """Process the target's chart (square, of one size and course) in the next frame."""
        while len(self._kept) > 1 and time_ns - self._kept[1][0] >= _BEFORE_NS:
            self._kept.popleft()
        before = self._before
        if before is None and self._kept and time_ns - self._kept[0][0] >= 0.5 * _BEFORE_NS:
            before = self._kept[0][1]
        if before is not None:
            off, edges = _difference(before, chart)
            self._begun_ns = self._begun_ns or time_ns
            is_known = time_ns - self._begun_ns >= _LEARNS_NS
            least = max(_DIFFERS, _CELLS_OFF * edges, _TIMES * self._usual)
            self.is_changed = is_known and off > least
            if self.is_changed:
                self._before = before
                return
            if self._before is not None:
                self._before = None
                self._kept.clear()
            self._usual += (_LATELY if self._usual else 1.0) * (off - self._usual)
        self._kept.append((time_ns, chart))


def _difference(before: Grey, chart: Grey) -> tuple[float, float]:
    """Root mean squares over the chart's middle: its grey level difference where it fits best, and
    its change from cell to cell.
    """
    half = len(before) // 2
    k = max(2, round(_MIDDLE * half))
    middle = before[half - k : half + k + 1, half - k : half + k + 1]
    reach = min(_SHIFT, half - k)
    around = chart[half - k - reach : half + k + reach + 1, half - k - reach : half + k + reach + 1]
    level = np.float32(np.median(chart - before))  # the camera may expose otherwise by now
    least = float(cv2.matchTemplate(around, middle + level, cv2.TM_SQDIFF).min())
    down, right = np.gradient(middle)
    edges = float(np.sqrt(np.mean(down**2 + right**2)))
    return float(np.sqrt(max(least, 0.0) / middle.size)), edges
