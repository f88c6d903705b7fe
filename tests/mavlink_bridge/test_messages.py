"""What crosses the bridge's border is refused there, not where it would be packed for the wire."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.camera.messages import adsb_vehicle, camera_fov_status, tracking_geo_status
from mavlink_bridge.config import CameraConfig
from mavlink_bridge.errors import FixError
from mavlink_bridge.messages import CameraView, TargetReport, VisionFix

PLACE = (10**9, 47.0, 8.0, 500.0)


def target(**fields: Any) -> TargetReport:
    return TargetReport(*PLACE, **fields)


def view(*image: float | None) -> CameraView:
    return CameraView(*PLACE, (1.0, 0.0, 0.0, 0.0), *image)


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
        VisionFix(*PLACE, position_covariance_ned=P)


def test_bounds_that_are_none_are_named() -> None:
    for field in ("h_accuracy_m", "v_accuracy_m"):
        with pytest.raises(FixError, match="accuracies"):
            target(**{field: -1.0})
    for bad in (math.nan, -1.0):
        with pytest.raises(FixError, match="protection"):
            VisionFix(*PLACE, protection_m=(1.0, bad))


def test_what_is_unknown_goes_out_as_the_messages_define_it() -> None:
    geo = tracking_geo_status(target(), 0.0, None)
    assert all(math.isnan(x) for x in (geo.h_acc, geo.v_acc, geo.vel_n, geo.dist, geo.hdg))
    looks = camera_fov_status(view(), CameraConfig(), 0.0, 0)
    assert {looks.lat_image, looks.lon_image, looks.alt_image} == {2**31 - 1}


def test_the_widest_that_is_accepted_can_be_packed() -> None:
    report = target(velocity_ned=(1000.0, -1000.0, 1000.0), h_accuracy_m=1e5, v_accuracy_m=None,
                    pixel=(0.0, 1.0), target_id=-(2**40))  # fmt: skip
    for message in (
        tracking_geo_status(report, -100.0, None),
        adsb_vehicle(report, -100.0),
        camera_fov_status(view(), CameraConfig(), -100.0, 0),
        camera_fov_status(view(None, 8.0, None), CameraConfig(), 100.0, 0),
    ):
        assert message.pack(mavlink.MAVLink(None, 1, 100))
