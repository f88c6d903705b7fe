"""Drawn reports of roll, pitch and height."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from localizer.config import LocalizerConfig
from localizer.evaluation.drawn_sensors import DrawnSensors
from localizer.evaluation.sequences import Sequence
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose, so3_exp, so3_log
from localizer.relocalization.patch import with_heading
from localizer.render.topview import DOWN
from localizer.types import PosePrior

TRUTH = Pose(with_heading(so3_exp((0.2, -0.1, 0.0)) @ DOWN, 0.7), np.array([5.0, -3.0, 110.0]))


def test_reports_scatter_as_they_say_and_are_constant_over_a_flight() -> None:
    drawn = DrawnSensors(2.0, 3.0, by_frame=True, seed=1)
    turns = np.array([so3_log(drawn.rotation(TRUTH, k) @ TRUTH.rotation.T) for k in range(400)])
    assert np.degrees(turns[:, :2]).std() == pytest.approx(2.0, rel=0.1)
    assert abs(turns[:, 2]).max() < 1e-3
    heights = np.array([drawn.height_m(TRUTH, k) for k in range(400)]) - 110.0
    assert heights.std() == pytest.approx(3.0, rel=0.15)
    constant = DrawnSensors(2.0, 3.0)
    assert constant.height_m(TRUTH, 0) == constant.height_m(TRUTH, 7)


def test_a_prior_takes_roll_pitch_and_height_and_keeps_place_and_heading() -> None:
    drawn = DrawnSensors(1.0, 3.0, by_frame=True)
    off = Pose(
        so3_exp((0.1, 0.05, 0.0)) @ with_heading(TRUTH.rotation, 0.1),
        TRUTH.translation + np.array([8.0, -6.0, 20.0]),
    )
    prior = drawn.in_prior(PosePrior(off, np.eye(6), 0), TRUTH, 3)
    pose = prior.world_from_camera
    np.testing.assert_array_equal(pose.translation[:2], off.translation[:2])
    assert pose.translation[2] == drawn.height_m(TRUTH, 3)
    turn = so3_log(pose.rotation @ drawn.rotation(TRUTH, 3).T)
    assert np.linalg.norm(turn[:2]) < 1e-9
    assert turn[2] == pytest.approx(0.1, abs=0.03)
    assert prior.covariance[3, 3] == pytest.approx(np.radians(1.0) ** 2)
    assert prior.covariance[5, 5] == 1.0


def test_a_localizer_is_told_at_the_frames_times_alone() -> None:
    sequence = Sequence((Path("a"),), (7,), (TRUTH,), Camera.from_fov(32, 24, 60.0))
    told = DrawnSensors(1.0, None).auxiliary(sequence)
    assert told.rotation_at(7) is not None
    assert (told.rotation_at(8), told.height_at(7)) == (None, None)
    config = DrawnSensors(1.0, None).config(LocalizerConfig())
    assert config.attitude is not None
    assert (config.attitude.tilt_sigma_deg, config.height_sigma_m) == (1.0, None)
