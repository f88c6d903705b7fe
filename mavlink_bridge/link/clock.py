"""Clocks: CLOCK_MONOTONIC, UTC that cannot jump, and the flight controller's boot time.

The bridge uses CLOCK_MONOTONIC. The flight controller's time stamps count from its boot. TIMESYNC
measures the offset (midpoint of the fastest round trip); before its first answer the offset is
bounded by the smallest lag of stamped messages.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from functools import cache
from pathlib import Path

_BOOT = Path("/proc/sys/kernel/random/boot_id")
_WINDOW_NS = 30_000_000_000
_MAX_SAMPLES = 128
_RUN_BACK_NS = 1_000_000_000
_CONFIRMATIONS = 3  # stamps in a row, of a clock that ran back or ahead
_ALONE_NS = 500_000_000  # while no stamp was in time: no forged burst beside a vehicle that speaks
_CONTRADICTS_NS = 10_000_000_000  # of a TIMESYNC answer against stamps of now
_SILENCE_NS = 3_000_000_000
_MAX_ROUND_TRIP_NS = 500_000_000
_STAMP_GRAIN_NS = 1_000_000  # boot times are whole milliseconds in most messages
_DRIFT = 200e-6  # of two crystals against each other, at worst
_RATE_SPAN_NS = 5_000_000_000
_RATES = (0.01, 100.0)
GPS_EPOCH_UNIX_S = 315_964_800  # 1980-01-06 UTC
GPS_LEAP_SECONDS = 18  # GPS - UTC, unchanged since 2017-01-01
_WEEK_MS = 604_800_000
_NOT_BEFORE_UNIX_S = 1_672_531_200  # 2023-01-01: a clock that says less was never set


def monotonic_ns() -> int:
    """CLOCK_MONOTONIC, nanoseconds."""
    return time.monotonic_ns()


def boot_id() -> str:
    """Id of this computer's boot, with which CLOCK_MONOTONIC restarts; "" if unknown."""
    try:
        return _BOOT.read_text(encoding="ascii").strip()
    except OSError:
        return ""


class SteadyUtc:
    """UTC that cannot jump: it follows CLOCK_MONOTONIC from one reading of both clocks (None: now).

    If the wall clock steps in flight (NTP, GNSS), the timestamps of this flight do not.
    """

    def __init__(self, utc_ns: int | None = None, at_monotonic_ns: int | None = None) -> None:
        mono = monotonic_ns() if at_monotonic_ns is None else at_monotonic_ns
        self._offset_ns = (time.time_ns() if utc_ns is None else utc_ns) - mono

    def utc_ns(self, time_ns: int) -> int:
        """UTC (ns since 1970) of a CLOCK_MONOTONIC time."""
        return time_ns + self._offset_ns

    @property
    def is_set(self) -> bool:
        """Whether the wall clock was set: without a battery or network it starts before 2023."""
        return self.utc_ns(monotonic_ns()) >= _NOT_BEFORE_UNIX_S * 1_000_000_000

    def gps_week_ms(self, time_ns: int) -> tuple[int, int]:
        """GPS week and its milliseconds at a CLOCK_MONOTONIC time; (0, 0) if the clock is not set.

        ArduPilot takes week 0 for no time; any other sets its clock.
        """
        if self.utc_ns(time_ns) < _NOT_BEFORE_UNIX_S * 1_000_000_000:
            return 0, 0
        gps_ms = self.utc_ns(time_ns) // 1_000_000 - (GPS_EPOCH_UNIX_S - GPS_LEAP_SECONDS) * 1000
        return gps_ms // _WEEK_MS, gps_ms % _WEEK_MS


@cache
def process_utc() -> SteadyUtc:
    """The UTC clock of all records of this process, with one constant offset.

    A computer without a battery starts with a wrong time, and its clock steps when it gets a
    network. With the stepping clock, a message in the .tlog and the frame of the same moment would
    get times that differ by this step.
    """
    return SteadyUtc()


def utc_us() -> int:
    """Current UTC by `process_utc`, microseconds since 1970; for records."""
    return process_utc().utc_ns(monotonic_ns()) // 1000


@dataclass(frozen=True)
class _Sync:
    """One TIMESYNC answer: boot time at `middle_ns`, right within half the round trip."""

    middle_ns: int
    boot_ns: int
    round_trip_ns: int

    def agrees_with(self, other: _Sync, rate: float) -> bool:
        """Whether both answers can be of one clock that runs at `rate`."""
        elapsed = other.middle_ns - self.middle_ns
        apart = other.boot_ns - self.boot_ns - rate * elapsed
        trips = max(rate, 1.0) * (self.round_trip_ns + other.round_trip_ns) / 2.0
        return abs(apart) <= trips + _DRIFT * rate * abs(elapsed) + 2.0 * _STAMP_GRAIN_NS


class _StampRun:
    """Consecutive stamps, each after the one before, that contradict the known time."""

    def __init__(self) -> None:
        self._count = self._last_ns = 0

    def __bool__(self) -> bool:
        return self._count > 0

    def add(self, boot_ns: int) -> None:
        """Add a stamp; one before the last starts a new series."""
        self._count = self._count + 1 if boot_ns >= self._last_ns else 1
        self._last_ns = boot_ns

    def clear(self) -> None:
        """End the series, because a stamp agrees with the known time."""
        self._count = self._last_ns = 0

    def is_confirmed(self, alone_ns: int) -> bool:
        """Whether the series replaces the known time. alone_ns: since when no stamp agreed."""
        return self._count >= _CONFIRMATIONS and alone_ns >= _ALONE_NS


class BootClock:
    """Converts the flight controller's boot time to CLOCK_MONOTONIC; times in ns.

    ``monotonic = middle + (boot - boot of that middle) / rate``, from the fastest round trip of 30
    s. If two round trips contradict each other, the clock has stepped, or it runs at another rate;
    a third answer decides (a simulation at N times real speed runs at rate N). A boot time that
    decreases, or a clock that is behind after a silence, is a reboot. A single timestamp far ahead
    is treated as damaged.

    As long as plausible timestamps arrive, implausible ones are attributed to another sender,
    however many there are. Otherwise a sender could pretend a reboot, and forge another origin
    after it.
    """

    def __init__(self) -> None:
        self.reboots = 0
        self.steps = 0
        self.strays = 0
        self.contradictions = 0  # TIMESYNC answers that the stamps of then contradicted
        self.rate = 1.0
        self.source = "none"
        self.round_trip_ns: int | None = None
        self.answered_ns: int | None = None  # when the last TIMESYNC answer that counts came
        self._lag: deque[tuple[int, int]] = deque(maxlen=_MAX_SAMPLES)
        self._sync: deque[_Sync] = deque(maxlen=_MAX_SAMPLES)
        self._doubted: _Sync | None = None
        self._anchor: tuple[int, int] | None = None
        self._newest_boot_ns = self._newest_at_ns = 0
        self._in_time_ns = 0  # when the last stamp came that was
        self._behind, self._ahead = _StampRun(), _StampRun()

    @property
    def offset_ns(self) -> int | None:
        """``monotonic - boot`` at the last measurement; None before the first."""
        return None if self._anchor is None else self._anchor[0] - self._anchor[1]

    @property
    def is_stamp_doubtful(self) -> bool:
        """Whether the last time stamp does not fit the known offset: it is from another sender, or
        the first after a reboot.
        """
        return bool(self._behind) or bool(self._ahead)

    def observe(self, boot_ns: int, received_ns: int) -> bool:
        """Process a message: its boot time and the time of its reception (CLOCK_MONOTONIC), both
        ns. Returns True if the message shows that the autopilot has rebooted; all earlier
        observations are then discarded. Messages that are late or ahead of the clock are ignored.
        """
        rebooted = self._ran_back(boot_ns, received_ns)
        if self._behind:
            return False  # an old frame that came late, or the first ones after a reboot
        if rebooted:
            self._restart()
        elif self._runs_ahead(boot_ns, received_ns):
            return False
        self._in_time_ns = received_ns
        if boot_ns > self._newest_boot_ns:
            self._newest_boot_ns, self._newest_at_ns = boot_ns, received_ns
        # The smallest difference is the message that was under way the shortest.
        self._lag.append((received_ns, received_ns - boot_ns))
        while self._lag and received_ns - self._lag[0][0] > _WINDOW_NS:
            self._lag.popleft()
        if not self._sync:
            self._anchor = (boot_ns + min(lag for _, lag in self._lag), boot_ns)
            self.source = "minimum lag"
        return rebooted

    def timesync(self, boot_ns: int, sent_ns: int, received_ns: int) -> bool:
        """Process a TIMESYNC answer (tc1 = boot_ns, ts1 = sent_ns); True if it shows a reboot.
        Ignored after a round trip of over 0.5 s, or if it contradicts the stamps of now.
        """
        round_trip = received_ns - sent_ns
        if not 0 <= round_trip <= _MAX_ROUND_TRIP_NS or self._contradicts(boot_ns, received_ns):
            return False
        self.answered_ns = received_ns
        sample = _Sync((sent_ns + received_ns) // 2, boot_ns, round_trip)
        rebooted = False
        if self._sync and not self._sync[-1].agrees_with(sample, self.rate):
            rebooted = self._resolve_contradiction(sample)
        else:
            self._doubted = None
            self._sync.append(sample)
        self._fit(received_ns)
        return rebooted

    def to_monotonic(self, boot_ns: int, received_ns: int) -> int:
        """CLOCK_MONOTONIC of a boot time; received_ns (arrival) at most, and if unknown."""
        if self._anchor is None:
            return received_ns
        middle_ns, at_ns = self._anchor
        return min(middle_ns + round((boot_ns - at_ns) / self.rate), received_ns)

    def _contradicts(self, boot_ns: int, received_ns: int) -> bool:
        """Whether current stamps differ from a TIMESYNC answer by more than 10 s; counts those."""
        since_ns = received_ns - self._in_time_ns
        if not self._newest_boot_ns or since_ns > _ALONE_NS:
            return False
        expected_ns = self._newest_boot_ns + self.rate * (received_ns - self._newest_at_ns)
        wrong = abs(boot_ns - expected_ns) > _CONTRADICTS_NS * max(self.rate, 1.0)
        self.contradictions += wrong
        return wrong

    def _ran_back(self, boot_ns: int, received_ns: int) -> bool:
        """Whether the boot time restarted: several stamps in a row, each after the one before.

        A single stamp may be of an old frame that was duplicated or came late.
        """
        if self._newest_boot_ns - boot_ns <= _RUN_BACK_NS:
            self.strays += bool(self._behind)
            self._behind.clear()
            return False
        self._behind.add(boot_ns)
        if not self._behind.is_confirmed(received_ns - self._in_time_ns):
            return False
        self._behind.clear()
        return True

    def _runs_ahead(self, boot_ns: int, received_ns: int) -> bool:
        """Whether a stamp is ahead of the elapsed time, and this is not yet confirmed."""
        passed = max(self.rate, 1.0) * (received_ns - self._newest_at_ns)
        if not self._newest_boot_ns or boot_ns - self._newest_boot_ns <= passed + _RUN_BACK_NS:
            self.strays += bool(self._ahead)
            self._ahead.clear()
            return False
        self._ahead.add(boot_ns)
        if not self._ahead.is_confirmed(received_ns - self._in_time_ns):
            return True
        self._ahead.clear()
        return False

    def _resolve_contradiction(self, sample: _Sync) -> bool:
        """An answer contradicts the last: another rate, or a step; True for a reboot."""
        before, last = self._doubted, self._sync[-1]
        elapsed = sample.middle_ns - last.middle_ns
        rate = (sample.boot_ns - last.boot_ns) / elapsed if elapsed > 0 else 0.0
        self._sync.clear()
        self._doubted = last
        if before is not None and _RATES[0] < rate < _RATES[1] and before.agrees_with(sample, rate):
            self.rate = rate
            self._sync.extend((before, last, sample))
            return False
        self.steps += 1
        behind = last.boot_ns + self.rate * elapsed - sample.boot_ns
        # Only after a silence: a reboot between two answers shows in stamps that run back, and a
        # simulation that is starved falls behind without one.
        rebooted = elapsed > _SILENCE_NS and behind > (
            _RUN_BACK_NS + max(self.rate - 1.0, 0.0) * elapsed
        )
        if rebooted:
            self._restart()
            self._newest_boot_ns, self._newest_at_ns = sample.boot_ns, sample.middle_ns
        self._sync.append(sample)
        return rebooted

    def _fit(self, now_ns: int) -> None:
        while now_ns - self._sync[0].middle_ns > _WINDOW_NS:
            self._sync.popleft()
        best = min(self._sync, key=lambda sample: sample.round_trip_ns)
        self.round_trip_ns, self._anchor = best.round_trip_ns, (best.middle_ns, best.boot_ns)
        self.source = "timesync"
        first, last = self._sync[0], self._sync[-1]
        span = last.middle_ns - first.middle_ns
        if span >= _RATE_SPAN_NS:
            measured = (last.boot_ns - first.boot_ns) / span
            error = (first.round_trip_ns + last.round_trip_ns) / 2.0 / span
            # Equal rates within the error of the measurement are equal: noise is no drift.
            self.rate = 1.0 if abs(measured - 1.0) <= error else measured

    def _restart(self) -> None:
        self.reboots += 1
        self._lag.clear()
        self._sync.clear()
        self._doubted = None
        self._behind.clear()
        self._ahead.clear()
        self._anchor = self.answered_ns = None
        self.rate = 1.0
        self._newest_boot_ns = self._newest_at_ns = 0
        self.source = "none"
