"""Whole flights of the embedded vehicle, in simulated time."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from sitl.embedded.control import mission as mis
from sitl.embedded.control.mission import StoredMissionItem
from sitl.embedded.control.mode import Mode
from sitl.embedded.ekf.aided_filter import Aiding
from sitl.embedded.ekf.estimator import EkfFlags


def test_without_gps_or_vision_the_true_position_drifts_away(bench):
    """The proof that the loop is closed: nothing but injected positions holds the vehicle."""
    b = bench({})
    b.take_off(120.0)
    b.run(5)
    here, killed = b.truth, b.vehicle.time_s
    b.vehicle.parameters.set("SIM_GPS1_ENABLE", 0)
    b.run(60)
    assert np.hypot(*(b.truth - here)[:2]) > 20.0
    assert b.vehicle.modes.mode is Mode.LAND
    assert 7.5 < b.time_of("EKF Failsafe: changed to LAND Mode") - killed < 9.0
    assert b.time_of("stopped aiding") - killed == pytest.approx(15.0, abs=0.6)


@pytest.mark.parametrize("seed", [1, 3])
def test_a_jammed_gps_fails_the_filter_within_seconds(bench, seed):
    """ardupilot.md: LAND after 4.6 s; how soon depends on when the receiver lies first."""
    b = bench({}, seed)
    b.take_off(60.0)
    jammed = b.vehicle.time_s
    b.vehicle.parameters.set("SIM_GPS1_JAM", 1)
    b.run(10)
    assert b.time_of("EKF Failsafe: changed to LAND Mode") - jammed < 9.0


def test_a_wrong_receiver_is_told_and_does_not_drag_the_vehicle_at_once(bench):
    b = bench({})
    b.take_off(40.0)
    b.run(5)
    here, since = b.truth, b.vehicle.time_s
    b.vehicle.parameters.set("SIM_GPS1_GLTCH_X", 0.0003)  # 33 m
    b.run(4)
    assert 0.5 < b.time_of("GPS Glitch or Compass error") - since < 2.5
    assert np.hypot(*(b.truth - here)[:2]) < 3.0
    assert b.vehicle.gps_sample.position[0] == pytest.approx(b.truth[0] + 33.4, abs=3.0)
    b.vehicle.parameters.set("SIM_GPS1_GLTCH_X", 0.0)
    b.run(12)
    assert b.said("Glitch cleared")


def test_vision_only_flight_reaches_the_reference_accuracy(bench, vision_only, home):
    """ardupilot.md: 10 Hz, sigma 0.5 m, 100 ms, VISO_DELAY_MS 100: 0.23 / 0.50 / 0.89 m."""
    b = bench({**vision_only, "SIM_WIND_SPD": 0, "SIM_WIND_TURB": 0})
    b.vehicle.estimator.set_origin(home)
    b.vision(sigma=0.5)
    b.take_off(60.0)
    b.go(200, 0, 60)
    errors = b.errors(30)
    # The reference includes the transport's jitter, which a flight without links lacks.
    assert 0.12 < np.median(errors) < 0.29
    assert 0.25 < np.percentile(errors, 95) < 0.62


@pytest.mark.parametrize(("delay_ms", "expected"), [(10, 2.41), (250, 0.45)])
def test_uncompensated_latency_shows_as_lag(bench, vision_only, home, delay_ms, expected):
    """ardupilot.md: 300 ms with VISO_DELAY_MS 10 is 2.41 m; 250 effective leaves about 0.5."""
    b = bench({**vision_only, "VISO_DELAY_MS": delay_ms, "SIM_WIND_SPD": 0, "SIM_WIND_TURB": 0})
    b.vehicle.estimator.set_origin(home)
    b.vision(sigma=0.3, latency_ticks=30)
    b.take_off(60.0)
    b.go(300, 0, 60)
    b.run(8)
    assert np.median(b.errors(18)) == pytest.approx(expected, rel=0.35)


def test_an_unannounced_jump_is_refused_for_some_seconds(bench, vision_only, home):
    b = bench(vision_only)
    b.vehicle.estimator.set_origin(home)
    feed = b.vision()
    b.take_off(30.0)
    b.run(5)
    before = b.vehicle.estimator.position[0]
    feed.offset = (10.0, 0.0, 0.0)
    b.run(4.5)
    assert abs(b.vehicle.estimator.position[0] - before) < 2.0
    b.run(10)
    # Taken at last (ArduPilot: after 6 to 7 s), and the vehicle flew off by the jump.
    assert b.ekf_error() == pytest.approx(10.0, abs=1.0)
    assert b.truth[0] == pytest.approx(-10.0, abs=3.5)
    assert b.vehicle.modes.mode is Mode.GUIDED


def test_fifteen_seconds_without_vision_land_and_the_mode_stays(bench, vision_only, home):
    b = bench(vision_only)
    b.vehicle.estimator.set_origin(home)
    feed = b.vision()
    b.take_off(60.0)
    feed.on = False
    lost = b.vehicle.time_s
    b.run(14)
    assert b.time_of("EKF Failsafe: changed to LAND Mode") - lost == pytest.approx(8.2, abs=0.6)
    feed.on = True
    b.run(5)
    assert b.said("EKF Failsafe Cleared")
    assert b.vehicle.modes.mode is Mode.LAND


def test_a_rotated_vision_frame_misleads_without_a_warning(bench, vision_only, home):
    b = bench(vision_only)
    b.vehicle.estimator.set_origin(home)
    b.vision(rotation=math.radians(5))
    b.take_off(60.0)
    b.go(200, 200, 60)
    b.run(45)
    assert b.ekf_error() == pytest.approx(math.radians(5) * 283, rel=0.15)
    assert not b.said("EKF variance")


def item(command, north=0.0, east=0.0, height=0.0, *, home):
    place = home.offset(north, east, 0.0)
    return StoredMissionItem(
        command, 3, (0.0, 0.0, 0.0, 0.0), place.latitude_deg, place.longitude_deg, height
    )


def test_flies_a_mission_with_speed_gimbal_and_return(bench, home):
    b = bench({"MNT1_TYPE": 7, "WPNAV_SPEED_UP": 500, "LAND_SPEED_HIGH": 300})
    bare = {"latitude_deg": 0.0, "longitude_deg": 0.0, "altitude_m": 0.0, "frame": 3}
    b.vehicle.mission.items = [
        item(mis.WAYPOINT, home=home),
        item(mis.TAKEOFF, height=40.0, home=home),
        StoredMissionItem(command=mis.CHANGE_SPEED, parameters=(1.0, 6.0, -1.0, 0.0), **bare),
        item(mis.WAYPOINT, 100, 0, 40.0, home=home),
        StoredMissionItem(command=mis.GIMBAL_PITCHYAW, parameters=(-70.0, 20.0, 0.0, 0.0), **bare),
        item(mis.WAYPOINT, 100, 80, 60.0, home=home),
        StoredMissionItem(command=mis.RTL, parameters=(0.0, 0.0, 0.0, 0.0), **bare),
    ]
    reached: list[Any] = []
    b.vehicle.modes.on_reached = reached.append
    b.take_off(20.0)
    assert b.vehicle.modes.set_mode(Mode.AUTO)
    speeds = []

    def fast() -> bool:
        speeds.append(float(np.hypot(*b.vehicle.truth[3:5])))
        return 3 in reached

    assert b.run(60, fast)
    assert max(speeds) == pytest.approx(6.0, abs=1.0)
    assert np.hypot(b.truth[0] - 100, b.truth[1]) < 4.0
    assert b.run(60, lambda: 5 in reached)
    assert np.hypot(b.truth[0] - 100, b.truth[1] - 80) < 4.0
    assert abs(b.truth[2] + 60) < 3.0
    assert math.degrees(b.vehicle.gimbal.pitch_rad) == pytest.approx(-70.0)
    assert math.degrees(b.vehicle.gimbal.yaw_rad) == pytest.approx(20.0)
    assert b.run(180, lambda: not b.vehicle.modes.armed)
    assert np.hypot(*b.truth[:2]) < 4.0


def test_modes_that_need_a_position_are_refused_without(bench):
    b = bench({"GPS1_TYPE": 0})
    b.run(30)
    b.vehicle.modes.arm()
    assert not b.vehicle.modes.set_mode(Mode.GUIDED)
    assert b.said("requires position")
    assert b.vehicle.estimator.sources.aiding is Aiding.NONE
    assert EkfFlags.CONST_POS_MODE in b.vehicle.estimator.flags
