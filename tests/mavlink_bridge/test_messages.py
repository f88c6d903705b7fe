"""What crosses the bridge's border is refused there, not where it would be packed for the wire."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from mavlink_bridge.camera.messages import camera_fov_status
from mavlink_bridge.camera.targets import adsb_vehicle, tracking_geo_status
from mavlink_bridge.config import CameraConfig
from mavlink_bridge.errors import FixError
from mavlink_bridge.messages import CameraView, TargetReport, VisionFix

PLACE = (10**9, 47.0, 8.0, 500.0)
LEVEL = (1.0, 0.0, 0.0, 0.0)
BAD = (math.nan, math.inf, -math.inf, 1e300, -1e300)


def fix(**fields: Any) -> VisionFix:
    return VisionFix(*PLACE, **fields)


def target(**fields: Any) -> TargetReport:
    return TargetReport(*PLACE, **fields)


def view(quaternion: Any = LEVEL, *image: float | None) -> CameraView:
    return CameraView(*PLACE, quaternion, *image)


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize(
    ("make", "why"),
    [
        (lambda x: fix(quaternion=(1.0, x, 0.0, 0.0)), "no rotation"),
        (lambda x: fix(velocity_ned=(0.0, x, 0.0)), "velocity"),
        (lambda x: fix(position_covariance_ned=np.full((3, 3), x)), "covariance"),
        (lambda x: fix(attitude_sigma_rad=x), "sigma"),
        (lambda x: fix(velocity_sigma_mps=x), "sigma"),
        (lambda x: target(velocity_ned=(x, 0.0, 0.0)), "velocity"),
        (lambda x: target(pixel=(0.5, x)), "inside the picture"),
        (lambda x: target(rectangle=(0.0, 0.0, x, 1.0)), "inside the picture"),
        (lambda x: view((1.0, x, 0.0, 0.0)), "no rotation"),
        (lambda x: CameraView(10**9, x, 8.0, 500.0, LEVEL), "no place on Earth"),
    ],
)
def test_what_no_message_can_carry_is_named(make, why, bad):
    with pytest.raises(FixError, match=why):
        make(bad)


@pytest.mark.parametrize(
    "P",
    [
        np.eye(2),
        np.diag([1.0, 1.0, -1.0]),
        np.array([[1.0, 5.0, 0], [5.0, 1.0, 0], [0, 0, 1.0]]),
        np.array([[1.0, 0.5, 0], [0.0, 1.0, 0], [0, 0, 1.0]]),
    ],
)
def test_what_is_no_covariance_is_named(P: np.ndarray) -> None:
    with pytest.raises(FixError, match="covariance"):
        fix(position_covariance_ned=P)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -1.0, 1e300])
@pytest.mark.parametrize("field", ["h_accuracy_m", "v_accuracy_m"])
def test_accuracies_that_are_none_are_named(field: str, bad: float) -> None:
    with pytest.raises(FixError, match="accuracies"):
        target(**{field: bad})


def test_what_is_unknown_goes_out_as_the_messages_define_it() -> None:
    geo = tracking_geo_status(target(), 0.0, None)
    assert all(math.isnan(x) for x in (geo.h_acc, geo.v_acc, geo.vel_n, geo.dist, geo.hdg))
    looks = camera_fov_status(view(), CameraConfig(), 0.0, 0)
    assert {looks.lat_image, looks.lon_image, looks.alt_image} == {2**31 - 1}


def test_the_widest_that_is_accepted_can_be_packed() -> None:
    from pymavlink.dialects.v20 import ardupilotmega as mavlink

    report = target(velocity_ned=(1000.0, -1000.0, 1000.0), h_accuracy_m=1e5, v_accuracy_m=None,
                    pixel=(0.0, 1.0), target_id=-(2**40))  # fmt: skip
    for message in (
        tracking_geo_status(report, -100.0, None),
        adsb_vehicle(report, -100.0),
        camera_fov_status(view(), CameraConfig(), -100.0, 0),
        camera_fov_status(view(LEVEL, None, 8.0, None), CameraConfig(), 100.0, 0),
    ):
        assert message.pack(mavlink.MAVLink(None, 1, 100))
