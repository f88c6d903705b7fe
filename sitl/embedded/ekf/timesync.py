"""Removes transport jitter from a sender's time stamps, as ArduPilot's JitterCorrection.

The link's lag is the smallest over 100 samples. A sample is never in the future, and at most 500 ms
in the past. The smallest lag cannot be measured; VISO_DELAY_MS compensates it.
"""

from __future__ import annotations

_MAX_LAG_US = 500_000
_CONVERGENCE = 100


class JitterCorrection:
    """One per link: every time-stamped message of a link shares it."""

    def __init__(self) -> None:
        self._offset_us: int | None = None
        self._least_us = 0
        self._count = 0

    def correct(self, remote_us: int, local_us: int) -> int:
        """Local time (µs since boot) of a remote time stamp (µs, any epoch)."""
        difference = local_us - remote_us
        if self._offset_us is None or difference < self._offset_us:
            self._offset_us = difference
        estimate = remote_us + self._offset_us
        if estimate + _MAX_LAG_US < local_us:
            estimate = local_us - _MAX_LAG_US
            self._offset_us = estimate - remote_us
        self._least_us = difference if self._count == 0 else min(self._least_us, difference)
        self._count += 1
        if self._count == _CONVERGENCE:
            self._offset_us = self._least_us
            self._count = 0
        return estimate
