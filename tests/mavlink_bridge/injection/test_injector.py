"""The injector by itself: timing, covariance, reset counter, yaw guard, bounds."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.config import InjectionConfig
from mavlink_bridge.injection.encode import DIAGONAL, EncodedMessage, InjectionContext
from mavlink_bridge.injection.injector import Injector
from mavlink_bridge.link.clock import SteadyUtc
from mavlink_bridge.messages import Attitude, Origin, VisionFix
from mavlink_bridge.quaternion import from_euler
from mavlink_bridge.vehicle.profile import ARDUPILOT, ARDUPILOT_SQRT, PX4, FirmwareProfile
from tests.mavlink_bridge.simulated import GEOID, HOME, METRE, MS, SECOND

ORIGIN = Origin(*HOME, 488.0)


def context(
    origin: Origin | None = ORIGIN,
    profile: FirmwareProfile = ARDUPILOT,
    yaw: float = 0.0,
    yaw_error_deg: Callable[[float], float] = lambda _: 0.0,
) -> InjectionContext:
    """yaw_error_deg: the error of the estimated yaw by seconds; the gyros are right."""

    def attitude_at(time_ns: int) -> Attitude:
        estimated = yaw + math.radians(yaw_error_deg(time_ns / SECOND))
        q = from_euler(0.0, 0.0, estimated)
        return Attitude(time_ns, 0.0, 0.0, estimated, q, gyro_heading_rad=0.7)

    return InjectionContext(origin, profile, attitude_at)


def injector(**options: Any) -> Injector:
    utc = SteadyUtc(utc_ns=1_700_000_000 * SECOND, at_monotonic_ns=0)
    return Injector(InjectionConfig(**options), GEOID, utc)


def fix(
    time_ns: int, north: float = 0.0, east: float = 0.0, yaw_rad: float | None = 0.0, **options: Any
) -> VisionFix:
    options.setdefault("position_covariance_ned", np.eye(3) * 0.25)
    return VisionFix(
        time_ns,
        HOME[0] + north * METRE,
        HOME[1] + east * METRE / math.cos(math.radians(HOME[0])),
        488.0 + GEOID + 60.0,
        None if yaw_rad is None else from_euler(0.0, 0.0, yaw_rad),
        **options,
    )


def fly(
    it: Injector,
    *,
    seconds: float,
    fix_hz: float,
    latency_ms: float,
    speed: float = 0.0,
    where: InjectionContext | None = None,
    start: int = SECOND,
    change: Any = None,
) -> list[tuple[int, EncodedMessage]]:
    """Feed fixes of a vehicle that flies north, in 1 ms steps; (send time, injection) of each."""
    sent = []
    arriving: list[tuple[int, VisionFix]] = []
    period = int(SECOND / fix_hz)
    for t in range(start, start + int(seconds * SECOND), MS):
        if (t - start) % period < MS:
            f = fix(t, north=speed * t / SECOND)
            f = change(f) if change else f
            if f is not None:
                arriving.append((t + int(latency_ms * MS), f))
        while arriving and arriving[0][0] <= t:
            it.submit(arriving.pop(0)[1], t)
        injection = it.step(t, where or context())
        if injection is not None:
            sent.append((t, injection))
    return sent


def test_fix_is_sent_at_the_configured_delay_with_its_exposure_time() -> None:
    it = injector(rate_hz=10, delay_ms=100)
    assert (
        it.latency.median_ms is it.guard.difference_rad is it.guard.refused_rad is None
    )  # not yet known
    sent = fly(it, seconds=3, fix_hz=10, latency_ms=40)
    assert it.latency.median_ms == pytest.approx(40.0)
    lags = {(t - i.estimate.position.time_ns) // MS for t, i in sent}
    assert lags == {100}
    assert all(i.estimate.fresh for _, i in sent)
    assert sent[0][1].message.usec == sent[0][1].estimate.position.time_ns // 1000


def test_slow_fixes_are_propagated_to_a_steady_rate_and_least_lag_stays_the_delay() -> None:
    it = injector(rate_hz=20, delay_ms=100)
    sent = fly(it, seconds=6, fix_hz=4, latency_ms=150, speed=10.0)
    late = [(t, i) for t, i in sent if t > 3 * SECOND]
    rate = len(late) / 4.0
    assert 18 <= rate <= 26
    lags = [(t - i.estimate.position.time_ns) / MS for t, i in late]
    assert min(lags) == pytest.approx(100.0, abs=1.0)
    gaps = np.diff([t for t, _ in late]) / MS
    assert gaps.max() <= 76.0
    assert np.diff([i.message.usec for _, i in sent]).min() > 0  # stamps never run back
    # Where the vehicle was at the stamp, not where the last fix saw it.
    errors = [i.message.x - 10.0 * i.estimate.position.time_ns / SECOND for _, i in late]
    assert np.abs(errors).max() < 0.3


@pytest.mark.parametrize(
    ("fix_hz", "latency_ms"), [(10, 150), (9.8, 215), (8, 150), (15, 100), (5, 180)]
)
def test_what_is_sent_between_fixes_makes_none_of_them_late(fix_hz, latency_ms):
    """Later than the delay, a fix meets a later state of the EKF: 27 ms were 0.7 m at 25 m/s."""
    it = injector(rate_hz=20, delay_ms=220)
    sent = fly(it, seconds=8, fix_hz=fix_hz, latency_ms=latency_ms, speed=25.0)
    steady = [(t, i.estimate) for t, i in sent if t > 3 * SECOND]
    lags = [(t - e.position.time_ns) / MS for t, e in steady if e.fresh]
    assert len(lags) == pytest.approx(fix_hz * 6, abs=2)  # and none was given up for another
    assert max(lags) <= 221.5
    assert len(steady) / 6 >= 19  # the steady rate is kept


def test_rate_never_passes_what_ardupilot_drops() -> None:
    it = injector(rate_hz=30, delay_ms=100)
    sent = fly(it, seconds=3, fix_hz=90, latency_ms=50)
    gaps = np.diff([t for t, _ in sent]) / SECOND
    assert (1.0 / gaps).max() <= 50.0


@pytest.mark.parametrize("climb", [4.0, -4.0])
def test_a_fix_too_old_to_fuse_is_carried_on_forwards_and_upwards(climb: float) -> None:
    it = injector(rate_hz=10, delay_ms=200)

    def height_m(time_ns: int) -> float:
        return 600.0 + climb * time_ns / SECOND

    sent = fly(
        it, seconds=4, fix_hz=10, latency_ms=400, speed=8.0,
        change=lambda f: replace(f, height_m=height_m(f.time_ns)),
    )  # fmt: skip
    assert not any(i.estimate.fresh for _, i in sent)
    assert {(t - i.estimate.position.time_ns) // MS for t, i in sent} == {200}
    steady = [i for t, i in sent if t > 3 * SECOND]
    assert max(abs(i.message.x - 8.0 * i.message.usec * 1e-6) for i in steady) < 0.2
    positions = [i.estimate.position for i in steady]
    assert max(abs(p.height_m - height_m(p.time_ns)) for p in positions) < 0.2


def test_covariance_grows_between_fixes_and_sending_ends_at_the_bound() -> None:
    it = injector(
        rate_hz=20, delay_ms=0, max_sigma_m=2.0, max_extrapolation_s=5.0, overdue_intervals=1000.0
    )
    for k in range(20):
        it.submit(fix(SECOND + k * 100 * MS), SECOND + k * 100 * MS)
        it.step(SECOND + k * 100 * MS, context())
    last = SECOND + 1900 * MS
    sigmas = []
    for t in range(last + MS, last + 6 * SECOND, MS):
        injection = it.step(t, context())
        if injection is not None:
            sigmas.append(injection.estimate.position.horizontal_sigma_m)
    assert sigmas == sorted(sigmas)
    assert sigmas[0] < 0.7
    assert 1.5 < sigmas[-1] <= 2.0
    assert it.counters["withheld_covariance"] > 10
    assert it.reason.id in (AlertId.SIGMA_OVER_LIMIT, AlertId.NO_FRESH_FIX)


@pytest.mark.parametrize(("fix_hz", "silent_after_s"), [(10, 0.2), (5, 0.4), (1, 0.5)])
def test_sending_ends_when_the_next_fix_is_overdue(fix_hz: float, silent_after_s: float) -> None:
    it = injector(rate_hz=20, delay_ms=0)

    def until_6_s(f: VisionFix) -> VisionFix | None:
        return f if f.time_ns <= 6 * SECOND else None

    sent = fly(it, seconds=9, fix_hz=fix_hz, latency_ms=0, change=until_6_s)
    last = max(t for t, _ in sent) / SECOND
    assert 6.0 + silent_after_s - 0.06 <= last <= 6.0 + silent_after_s
    assert it.reason == alert(AlertId.NO_FRESH_FIX)


def firmware_error_m(covariance: Any, profile: FirmwareProfile) -> float:
    """What ArduPilot makes of the message's covariance."""
    if profile is ARDUPILOT:  # GCS_Common.cpp: cbrtf(sq(c0) + sq(c6) + sq(c11))
        return float(sum(covariance[i] ** 2 for i in DIAGONAL[:3]) ** (1 / 3))
    return math.sqrt(sum(covariance[i] for i in DIAGONAL[:3]))  # pull request 32084


@pytest.mark.parametrize("profile", [ARDUPILOT, ARDUPILOT_SQRT])
@pytest.mark.parametrize("sigma", [0.6, 2.0])
def test_ardupilot_reads_the_worst_axis(profile: FirmwareProfile, sigma: float) -> None:
    """A street seen along: 2 m along it, half a metre across. One number has to do."""
    turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    it = injector(rate_hz=10, delay_ms=0, sigma_floor_m=1e-6)
    P = turn @ np.diag([sigma**2, 0.25, 0.01]) @ turn.T
    it.submit(fix(SECOND, position_covariance_ned=P), SECOND)
    covariance = it.step(SECOND, context(profile=profile)).message.covariance  # type: ignore[union-attr]
    assert firmware_error_m(covariance, profile) == pytest.approx(sigma, rel=1e-4)


def test_reset_of_a_fix_that_is_not_sent_itself_is_not_lost() -> None:
    it = injector(rate_hz=10, delay_ms=0)
    it.submit(fix(SECOND), SECOND)
    it.step(SECOND, context())
    # Two fixes inside one slot: the older is the first after the jump, and is superseded.
    it.submit(fix(SECOND + 10 * MS, north=10.0, reset_count=1), SECOND + 10 * MS)
    it.submit(fix(SECOND + 20 * MS, north=10.0, reset_count=1), SECOND + 20 * MS)
    it.step(SECOND + 20 * MS, context())
    sent = None
    for t in range(SECOND + 21 * MS, SECOND + 200 * MS, MS):
        sent = sent or it.step(t, context())
    assert sent.message.reset_counter == 1
    assert sent.message.x == pytest.approx(10.0, abs=0.1)


def turned_by(schedule: Any) -> Any:
    """Fixes whose yaw differs from the autopilot's by schedule(seconds) degrees."""
    return lambda f: fix(f.time_ns, yaw_rad=math.radians(schedule(f.time_ns / SECOND)))


def test_frame_that_rotates_in_flight_is_refused_at_once_and_released_when_right_again() -> None:
    it = injector(rate_hz=10, delay_ms=0)
    change = turned_by(lambda t: 5.0 if 3.0 <= t < 6.0 else 0.3)
    sent = fly(it, seconds=8, fix_hz=10, latency_ms=0, change=change)
    exposures = [i.estimate.position.time_ns / SECOND for _, i in sent if i.estimate.fresh]
    assert not [t for t in exposures if 3.0 <= t < 6.3]
    assert [t for t in exposures if t > 6.7]
    assert it.counters["fixes_yaw_refused"] == 34  # 30 rotated, 4 on probation


def test_frame_that_turns_towards_a_wrong_yaw_of_the_autopilot_is_refused() -> None:
    it = injector(rate_hz=10, delay_ms=0)
    where = context(yaw_error_deg=lambda _: 2.5)
    change = turned_by(lambda t: 5.0 if t >= 3.0 else 0.0)
    sent = fly(it, seconds=6, fix_hz=10, latency_ms=0, where=where, change=change)
    assert max(i.estimate.position.time_ns for _, i in sent if i.estimate.fresh) < 3 * SECOND
    assert it.counters["fixes_yaw_refused"] == 40


def test_announced_turn_towards_the_autopilots_yaw_is_taken() -> None:
    it = injector(rate_hz=10, delay_ms=0)

    def relocalized(f: VisionFix) -> VisionFix:
        jumps = f.time_ns >= 3 * SECOND
        return fix(f.time_ns, yaw_rad=math.radians(-1.0 if jumps else 3.0), reset_count=int(jumps))

    sent = fly(it, seconds=6, fix_hz=10, latency_ms=0, change=relocalized)
    assert max(i.estimate.position.time_ns for _, i in sent) > 5.5 * SECOND
    assert it.counters["fixes_yaw_refused"] == 0


@pytest.mark.parametrize(
    "error",
    [
        lambda t: -min(t, 8.0),  # hover on ODOMETRY: 6 deg in seconds
        lambda t: -8.0 if t > 4.0 else 0.0,  # aligned again in flight
    ],
)
def test_autopilots_own_yaw_error_does_not_withhold_vision(error: Any) -> None:
    it = injector(rate_hz=10, delay_ms=0)
    sent = fly(it, seconds=12, fix_hz=10, latency_ms=0, where=context(yaw_error_deg=error))
    assert len(sent) >= 118
    assert it.counters["fixes_yaw_refused"] == 0
    assert math.degrees(it.guard.difference_rad) == pytest.approx(8.0)


def test_gross_difference_is_refused_however_slowly_it_came() -> None:
    it = injector(rate_hz=10, delay_ms=0)
    where = context(yaw_error_deg=lambda t: t - 1.0)
    sent = fly(it, seconds=30, fix_hz=10, latency_ms=0, where=where)
    assert 20 * SECOND < max(i.estimate.position.time_ns for _, i in sent) <= 22 * SECOND


@pytest.mark.parametrize(("memory_s", "taken"), [(60.0, True), (2.0, False)])
def test_gyros_are_trusted_over_a_dropout_and_not_over_a_long_one(monkeypatch, memory_s, taken):
    """They drift: what they say of a minute ago is no evidence against the autopilot's yaw."""
    monkeypatch.setattr("mavlink_bridge.injection.injector._MEMORY_S", memory_s)
    it = injector(rate_hz=10, delay_ms=0)
    where = context(yaw_error_deg=lambda t: 6.0 if t > 5.0 else 0.0)

    def dropout(f: VisionFix) -> VisionFix | None:
        return None if 4 * SECOND <= f.time_ns < 10 * SECOND else f

    sent = fly(it, seconds=11, fix_hz=10, latency_ms=0, where=where, change=dropout)
    assert any(t > 10 * SECOND and i.estimate.fresh for t, i in sent) is taken
    assert it.guard.blocked is not taken


def test_what_was_refused_is_released_by_a_tighter_limit_than_it_was_held_to() -> None:
    """A frame at the limit itself would be sent and withheld by turns."""
    it = injector(rate_hz=10, delay_ms=0)
    change = turned_by(lambda t: 5.0 if t < 3.0 else 3.0 if t < 6.0 else 2.0)
    sent = fly(it, seconds=8, fix_hz=10, latency_ms=0, change=change)
    assert 6 * SECOND < min(t for t, _ in sent) < 7 * SECOND
    never_turned = injector(rate_hz=10, delay_ms=0)
    change = turned_by(lambda _: 3.0)
    sent = fly(never_turned, seconds=3, fix_hz=10, latency_ms=0, change=change)
    assert never_turned.counters["fixes_yaw_refused"] == 0
    assert len(sent) >= 28


def test_single_wild_yaw_is_dropped_without_blocking() -> None:
    it = injector(rate_hz=10, delay_ms=0)

    def wild(f: VisionFix) -> VisionFix:
        return fix(f.time_ns, yaw_rad=1.5, north=50.0) if f.time_ns == 3 * SECOND else f

    sent = fly(it, seconds=4, fix_hz=10, latency_ms=0, change=wild)
    assert max(abs(i.message.x) for _, i in sent) < 1.0
    assert it.counters["fixes_yaw_refused"] == 1


@pytest.mark.parametrize(
    ("origin", "reason"),
    [(None, AlertId.EKF_NO_ORIGIN), (Origin(HOME[0], -60.0, 480.0), AlertId.EKF_ORIGIN_FAR)],
)
def test_without_a_near_origin_nothing_local_is_sent_and_the_reason_says_so(origin, reason):
    it = injector(rate_hz=10, delay_ms=0)
    assert fly(it, seconds=1, fix_hz=10, latency_ms=0, where=context(origin=origin)) == []
    assert it.reason.id is reason


def test_late_future_and_unordered_fixes_are_dropped_and_counted() -> None:
    it = injector()
    it.submit(fix(10 * SECOND), 10 * SECOND)
    it.submit(fix(9 * SECOND), 10 * SECOND)
    it.submit(fix(12 * SECOND), 11 * SECOND)
    it.submit(fix(11 * SECOND), 20 * SECOND)
    assert it.counters["fixes"] == 1
    assert it.counters["fixes_out_of_order"] == 1
    assert it.counters["fixes_from_future"] == 1
    assert it.counters["fixes_stale"] == 1


def test_unknown_attitude_is_sent_as_nan() -> None:
    it = injector(delay_ms=0)
    unknown = fix(SECOND, yaw_rad=None)
    it.submit(unknown, SECOND)
    message = it.step(SECOND, context()).message  # type: ignore[union-attr]
    assert math.isnan(message.yaw)


@pytest.mark.parametrize("latency_ms", [0, 400])
def test_each_velocity_is_sent_once_in_the_frames_that_ardupilot_accepts(latency_ms: float) -> None:
    """Also of fixes that are too old to be sent as they are."""
    it = injector(message="odometry", rate_hz=20, delay_ms=0)

    def measured(f: VisionFix) -> VisionFix:
        return replace(f, velocity_ned=(5.0, 0.0, 0.0))

    sent = fly(it, seconds=4, fix_hz=10, latency_ms=latency_ms, speed=5.0, change=measured)
    known = [math.isfinite(i.message.vx) for _, i in sent]
    assert known.count(True) == pytest.approx(40 - latency_ms // 100, abs=2)
    assert known.count(False) >= 25
    assert not any(i.message.vx == 0.0 for t, i in sent if t > 2 * SECOND)
    assert {(i.message.frame_id, i.message.child_frame_id) for _, i in sent} == {(20, 12)}


def test_a_velocity_that_is_derived_from_positions_is_not_sent() -> None:
    """On PX4's interface the EKF passed a jump of 20 m by 1 m; on ArduPilot it ended in LAND."""
    it = injector(message="odometry", delay_ms=0)
    sent = fly(it, seconds=1, fix_hz=10, latency_ms=0, speed=5.0)
    assert len(sent) > 8
    assert all(math.isnan(v) for _, i in sent for v in (i.message.vx, i.message.vy, i.message.vz))
    assert all(math.isnan(i.message.velocity_covariance[0]) for _, i in sent)


def test_gps_input_fills_every_field() -> None:
    it = injector(message="gps_input", rate_hz=5, delay_ms=100, gps_yaw=True)
    sent = fly(it, seconds=4, fix_hz=5, latency_ms=40, speed=10.0, where=context(origin=None))
    t, injection = sent[-1]
    m = injection.message
    assert m.fix_type == 3
    assert m.satellites_visible >= 6
    assert m.hdop < 1.4
    assert m.ignore_flags == 0
    assert m.alt == pytest.approx(548.0, abs=0.01)
    assert m.yaw == 36000
    assert m.vn == pytest.approx(10.0, abs=0.3)
    gps_s = 1_700_000_000 + m.time_usec * 1e-6 - 315_964_800 + 18
    assert m.time_week == int(gps_s // 604800)
    assert m.time_week_ms == pytest.approx(gps_s % 604800 * 1000, abs=1.1)
    assert (t - injection.estimate.position.time_ns) / MS == pytest.approx(100.0, abs=1.0)


def test_gps_input_claims_no_more_than_its_protection_level() -> None:
    """12 satellites and a dilution of 0.8 were claimed of anything, 9 m of error included."""
    said = []
    for level_m in (1.0, 3.0, 6.0, 9.0, 10.4, 11.0):
        it = injector(message="gps_input", rate_hz=5, delay_ms=0, alert_limit_m=10.0)
        it.submit(fix(SECOND, protection_m=(level_m, 2.0 * level_m)), SECOND)
        m = it.step(SECOND, context()).message  # type: ignore[union-attr]
        said.append((m.satellites_visible, m.hdop, m.vdop))
    satellites, hdop, vdop = zip(*said, strict=True)
    assert satellites == (11, 10, 8, 7, 5, 5)  # ArduPilot arms with 6 and more
    assert list(hdop) == sorted(set(hdop))
    assert hdop[0] < 1.4 < hdop[2]  # GPS_HDOP_GOOD
    assert vdop[1] > hdop[1]


def test_the_claim_of_a_carried_fix_grows_with_its_sigma() -> None:
    """Half a second without a fix is no better known than it was."""
    it = injector(message="gps_input", rate_hz=5, delay_ms=0, overdue_intervals=100.0)
    it.submit(fix(SECOND, protection_m=(1.5, 1.5)), SECOND)
    fresh = it.step(SECOND, context()).message  # type: ignore[union-attr]
    carried = it.step(SECOND + 400 * MS, context()).message  # type: ignore[union-attr]
    assert carried.hdop > fresh.hdop + 1.0
    assert carried.satellites_visible < fresh.satellites_visible


def test_gps_input_without_velocity_sets_the_ignore_flags() -> None:
    it = injector(message="gps_input", rate_hz=5, delay_ms=0, gps_velocity=False)
    sent = fly(it, seconds=1, fix_hz=5, latency_ms=0)
    assert sent[0][1].message.ignore_flags == 8 | 16 | 32
    assert sent[0][1].message.yaw == 0


def deltas(
    *,
    speed: float,
    fix_hz: float = 10.0,
    yaw: float = 0.0,
    late: int = 40 * MS,
    scale_sigma: float | None = 0.1,
    sigma_m: float | None = None,
    **where: Any,
) -> list[tuple[int, Any]]:
    """What is sent instead of positions that are withheld, on the way north. sigma_m: they are not
    withheld, and have this sigma.
    """
    it, sent = injector(rate_hz=10, delay_ms=100), []
    period, vehicle = int(SECOND / fix_hz), context(**{"yaw": yaw, **where})
    for t in range(SECOND, 4 * SECOND, MS):
        if (t - late) % period == 0:
            north = speed * (t - late) / SECOND
            how: dict[str, Any] = {
                "position_withheld": sigma_m is None,
                "scale_sigma": scale_sigma,
                "position_covariance_ned": np.eye(3) * (sigma_m or 1.0) ** 2,
            }
            it.submit(fix(t - late, north, yaw_rad=yaw, **how), t)
        assert it.step(t, vehicle) is None
        if (delta := it.motion.take_message()) is not None:
            sent.append((t, delta))
    return sent


def test_of_a_withheld_position_only_its_change_is_sent_in_body_axes() -> None:
    """Nose to the east, way to the north: to the left. ArduPilot dates it by its arrival."""
    sent = deltas(yaw=math.pi / 2, speed=10.0)
    assert len(sent) >= 28
    for t, delta in sent:
        assert delta.get_type() == "VISION_POSITION_DELTA"
        assert t - delta.time_usec * 1000 == pytest.approx(100 * MS, abs=MS)
        assert delta.time_delta_usec == 100_000
        assert delta.position_delta == pytest.approx((0.0, -1.0, 0.0), abs=0.01)
        assert delta.angle_delta == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
        # 2 m/s at confidence 0 and 0.1 m/s at 100: the tenth of 10 m/s, and the noise of 0.3 m/s
        assert delta.confidence == pytest.approx(100 * (2.0 - math.hypot(0.3, 1.0)) / 1.9, abs=0.5)


def test_of_odometry_over_the_largest_sigma_the_change_is_sent() -> None:
    """With an alert limit of 80 m the EKF was without input after 10 m of sigma: failsafe in 8 s,
    no speed at the next position, and 16 deg of heading lost.
    """
    assert len(deltas(speed=10.0, sigma_m=11.0)) >= 28
    assert deltas(speed=10.0, sigma_m=11.0, scale_sigma=None) == []  # not of odometry


def test_no_change_of_position_is_sent_that_the_autopilot_would_believe_too_much() -> None:
    """Too fast, or the height above the ground too uncertain, for the largest error that it can be
    told; too long apart; late; a wrong heading; PX4.
    """
    assert deltas(speed=25.0) == []
    assert deltas(speed=10.0, scale_sigma=0.25) == []
    assert deltas(speed=5.0, scale_sigma=0.25)
    assert deltas(speed=10.0, scale_sigma=None) == []
    assert deltas(speed=10.0, fix_hz=1.0) == []
    assert deltas(speed=10.0, late=300 * MS) == []
    assert deltas(speed=10.0, profile=PX4) == []
    assert deltas(speed=10.0, yaw_error_deg=lambda _: 40.0) == []
