"""Fixes between threads, and how old they come."""

from __future__ import annotations

import statistics
import threading
from collections import deque

from mavlink_bridge.messages import VisionFix

_AGES = 50


class FixQueue:
    """Fixes on their way from any thread to the link's; the oldest go first when it is full."""

    def __init__(self, length: int) -> None:
        self._fixes: deque[VisionFix] = deque(maxlen=length)
        self._lock = threading.Lock()
        self.dropped = 0

    def put(self, fix: VisionFix) -> None:
        """Append; never blocks for long."""
        with self._lock:
            self.dropped += len(self._fixes) == self._fixes.maxlen
            self._fixes.append(fix)

    def __len__(self) -> int:
        return len(self._fixes)

    def take(self) -> list[VisionFix]:
        """All that wait, oldest first."""
        if not self._fixes:
            return []
        with self._lock:
            fixes = list(self._fixes)
            self._fixes.clear()
        return fixes


class Latency:
    """Ages of the last 50 fixes, from exposure to when they came, milliseconds."""

    def __init__(self) -> None:
        self._ages_ms: deque[float] = deque(maxlen=_AGES)

    def take(self, age_ms: float) -> None:
        """Of one fix."""
        self._ages_ms.append(age_ms)

    @property
    def is_known(self) -> bool:
        """Whether enough fixes came to judge by."""
        return len(self._ages_ms) == _AGES

    @property
    def median_ms(self) -> float | None:
        """None before the first fix."""
        return statistics.median(self._ages_ms) if self._ages_ms else None

    @property
    def least_ms(self) -> float | None:
        """Of the youngest; None before the first fix."""
        return min(self._ages_ms, default=None)
