"""Queue of fixes between threads; measures their latency and keeps the mark of a position jump."""

from __future__ import annotations

import statistics
import threading
from collections import deque
from dataclasses import replace

from mavlink_bridge.messages import VisionFix

_AGES = 50


class PendingJump:
    """Keeps a position jump until a message has announced it. Whoever drops a fix calls `note`.

    The reset counter of the next message announces the jump. An EKF without that announcement takes
    the jump for an error and rejects the following positions.
    """

    def __init__(self, *, pending: bool = False) -> None:
        self.pending = pending

    def note(self, fix: VisionFix) -> None:
        """A fix is dropped or about to be sent: keep its jump."""
        self.pending = self.pending or fix.reset

    def announce(self) -> None:
        """Announce a jump with the next fix."""
        self.pending = True

    def told(self) -> None:
        """A message with it went out."""
        self.pending = False


class FixQueue:
    """Fixes on their way from any thread to the link's; the oldest go first when it is full.

    The next fix announces the jump of a dropped one.
    """

    def __init__(self, length: int) -> None:
        self._length = length
        self._fixes: deque[VisionFix] = deque()
        self._jump = PendingJump()
        self._lock = threading.Lock()
        self.dropped = 0

    def put(self, fix: VisionFix) -> None:
        """Append; never blocks for long."""
        with self._lock:
            self._fixes.append(fix)
            if len(self._fixes) > self._length:
                self.dropped += 1
                self._jump.note(self._fixes.popleft())

    def __len__(self) -> int:
        return len(self._fixes)

    def take(self) -> list[VisionFix]:
        """All that wait, oldest first."""
        if not self._fixes:
            return []
        with self._lock:
            fixes = list(self._fixes)
            self._fixes.clear()
            if self._jump.pending:
                fixes[0] = replace(fixes[0], reset=True)
                self._jump.told()
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
