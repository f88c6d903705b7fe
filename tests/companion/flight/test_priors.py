"""What the autopilot's position is worth, by GNSS and by the time since the last fix."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from companion.conversions import CameraExtrinsics
from companion.flight.priors import AutopilotPose, PositionQualityMonitor
from localizer.geometry.geo import Geodetic, LocalFrame
from mavlink_bridge.messages import Attitude, GimbalAttitude, VehicleState

SECOND = 10**9
METRE = 1.0 / 111319.0  # of latitude, degrees
FLYING = VehicleState(connected=True, ekf_flags=8 | 16)
INSTALLATION = CameraExtrinsics(LocalFrame(Geodetic(47.0, 8.0, 500.0)), 48.0, np.zeros(3))


def with_gnss(at_s: float, accuracy_m: float = 1.0) -> VehicleState:
    return replace(
        FLYING, gps_fix_type=3, gps_time_ns=round(at_s * SECOND), gps_h_accuracy_m=accuracy_m
    )


def test_a_receiver_that_doubts_itself_is_believed_less() -> None:
    belief = PositionQualityMonitor().at(with_gnss(10, accuracy_m=30.0), 10 * SECOND)
    assert belief.sigma_m == pytest.approx(30.0)


def test_a_fix_that_never_went_to_the_ekf_holds_it_nowhere() -> None:
    """In shadow, or withheld: the search would look too near to where the EKF drifted to."""
    pose = autopilot_pose()
    pose.belief.at(with_gnss(10), 10 * SECOND)
    fix: Any = SimpleNamespace(accepted=True, exposure_time_ns=100 * SECOND)
    pose.add_estimate(fix, reaches_ekf=False)
    drifted_m = pose.belief.at(FLYING, 101 * SECOND).sigma_m
    assert drifted_m is not None
    assert drifted_m > 150.0
    pose.add_estimate(fix, reaches_ekf=True)
    assert pose.belief.at(FLYING, 101 * SECOND).sigma_m == pytest.approx(5.0, abs=0.1)


def test_an_ekf_without_a_position_knows_nothing() -> None:
    blind = replace(FLYING, ekf_flags=1)  # EKF_ATTITUDE alone
    assert PositionQualityMonitor().at(blind, 10 * SECOND).sigma_m is None


def test_a_position_of_unknown_origin_is_tried_but_no_evidence() -> None:
    belief = PositionQualityMonitor().at(FLYING, 10 * SECOND)
    assert belief.sigma_m == pytest.approx(25.0)
    assert not belief.independent


def test_a_glitching_gnss_is_not_healthy() -> None:
    beliefs = PositionQualityMonitor()
    state = replace(with_gnss(10), ekf_flags=8 | 16 | 32768)
    assert not beliefs.at(state, 10 * SECOND).independent


class Placed:
    """An autopilot that has dead reckoned for a minute, 40 m from a receiver that is well."""

    apart_m = 40.0

    def state(self) -> VehicleState:
        return replace(
            with_gnss(100),
            latitude_deg=47.0 + self.apart_m * METRE, longitude_deg=8.0, altitude_amsl_m=520.0,
            gps_latitude_deg=47.0, gps_longitude_deg=8.0, position_time_ns=100 * SECOND,
        )  # fmt: skip

    def attitude_at(self, time_ns: int) -> Attitude:
        return Attitude(time_ns, 0.0, 0.0, 0.0, (1.0, 0.0, 0.0, 0.0))

    def gimbal_at(self, time_ns: int) -> GimbalAttitude:
        return GimbalAttitude(time_ns, 0.0, 0.0, 0.0, (1.0, 0.0, 0.0, 0.0), "test")

    def local_at(self, time_ns: int) -> None:
        return None


@pytest.mark.parametrize("on_gnss", [False, None])
def test_an_ekf_that_follows_our_fixes_is_no_evidence_whatever_a_receiver_says_beside_it(on_gnss):
    """Its source set was vision's; the receiver that had been left for it went on to report a fix.
    Where it had dead reckoned to, the tracking began without a trial, and was searched within 15 m.
    """
    pose = AutopilotPose(Placed(), INSTALLATION, lambda: on_gnss)
    fix: Any = SimpleNamespace(accepted=True, exposure_time_ns=40 * SECOND)
    pose.add_estimate(fix, reaches_ekf=True)
    prior = pose.prior(100 * SECOND)
    assert not prior.independent
    assert prior.covariance[0, 0] > 100.0**2


@pytest.mark.parametrize(("on_gnss", "apart_m"), [(True, 40.0), (None, 2.0)])
def test_an_ekf_on_gnss_begins_the_tracking_and_after_a_restart_where_they_agree(on_gnss, apart_m):
    """Who begins in the air does not know the source set, and the receiver knows the place."""
    placed = Placed()
    placed.apart_m = apart_m
    prior = AutopilotPose(placed, INSTALLATION, lambda: on_gnss).prior(100 * SECOND)
    assert prior.independent
    assert prior.covariance[0, 0] == pytest.approx(25.0)


class Ranging:
    """An autopilot with a rangefinder, leaning by so much."""

    def __init__(self, lean_deg: float) -> None:
        self._lean = math.radians(lean_deg)

    def state(self) -> VehicleState:
        return replace(FLYING, rangefinder_m=50.0, rangefinder_time_ns=SECOND)

    def attitude_at(self, time_ns: int) -> Attitude:
        return Attitude(time_ns, self._lean, 0.0, 0.0, (1.0, 0.0, 0.0, 0.0))

    def gimbal_at(self, time_ns: int) -> None:
        return None

    def local_at(self, time_ns: int) -> None:
        return None


def autopilot_pose(lean_deg: float = 0.0) -> AutopilotPose:
    return AutopilotPose(Ranging(lean_deg), INSTALLATION)


def clearance(lean_deg: float, at_s: float) -> float | None:
    pose = autopilot_pose(lean_deg)
    return pose.sensors.clearance_at(round(at_s * SECOND))


def test_a_rangefinder_tells_the_height_above_what_lies_below() -> None:
    assert clearance(0.0, 1.1) == pytest.approx(50.0)
    assert clearance(20.0, 1.1) == pytest.approx(50.0 * math.cos(math.radians(20.0)))
    assert clearance(40.0, 1.1) is None  # its beam meets the ground far to one side
    assert clearance(0.0, 2.0) is None  # of another place
