"""What attitude and height do to a registered pose, and when they are left out."""

from __future__ import annotations

import numpy as np
import pytest

from localizer.geometry.pose import Array, Pose, so3_exp
from localizer.registration.result import Registration
from localizer.tracking.attitude_bias import AttitudePrior
from localizer.tracking.motion import AuxiliarySensors
from localizer.tracking.sensor_fusion import SensorFusion
from localizer.types import RegistrationStatus

DOWN: Array = np.diag([1.0, -1.0, -1.0])
HEIGHT_M = 100.0
ATTITUDE = AttitudePrior(tilt_sigma_deg=0.4, alignment_sigma_deg=0.3)  # 0.5 together


def registered(tilt_sigma_deg: float, height_sigma_m: float) -> Registration:
    """Without patches, so that the covariance stays what is given here."""
    tilt = np.radians(tilt_sigma_deg)
    covariance = np.diag([1.0, 1.0, height_sigma_m**2, tilt**2, tilt**2, 1e-4])
    pose = Pose(DOWN, np.array([0.0, 0.0, HEIGHT_M]))
    return Registration(pose, covariance, 0.1, 0.9, 0.6, RegistrationStatus.OK, 1)


def fusion(tilt_off_deg: float, height_off_m: float) -> SensorFusion:
    rotation = so3_exp([np.radians(tilt_off_deg), 0.0, 0.0]) @ DOWN
    sensors = AuxiliarySensors(
        rotation_at=lambda _: rotation, height_at=lambda _: HEIGHT_M + height_off_m
    )
    return SensorFusion(ATTITUDE, 3.0, sensors)


def tilt_deg(pose: Pose) -> float:
    return float(np.degrees(np.arccos(np.clip((pose.rotation @ DOWN.T)[2, 2], -1, 1))))


def test_what_the_image_does_not_know_is_taken_from_the_sensors():
    found = fusion(3.0, 8.0).fuse(registered(4.0, 8.0), 0)
    assert not found.contradicted
    assert tilt_deg(found.registration.world_from_camera) == pytest.approx(3.0, abs=0.1)
    # Height: 8 m become the 3 m of the sensor, so the pose moves by 1 - 9 / 64 of the way.
    rise = found.registration.world_from_camera.translation[2] - HEIGHT_M
    assert rise == pytest.approx(8.0 * (1 - 9 / 64), abs=0.01)
    sigma_m = np.sqrt(found.registration.covariance[2, 2])
    assert sigma_m == pytest.approx(3.0, abs=0.01)


def test_what_the_image_knows_stays():
    """A gimbal 0.6 degrees off took poses along that the image knew to 0.3 degrees."""
    before = registered(0.3, 0.1)
    found = fusion(0.6, 3.0).fuse(before, 0)
    assert not found.contradicted
    np.testing.assert_allclose(
        found.registration.world_from_camera.matrix, before.world_from_camera.matrix
    )


@pytest.mark.parametrize(("tilt_off", "height_off"), [(3.0, 0.0), (0.0, 30.0)])
def test_a_sensor_that_contradicts_is_left_out_and_reported(tilt_off, height_off):
    before = registered(0.1, 0.1)
    found = fusion(tilt_off, height_off).fuse(before, 0)
    assert found.contradicted
    after = found.registration.world_from_camera
    assert tilt_deg(after) < 0.01
    assert after.translation[2] == pytest.approx(HEIGHT_M, abs=0.01)
