"""What PX4 receives: the fields, ids and units of common.xml.

The meanings are those of PX4's documentation and receiver: position and velocity variances on the
diagonal, NED frame, FRD body velocity, exposure stamps that TIMESYNC maps.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from mavlink_bridge import BridgeConfig, VisionFix
from mavlink_bridge.config import InjectionConfig
from mavlink_bridge.injection.encode import InjectionContext
from mavlink_bridge.injection.injector import Injector
from mavlink_bridge.link.clock import SteadyUtc
from mavlink_bridge.messages import Attitude, Origin
from mavlink_bridge.preflight.doctor import check_parameters
from mavlink_bridge.preflight.rules import px4_rules
from mavlink_bridge.quaternion import from_euler
from mavlink_bridge.vehicle.profile import PX4
from tests.mavlink_bridge.simulated import GEOID, HOME, MS, SECOND

YAW = math.radians(90.0)
P = np.array([[0.25, 0.05, 0.01], [0.05, 0.36, 0.02], [0.01, 0.02, 0.49]])


def injected(kind: Any, sent_ns: int = 10 * SECOND + 80 * MS) -> Any:
    """A fix of 10 s, 100 m north of the origin and 60 m above it, nose and flight to the east."""

    def attitude_at(time_ns: int) -> Attitude:
        return Attitude(time_ns, 0.0, 0.0, YAW, from_euler(0.0, 0.0, YAW))

    config = InjectionConfig(message=kind, rate_hz=30, delay_ms=80, sigma_floor_m=1e-6)
    injector = Injector(config, GEOID, SteadyUtc())
    injector.submit(
        VisionFix(
            10 * SECOND,
            HOME[0] + math.degrees(100.0 / 6371000.0),  # on PX4's sphere
            HOME[1],
            488.0 + 60.0 + GEOID,
            from_euler(0.0, 0.0, YAW),
            P,
            attitude_sigma_rad=0.03,
            quality=77,
            velocity_ned=(0.0, 12.0, -1.0),
            velocity_sigma_mps=0.2,
        ),
        sent_ns,
    )
    injection = injector.step(sent_ns, InjectionContext(Origin(*HOME, 488.0), PX4, attitude_at))
    return injection.message


def test_vision_position_estimate() -> None:
    m = injected("vision_position_estimate")
    assert (m.get_msgId(), m.crc_extra) == (102, 158)  # of common.xml
    assert m.usec == 10_000_000
    assert (m.x, m.y, m.z) == pytest.approx((100.0, 0.0, -60.0), abs=0.01)
    assert (m.roll, m.pitch, m.yaw) == pytest.approx((0.0, 0.0, YAW), abs=1e-6)
    diagonal = [m.covariance[i] for i in (0, 6, 11, 15, 18, 20)]
    assert diagonal == pytest.approx([0.25, 0.36, 0.49, 9e-4, 9e-4, 9e-4], rel=1e-3)
    assert [m.covariance[i] for i in (1, 2, 7)] == pytest.approx([0.05, 0.01, 0.02], rel=1e-5)
    assert m.reset_counter == 0


def test_odometry() -> None:
    m = injected("odometry")
    assert (m.get_msgId(), m.crc_extra) == (331, 91)
    assert m.time_usec == 10_000_000
    assert (m.x, m.y, m.z) == pytest.approx((100.0, 0.0, -60.0), abs=0.01)
    assert m.q == pytest.approx((math.cos(YAW / 2), 0.0, 0.0, math.sin(YAW / 2)), abs=1e-6)
    # Nose to the east, flying east and climbing: forward and up.
    assert (m.vx, m.vy, m.vz) == pytest.approx((12.0, 0.0, -1.0), abs=1e-5)
    assert all(math.isnan(rate) for rate in (m.rollspeed, m.pitchspeed, m.yawspeed))
    assert [m.pose_covariance[i] for i in (0, 6, 11)] == pytest.approx([0.25, 0.36, 0.49], rel=1e-3)
    assert [m.velocity_covariance[i] for i in (0, 6, 11)] == pytest.approx([0.04] * 3, rel=1e-3)
    assert (m.frame_id, m.child_frame_id) == (1, 12)  # MAV_FRAME_LOCAL_NED, MAV_FRAME_BODY_FRD
    assert (m.reset_counter, m.estimator_type, m.quality) == (0, 2, 77)  # of vision


def test_global_position_sensor_says_when_it_was_sent_and_how_old_it_is() -> None:
    m = injected("global_position_sensor")
    assert (m.get_msgId(), m.crc_extra) == (296, 158)
    assert (m.time_usec, m.processing_time) == (10_080_000, 80_000)
    assert m.lat == round((HOME[0] + math.degrees(100.0 / 6371000.0)) * 1e7)
    assert m.lon == round(HOME[1] * 1e7)
    assert (m.alt_ellipsoid, m.alt) == pytest.approx((595.0, 548.0), abs=1e-3)
    assert m.eph == pytest.approx(math.sqrt(np.linalg.eigvalsh(P[:2, :2])[-1]), rel=1e-3)
    assert m.epv == pytest.approx(0.7, rel=1e-3)
    assert (m.id, m.source, m.flags) == (1, 2, 0)


def rules(message: Any, parameters: dict[str, float]) -> dict[str, float | None]:
    config = BridgeConfig(injection=InjectionConfig(message=message, delay_ms=150, rate_hz=30))
    return {
        f.name: f.fix
        for f in check_parameters(px4_rules(config, parameters.get), parameters.get)
        if not f.ok
    }


GOOD = {"EKF2_EV_CTRL": 5.0, "EKF2_EV_DELAY": 0.0, "EKF2_DELAY_MAX": 200.0, "EKF2_EV_QMIN": 0.0}
GOOD |= {"EKF2_EV_NOISE_MD": 0.0} | {f"EKF2_EV_POS_{axis}": 0.0 for axis in "XYZ"}


def test_parameters_of_external_vision() -> None:
    assert rules("odometry", GOOD) == {}
    assert rules("vision_position_estimate", {**GOOD, "EKF2_EV_CTRL": 9.0}) == {}
    assert rules("odometry", {**GOOD, "EKF2_EV_CTRL": 8.0}) == {"EKF2_EV_CTRL": 9.0}
    # The stamps are exposure times: a delay as well would count it twice.
    assert rules("odometry", {**GOOD, "EKF2_EV_DELAY": 150.0}) == {"EKF2_EV_DELAY": 0.0}
    assert rules("odometry", {**GOOD, "EKF2_DELAY_MAX": 100.0}) == {"EKF2_DELAY_MAX": 200.0}
    quality = {**GOOD, "EKF2_EV_QMIN": 1.0}
    assert rules("vision_position_estimate", quality) == {"EKF2_EV_QMIN": 0.0}
    assert rules("odometry", quality) == {}


@pytest.mark.parametrize(
    ("parameters", "fixes"),
    [
        ({"EKF2_AGP_CTRL": 1.0}, {}),  # PX4 of one instance
        ({"EKF2_AGP_CTRL": 2.0}, {"EKF2_AGP_CTRL": 3.0}),
        ({"EKF2_AGP0_ID": 1.0, "EKF2_AGP0_CTRL": 1.0}, {}),
        ({"EKF2_AGP0_ID": 0.0, "EKF2_AGP0_CTRL": 1.0}, {"EKF2_AGP0_ID": 1.0}),
        ({"EKF2_AGP0_ID": 1.0, "EKF2_AGP0_CTRL": 2.0}, {"EKF2_AGP0_CTRL": 3.0}),
        ({"EKF2_AGP0_ID": 3.0, "EKF2_AGP2_ID": 1.0, "EKF2_AGP2_CTRL": 1.0}, {}),
    ],
)  # fmt: skip
def test_parameters_of_the_global_sensor_in_each_instance(parameters, fixes):
    assert rules("global_position_sensor", {**parameters, "EKF2_DELAY_MAX": 200.0}) == fixes
