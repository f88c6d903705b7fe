"""Limits the rate of events that arrive at irregular times."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class RateLimiter:
    """Limits the mean rate: the next event is due a period after the last was due, not after it was
    sent. Otherwise 10 Hz frames limited to 6 Hz would be sent every 200 ms, at 5 Hz.
    """

    period_s: float
    due_s: float = 0.0

    def is_due(self, now_s: float) -> bool:
        """Whether an event may be sent now; CLOCK_MONOTONIC in s."""
        return now_s >= self.due_s

    def mark_sent(self, now_s: float) -> None:
        """Note that an event was sent; the next is due one period after this one was due."""
        self.due_s = max(self.due_s + self.period_s, now_s)
