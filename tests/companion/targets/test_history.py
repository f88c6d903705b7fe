"""Where the camera was at a time that no frame has, and at one that a frame has nearly."""

from dataclasses import replace

import numpy as np

from companion.targets.history import PoseHistory
from localizer.geometry.pose import Pose
from tests.companion.targets.scene import MS, estimate, pose_at


def estimate_at(time_ns):
    """Of one pose, whenever."""
    return estimate(pose_at(1.0), time_ns)


def test_of_two_frames_that_are_near_the_nearer_one_is_meant():
    """At 60 frames/s both neighbours are within 20 ms, and a gimbal turns 1 degree between them."""
    history = PoseHistory()
    for k in range(4):
        history.add(estimate_at(round(k * 16.7 * MS)))
    for k in range(4):
        at = history.at(round(k * 16.7 * MS) - MS // 2)
        assert at is not None
        assert at.exposure_time_ns == round(k * 16.7 * MS), k


def test_between_two_frames_the_pose_is_between_and_the_worse_covariance_holds():
    history = PoseHistory()
    begin = estimate_at(0)
    end = estimate_at(200 * MS)
    place = Pose(
        end.world_from_camera.rotation, end.world_from_camera.translation + np.array([4.0, 0, 0])
    )
    worse = replace(end, world_from_camera=place, covariance=np.eye(6) * 9.0)
    history.add(begin)
    history.add(worse)
    at = history.at(50 * MS)
    assert at is not None
    offset = at.world_from_camera.translation - begin.world_from_camera.translation
    np.testing.assert_allclose(offset, [1.0, 0.0, 0.0], atol=1e-9)
    assert at.covariance is worse.covariance
    assert history.at(400 * MS) is None
    assert history.at(-100 * MS) is None
