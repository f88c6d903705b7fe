"""Where the camera was at a time that no frame has, and at one that a frame has nearly."""

from dataclasses import replace

import numpy as np

from companion.targets.history import PoseHistory
from localizer.geometry.pose import Pose, so3_exp, so3_log
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
    added = at.covariance - worse.covariance
    assert (np.diag(added) >= 0.0).all()
    assert np.abs(added).max() < 1e-3  # 200 ms of a motion of which nothing says that it changes
    assert history.at(400 * MS) is None
    assert history.at(-100 * MS) is None


def _swinging(time_s):
    """Swings by 6 degrees and 3 m, once in 4 s."""
    turn = np.array([0.0, 0.0, 0.1 * np.sin(0.5 * np.pi * time_s)])
    base = pose_at(1.0)
    aside = np.array([3.0 * np.cos(0.5 * np.pi * time_s), 0.0, 0.0])
    return Pose(so3_exp(turn) @ base.rotation, base.translation + aside)


def test_between_two_poses_of_a_camera_that_swings_the_error_is_in_the_covariance():
    """At two poses a second a line between them misses the swing by a degree: metres on the ground.

    Told was the covariance of the neighbours, 0.06 degrees.
    """
    history, sigma = PoseHistory(), np.repeat([0.1, 1e-3], 3)
    times = range(1000, 9000, 500)
    for ms in times:
        told = estimate(_swinging(ms / 1e3), ms * MS)
        history.add(replace(told, covariance=np.diag(sigma**2)))
    errors = []
    for ms in range(2000, 7000, 50):
        at, true = history.at(ms * MS), _swinging(ms / 1e3)
        assert at is not None
        pose = at.world_from_camera
        off = np.concatenate(
            [pose.translation - true.translation, so3_log(pose.rotation @ true.rotation.T)]
        )
        errors.append(np.abs(off) / np.sqrt(np.diag(at.covariance)))
    assert np.max(errors) < 2.0


def test_between_the_frames_of_a_steady_flight_the_covariance_is_what_it_was():
    history, sigma = PoseHistory(), np.repeat([0.06, 4.4e-4], 3)
    rng = np.random.default_rng(0)
    for ms in range(1000, 6000, 100):
        pose = pose_at(ms / 1e3)
        off = rng.normal(0.0, sigma)
        told = Pose(so3_exp(off[3:]) @ pose.rotation, pose.translation + off[:3])
        history.add(replace(estimate(told, ms * MS), covariance=np.diag(sigma**2)))
    middles = [history.at(ms * MS) for ms in range(1550, 5500, 100)]
    grown = [np.sqrt(np.diag(at.covariance)) / sigma for at in middles if at is not None]
    assert len(grown) == len(middles)
    assert np.median(grown) < 1.25
