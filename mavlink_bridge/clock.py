"""Clocks: our monotonic clock, UTC that cannot jump, and the flight controller's boot time.

The bridge lives on CLOCK_MONOTONIC. The flight controller stamps with the time since its boot; the
offset between both is measured by TIMESYNC (the middle of the fastest round trip) and, until that
has answered, bounded by the smallest lag seen in stamped messages.
"""

from __future__ import annotations

import time
from collections import deque

_WINDOW_NS = 30_000_000_000
_MAX_SAMPLES = 128
_STEP_NS = 500_000_000
_MAX_ROUND_TRIP_NS = 500_000_000
GPS_EPOCH_UNIX_S = 315_964_800  # 1980-01-06 UTC
GPS_LEAP_SECONDS = 18  # GPS - UTC, unchanged since 2017-01-01
_WEEK_MS = 604_800_000


def monotonic_ns() -> int:
    """CLOCK_MONOTONIC, nanoseconds."""
    return time.monotonic_ns()


def utc_us() -> int:
    """Wall clock, microseconds since 1970; only for records that people read."""
    return time.time_ns() // 1000


class SteadyUtc:
    """UTC that follows the monotonic clock from one reading of the wall clock.

    A step of the wall clock (NTP, GNSS that comes back) must not appear inside a flight's stamps.
    """

    def __init__(self, utc_ns: int | None = None, at_monotonic_ns: int | None = None) -> None:
        mono = monotonic_ns() if at_monotonic_ns is None else at_monotonic_ns
        self._offset_ns = (time.time_ns() if utc_ns is None else utc_ns) - mono

    def utc_ns(self, time_ns: int) -> int:
        """UTC nanoseconds since 1970 of a monotonic time."""
        return time_ns + self._offset_ns

    def gps_week_ms(self, time_ns: int) -> tuple[int, int]:
        """GPS week and milliseconds of the week of a monotonic time."""
        gps_ms = self.utc_ns(time_ns) // 1_000_000 - (GPS_EPOCH_UNIX_S - GPS_LEAP_SECONDS) * 1000
        return gps_ms // _WEEK_MS, gps_ms % _WEEK_MS


class BootClock:
    """Maps the flight controller's boot time to CLOCK_MONOTONIC; times in ns.

    ``monotonic = boot + offset``. It notices a reboot by itself (a stamped time that runs back, or
    an offset that steps) and starts over.
    """

    def __init__(self) -> None:
        self.reboots = 0
        self.source = "none"
        self.round_trip_ns: int | None = None
        self._lag: deque[tuple[int, int]] = deque(maxlen=_MAX_SAMPLES)
        self._sync: deque[tuple[int, int, int]] = deque(maxlen=_MAX_SAMPLES)
        self._newest_boot_ns = 0
        self._offset_ns: int | None = None

    @property
    def offset_ns(self) -> int | None:
        """``monotonic - boot``, None before anything was heard."""
        return self._offset_ns

    def observe(self, boot_ns: int, received_ns: int) -> bool:
        """A stamped message arrived; True if it shows that the flight controller rebooted."""
        rebooted = self._newest_boot_ns - boot_ns > 2 * _STEP_NS
        if rebooted:
            self._restart()
        self._newest_boot_ns = max(self._newest_boot_ns, boot_ns)
        # The smallest difference is the message that was under way the shortest.
        self._lag.append((received_ns, received_ns - boot_ns))
        while self._lag and received_ns - self._lag[0][0] > _WINDOW_NS:
            self._lag.popleft()
        if not self._sync:
            self._offset_ns = min(lag for _, lag in self._lag)
            self.source = "minimum lag"
        return rebooted

    def timesync(self, boot_ns: int, sent_ns: int, received_ns: int) -> bool:
        """A TIMESYNC answer: tc1 = boot_ns to our ts1 = sent_ns; False when it is implausible."""
        round_trip = received_ns - sent_ns
        if not 0 <= round_trip <= _MAX_ROUND_TRIP_NS:
            return False
        offset = (sent_ns + received_ns) // 2 - boot_ns
        if self._sync and abs(offset - self._sync[-1][2]) > _STEP_NS:
            self._sync.clear()
        self._sync.append((received_ns, round_trip, offset))
        while received_ns - self._sync[0][0] > _WINDOW_NS:
            self._sync.popleft()
        _, self.round_trip_ns, self._offset_ns = min(self._sync, key=lambda sample: sample[1])
        self.source = "timesync"
        return True

    def to_monotonic(self, boot_ns: int, received_ns: int) -> int:
        """CLOCK_MONOTONIC of a boot time; never later than the message's arrival."""
        if self._offset_ns is None:
            return received_ns
        return min(boot_ns + self._offset_ns, received_ns)

    def _restart(self) -> None:
        self.reboots += 1
        self._lag.clear()
        self._sync.clear()
        self._offset_ns = None
        self._newest_boot_ns = 0
        self.source = "none"
