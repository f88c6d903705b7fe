"""Arming refusals with ArduPilot's texts (ardupilot.md, "Arming refusals seen")."""

from __future__ import annotations

import numpy as np

from sitl.embedded.control.mode import Mode


def guided(b, home=None):
    if home is not None:
        b.vehicle.estimator.set_origin(home)
    b.vehicle.modes.mode = Mode.GUIDED
    return b


def test_gyros_settle_for_25_seconds(bench, vision_only, home):
    b = guided(bench(vision_only), home)
    b.vision()
    b.run(20)
    assert b.failures() == ["Gyros inconsistent"]
    b.run(6)
    assert b.failures() == []


def test_gps_parameters_without_gps(bench):
    b = guided(bench({"SIM_GPS1_ENABLE": 0}))
    b.run(60)
    assert "GPS 1: Bad fix" in b.failures()
    assert "Need Position Estimate" in b.failures()


def test_no_origin(bench, vision_only):
    b = guided(bench(vision_only))
    b.vision()
    b.run(30)
    assert "AHRS: waiting for home" in b.failures()


def test_velocity_sources_left_at_gps(bench, vision_only, home):
    b = guided(bench({**vision_only, "EK3_SRC1_VELXY": 3}), home)
    b.vision()
    b.run(30)
    assert "AHRS: EK3 sources require GPS" in b.failures()


def test_vision_sources_without_vision_configured(bench, vision_only, home):
    b = guided(bench({**vision_only, "VISO_TYPE": 0}), home)
    b.run(30)
    assert "AHRS: EK3 sources require VisualOdom" in b.failures()


def test_a_gap_over_300_ms(bench, vision_only, home):
    b = guided(bench(vision_only), home)
    feed = b.vision()
    b.run(30)
    assert b.failures() == []
    feed.on = False
    b.run(0.5)
    assert b.failures() == ["VisOdom: not healthy"]


def test_vision_under_4_hertz_does_not_arm(bench, vision_only, home):
    b = guided(bench(vision_only), home)
    b.vision(period_ticks=100)
    b.run(30)
    refused = []
    b.run(5, lambda: refused.append("VisOdom: not healthy" in b.failures()) or False)
    assert np.mean(refused) > 0.5


def test_noise_far_above_what_is_claimed(bench, vision_only, home):
    b = guided(bench(vision_only), home)
    b.vision(sigma=6.0)
    b.run(30)
    seen = set()
    b.run(20, lambda: seen.update(b.failures()) or False)
    assert "EKF position variance" in seen
