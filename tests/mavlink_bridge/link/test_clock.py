"""The flight controller's boot time on our clock: offset, rate, steps, reboots; GPS time."""

from __future__ import annotations

import random
from collections.abc import Iterator

import pytest

from mavlink_bridge.link.clock import BootClock, SteadyUtc, utc_us
from tests.mavlink_bridge.simulated import MS, SECOND


def answers(
    clock: BootClock, seconds: range, boot_s: float, rate: float = 1.0, trip_ms: float = 4.0
) -> Iterator[bool]:
    """TIMESYNC at 1 Hz from a clock that says boot_s at the first of `seconds`."""
    rng = random.Random(seconds.start)
    for s in seconds:
        sent_ns = s * SECOND
        out, back = (int(rng.uniform(0.3, trip_ms / 2.0) * MS) for _ in range(2))
        boot = boot_s * SECOND + rate * ((s - seconds.start) * SECOND + out)
        yield clock.timesync(int(boot), sent_ns, sent_ns + out + back)


def maps(clock: BootClock, boot_s: float, expected_s: float) -> None:
    """The clock maps a boot time within 3 ms."""
    got = clock.to_monotonic(int(boot_s * SECOND), int((expected_s + 10.0) * SECOND))
    assert got / SECOND == pytest.approx(expected_s, abs=0.003)


@pytest.mark.parametrize("rate", [5.0, 20.0, 0.5])
def test_a_clock_at_another_rate_is_measured_by_three_answers(rate: float) -> None:
    clock = BootClock()
    assert not any(answers(clock, range(100, 103), 10.0, rate))
    assert clock.rate == pytest.approx(rate, rel=0.01)
    assert not any(answers(clock, range(103, 130), 10.0 + 3 * rate, rate))
    assert clock.rate == pytest.approx(rate, rel=1e-3)
    assert clock.reboots == 0
    maps(clock, 10.0 + 29.5 * rate, 129.5)


def test_drift_of_two_crystals_is_followed() -> None:
    clock = BootClock()
    rate = 1.0 + 150e-6
    assert not any(answers(clock, range(100, 700), 10.0, rate, trip_ms=1.0))
    assert clock.rate == pytest.approx(rate, abs=60e-6)
    assert clock.steps == 0
    maps(clock, 10.0 + rate * 599.0, 699.0)


def test_noise_is_no_drift() -> None:
    clock = BootClock()
    assert not any(answers(clock, range(100, 140), 10.0, trip_ms=40.0))
    assert clock.rate == 1.0
    assert clock.steps == 0


def test_a_starved_simulation_that_falls_behind_is_no_reboot() -> None:
    clock = BootClock()
    boot_s = 10.0
    for second in range(100, 130):
        boot_s += 0.0 if second % 5 == 0 else 1.0  # it stands for 2 s now and then
        assert not any(answers(clock, range(second, second + 1), boot_s))
    assert clock.reboots == 0
    assert clock.steps > 0
    maps(clock, boot_s, 129.0)


def test_old_frames_that_come_late_are_no_reboot() -> None:
    clock = BootClock()
    for i in range(100):
        assert not clock.observe(50 * SECOND + i * 20 * MS, 100 * SECOND + i * 20 * MS)
        if i % 3 == 0:  # duplicates of frames 5 s ago, two at a time
            for late in (0, 20):
                assert not clock.observe(45 * SECOND + (i * 20 + late) * MS, 100 * SECOND)
    assert clock.reboots == 0
    assert clock.offset_ns == 50 * SECOND


def test_timesync_finds_the_offset_under_jitter() -> None:
    rng = random.Random(4)
    clock = BootClock()
    offset_ns = 77 * SECOND
    for i in range(30):
        sent_ns = 100 * SECOND + i * SECOND
        out, back = (int(rng.expovariate(1 / 5.0) * MS) + MS // 2 for _ in range(2))
        clock.timesync(sent_ns + out - offset_ns, sent_ns, sent_ns + out + back)
    assert clock.offset_ns == pytest.approx(offset_ns, abs=2 * MS)
    assert clock.source == "timesync"


def test_minimum_lag_bounds_the_offset_before_timesync() -> None:
    rng = random.Random(5)
    clock = BootClock()
    for i in range(100):
        boot = i * 20 * MS
        clock.observe(boot, boot + 50 * SECOND + 2 * MS + int(rng.expovariate(0.2) * MS))
    assert clock.offset_ns == pytest.approx(50 * SECOND + 2 * MS, abs=MS)
    assert clock.source == "minimum lag"


def test_implausible_timesync_answers_are_refused_and_stamps_never_later_than_their_arrival():
    clock = BootClock()
    assert not clock.timesync(0, 10 * SECOND, 9 * SECOND)
    assert not clock.timesync(0, 10 * SECOND, 12 * SECOND)
    assert clock.offset_ns is None
    clock.timesync(0, 10 * SECOND, 10 * SECOND + 2 * MS)
    assert clock.to_monotonic(5 * SECOND, 12 * SECOND) == 12 * SECOND


@pytest.mark.parametrize(
    ("utc_s", "ms", "expected"),
    [
        # 2024-01-01T00:00:00 UTC is GPS week 2295, second 86418 (18 leap seconds into Monday).
        (1_704_067_200, 0, (2295, 86_418_000)),
        (1_704_067_200, 250, (2295, 86_418_250)),
        # The start of GPS week 2400.
        (315_964_800 - 18 + 2400 * 604_800, -1, (2399, 604_799_999)),
        (315_964_800 - 18 + 2400 * 604_800, 0, (2400, 0)),
    ],
)
def test_gps_week_of_a_known_moment(utc_s: int, ms: int, expected: tuple[int, int]) -> None:
    utc = SteadyUtc(utc_ns=utc_s * SECOND, at_monotonic_ns=0)
    assert utc.gps_week_ms(ms * MS) == expected


def test_a_clock_that_was_never_set_gives_no_gps_time() -> None:
    utc = SteadyUtc(utc_ns=0, at_monotonic_ns=0)
    assert not utc.is_set
    assert utc.gps_week_ms(5 * SECOND) == (0, 0)
    assert SteadyUtc().is_set


def test_a_step_of_the_wall_clock_is_not_in_the_records(monkeypatch: pytest.MonkeyPatch) -> None:
    before = utc_us()
    monkeypatch.setattr("mavlink_bridge.link.clock.time.time_ns", lambda: 0)
    assert before <= utc_us() < before + 60_000_000
