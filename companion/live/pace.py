"""How often something may go out, of what comes at times of its own."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class RateLimiter:
    """A mean rate: the next is due a period after the last was due, not after it went. Pictures of
    10 Hz at a pace of 6 Hz else went every 200 ms, 5 a second.
    """

    period_s: float
    due_s: float = 0.0

    def is_due(self, now_s: float) -> bool:
        """Whether one may go."""
        return now_s >= self.due_s

    def went(self, now_s: float) -> None:
        """One went; what was missed before is not made up for."""
        self.due_s = max(self.due_s + self.period_s, now_s)
