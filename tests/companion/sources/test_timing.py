"""Exposure times from stamps, with simulated clocks."""

from __future__ import annotations

import numpy as np
import pytest

from companion.sources.timing import (
    UUID,
    ExposureClock,
    MinimumLag,
    MispTime,
    Timing,
    parse_message,
    sei_nal,
    system_minus_monotonic,
)

MS = 1_000_000


class Clocks:
    """Both of a computer, in place of the module `time`: each reading takes a microsecond."""

    def __init__(self) -> None:
        self.now_ns = 10**13
        self.offset_ns = 1_790_000_000 * 10**9
        self.waits_ns: list[int] = []  # for another thread's turn, after the readings to come

    def monotonic_ns(self) -> int:
        self.now_ns += 1000
        return self.now_ns

    def time_ns(self) -> int:
        reading = self.monotonic_ns() + self.offset_ns
        self.now_ns += self.waits_ns.pop(0) if self.waits_ns else 0
        return reading


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> Clocks:
    it = Clocks()
    monkeypatch.setattr("companion.sources.timing.time", it)
    return it


def test_a_misp_stamp_survives_the_round_trip_and_matches_the_standards_layout() -> None:
    stamp = MispTime(0x0005_1A2B_3C4D_5E6F, locked=True)
    nal = sei_nal(stamp)
    assert nal[:7] == bytes([0, 0, 0, 1, 6, 5, 28])
    assert nal[7:23] == UUID == bytes.fromhex("4d4953506d6963726f73656374696d65")
    assert nal[23:35].hex() == "1f" + "0005ff1a2bff3c4dff5e6f"
    assert nal[-1] == 0x80
    assert parse_message(nal[7:-1]) == stamp
    assert parse_message(sei_nal(MispTime(1, locked=False))[7:-1]) == MispTime(1, locked=False)


@pytest.mark.parametrize("time_us", [0, 0x0000_0100_0000_0000, 2**64 - 1])
def test_no_start_code_appears_in_a_stamp(time_us: int) -> None:
    message = sei_nal(MispTime(time_us, locked=True))[4:]
    assert not any(message[i : i + 2] == b"\0\0" and message[i + 2] <= 3
                   for i in range(len(message) - 2))  # fmt: skip


@pytest.mark.parametrize(
    "message", [b"x264 - core 164" + bytes(40), UUID + b"\x1f" + bytes(11), UUID]
)
def test_other_sei_messages_are_not_stamps(message: bytes) -> None:
    assert parse_message(message) is None


def test_the_smallest_lag_finds_the_senders_clock_under_jitter() -> None:
    rng = np.random.default_rng(3)
    clock = MinimumLag(latency_ns=40 * MS)
    true = 10**12 + np.arange(300) * 100 * MS
    arrival = true + 40 * MS + (rng.exponential(15, 300) * MS).astype(int)
    arrival = np.maximum.accumulate(arrival)
    sender = true - 987_654_321_000  # another epoch
    mapped = np.array([clock.map(int(s), int(a)) for s, a in zip(sender, arrival, strict=True)])
    assert np.abs(mapped - true)[50:].max() < 3 * MS
    assert (np.diff(mapped) >= 0).all()


def test_the_smallest_lag_follows_a_slow_clock() -> None:
    clock = MinimumLag()
    true = np.arange(3000) * 100 * MS  # five minutes
    sender = (true * (1 - 50e-6)).astype(int)  # 50 ppm slow: 15 ms behind at the end
    mapped = [clock.map(int(s), int(t)) for s, t in zip(sender, true, strict=True)]
    assert abs(mapped[-1] - true[-1]) < 1.1 * MS


def test_a_sender_that_starts_again_is_taken_up_at_once() -> None:
    clock = MinimumLag()
    clock.map(500 * 10**9, 100 * 10**9)
    assert clock.map(0, 101 * 10**9) == 101 * 10**9
    assert clock.map(100 * 10**9, 102 * 10**9) == 102 * 10**9


def _locked_misp(clocks: Clocks) -> MispTime:
    return MispTime((clocks.now_ns - 60 * MS + clocks.offset_ns) // 1000, locked=True)


@pytest.mark.parametrize(
    ("pts", "misp", "device", "age_ms"),
    [
        # A locked MISP stamp is taken as it is, and the latency setting is not.
        (lambda _: 7, _locked_misp, False, 60),
        # Device stamps on the monotonic clock are exposure times, those on the wall clock are not.
        (lambda c: c.now_ns - 25 * MS, lambda _: None, True, 25),
        (lambda c: c.time_ns(), lambda _: None, True, 30),
        # Without any stamp the arrival less the latency is left.
        (lambda _: None, lambda _: None, False, 30),
    ],
)
def test_the_best_stamp_gives_the_exposure(clocks, pts, misp, device, age_ms):
    now, clock = clocks.now_ns, ExposureClock(latency_ns=30 * MS, device=device)
    exposed = clock.exposure_time(pts(clocks), misp(clocks), now)
    assert now - exposed == pytest.approx(age_ms * MS, abs=0.1 * MS)


@pytest.mark.parametrize(
    ("offset_ns", "locked"), [(0, False), (3600 * 10**9, True), (-5 * 10**9, True)]
)
def test_a_misp_clock_that_is_not_ours_gives_differences_only(clocks, offset_ns, locked, caplog):
    now = clocks.now_ns
    clock = ExposureClock(latency_ns=30 * MS)
    for i, lag in enumerate([30, 55, 48]):
        true = now + i * 100 * MS
        misp = MispTime((true + offset_ns + clocks.offset_ns) // 1000, locked)
        result = clock.exposure_time(None, misp, true + lag * MS)
        assert result == pytest.approx(true, abs=0.2 * MS)
    assert caplog.text.count("MISP clock") == 1


@pytest.mark.parametrize("step_s", [0.0, 0.3, -0.1])
def test_a_step_of_the_wall_clock_is_told_and_enters_no_exposure_time(clocks, caplog, step_s):
    clock, camera_offset_ns = ExposureClock(0), clocks.offset_ns

    def seen() -> int:
        """Age of a frame that was exposed 0.12 s ago by the camera's clock, ns."""
        clocks.now_ns += 100 * MS
        now = clocks.now_ns
        stamp = MispTime((now - 120 * MS + camera_offset_ns) // 1000, locked=True)
        return now - clock.exposure_time(None, stamp, now)

    assert seen() == pytest.approx(120e6, abs=0.1e6)
    clocks.offset_ns += round(step_s * 1e9)
    for _ in range(3):
        assert seen() == pytest.approx(120e6, abs=0.1e6)
    camera_offset_ns += round(step_s * 1e9)  # the camera follows, whose clock hangs on ours
    # A lag that grew may be the line's: it is the camera's once the smaller one is forgotten.
    ages = [seen() for _ in range(230)]
    assert ages[200:] == pytest.approx([120e6] * 30, abs=0.1e6)
    assert step_s < 0 or ages == pytest.approx([120e6] * 230, abs=0.1e6)
    told = [r.getMessage() for r in caplog.records if "clock was stepped" in r.getMessage()]
    assert len(told) == (1 if step_s else 0)
    assert all(f"{step_s:+.1f}" in text for text in told)


def test_a_camera_that_loses_its_reference_keeps_its_times(clocks: Clocks) -> None:
    """As one does whose clock hangs on the GNSS that is denied: the status bit falls, no more."""
    clock = ExposureClock(latency_ns=0)
    for k in range(40):
        clocks.now_ns += 100 * MS
        now = clocks.now_ns
        lag = (120 + 7 * (k % 3)) * MS
        misp = MispTime((now - lag + clocks.offset_ns) // 1000, locked=k < 20)
        exposed = clock.exposure_time(None, misp, now)
        if k > 5:
            assert exposed == pytest.approx(now - lag, abs=0.2 * MS)


@pytest.mark.parametrize(("waits_ms", "off_ns"), [([50, 7], 2000), ([50, 7, 1, 9, 20], 0.51 * MS)])
def test_another_thread_between_two_readings_costs_little(clocks, waits_ms, off_ns):
    """Nothing where two of five are close; where none are, the closest count."""
    clocks.waits_ns = [wait * MS for wait in waits_ms]
    assert system_minus_monotonic() == pytest.approx(clocks.offset_ns, abs=off_ns)


@pytest.mark.parametrize("device", [False, True])
@pytest.mark.parametrize("timing", ["auto", "pts"])
def test_no_stamp_whatever_it_says_makes_a_frame_of_the_future_or_of_long_ago(
    timing: Timing, device: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stamps that repeat, run back, leap by hours and stop, and a wall clock that is stepped."""
    rng = np.random.default_rng(5)
    wall_ns = [10**18]
    monkeypatch.setattr("companion.sources.timing.system_minus_monotonic", lambda: wall_ns[0])
    clock = ExposureClock(30 * MS, timing, device=device)
    leaps = [0, 0, 0, 1, -1, 40 * MS, -40 * MS, 10**9, -(10**9), 3600 * 10**9, -3600 * 10**9]
    arrival, pts, misp = 10**13, 10**13, 10**13
    good = []
    for k in range(3000):
        restless = k < 2000
        arrival += 50 * MS
        pts, misp = pts + 50 * MS, misp + 50 * MS
        if restless:
            pts += int(rng.choice(leaps))
            misp += int(rng.choice(leaps))
            wall_ns[0] += int(rng.choice(leaps)) if rng.random() < 0.05 else 0
        stamp = MispTime(max(misp + 10**18, 0) // 1000, locked=bool(rng.random() < 0.8))
        stamps = (
            None if restless and rng.random() < 0.1 else pts,
            None if restless and rng.random() < 0.2 else stamp,
        )
        late = int(rng.exponential(10 * MS))
        exposed = clock.exposure_time(*stamps, arrival + late)
        assert -4 * 10**9 <= exposed - (arrival + late) <= 5 * MS
        good.append(exposed - arrival)
    assert np.ptp(good[2500:]) < 5 * MS  # steady again within half a minute
