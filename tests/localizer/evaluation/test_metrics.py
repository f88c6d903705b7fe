from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from localizer.config import LocalizerConfig
from localizer.evaluation.places import DrawnSensors
from localizer.evaluation.sequences import (
    EvaluatedFrame,
    Sequence,
    csv_rows,
    error_arrays,
    localization_metrics,
    worst_first,
)
from localizer.geometry.camera import Camera
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Pose, so3_exp, so3_log
from localizer.relocalization.patch import with_heading
from localizer.render.topview import DOWN
from localizer.types import PoseEstimate, PosePrior, RegistrationStatus, TrackingState


def test_recall_needs_both_errors_within_and_counts_missing_frames_as_failed():
    translation = np.array([0.5, 0.5, 2.0, np.nan])
    rotation = np.array([0.5, 2.0, 0.1, np.nan])
    m = localization_metrics(translation, rotation, seconds=2.0)
    assert (m.recall_1, m.recall_3, m.recall_5) == (25.0, 75.0, 75.0)
    assert m.completeness == 75.0
    assert m.median_translation_m == 0.5
    assert m.p95_translation_m == pytest.approx(1.85)  # of 0.5, 0.5, 2.0
    assert (m.max_translation_m, m.max_rotation_deg) == (2.0, 2.0)
    assert m.fps == 2.0


@pytest.mark.parametrize("frames", [3, 0])
def test_no_estimate_at_all_is_not_a_perfect_score(frames):
    m = localization_metrics(np.full(frames, np.nan), np.full(frames, np.nan), frames / 3)
    assert m.recall_5 == 0.0
    assert m.completeness == 0.0
    assert m.median_translation_m is None
    assert m.max_rotation_deg is None
    assert m.p95_translation_m is None


# --- worst --------------------------------------------------------------------------------------


def _frame(name, error=None, quality=None):
    estimate = None if quality is None else SimpleNamespace(quality=quality)
    return EvaluatedFrame(name, estimate, error, error)


def test_the_worst_frames_come_first_then_the_rejected_ones_and_no_broken_image():
    frames = [
        _frame("good", 0.1, 0.8), _frame("bad", 3.0, 0.4), _frame("rejected", None, 0.2),
        _frame("hopeless", None, 0.0), _frame("no image"), _frame("middling", 0.5, 0.6),
    ]  # fmt: skip
    assert [frames[i].name for i in worst_first(frames)] == [
        "bad", "middling", "good", "hopeless", "rejected"
    ]  # fmt: skip
    translation, _ = error_arrays(frames)
    assert translation.dtype == np.float64
    np.testing.assert_array_equal(np.isnan(translation), [0, 0, 1, 1, 1, 0])


def test_an_error_that_is_not_known_is_an_empty_cell():
    pose = Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    estimate = PoseEstimate(
        pose, np.eye(6), 0.1, TrackingState.LOST, RegistrationStatus.OK, False, 0, 0,
        Camera.from_fov(64, 48, 60), {},
    )  # fmt: skip
    frames = [EvaluatedFrame("rejected", estimate, None, None)]
    (row,) = csv_rows(frames, LocalFrame(Geodetic(47.3, 8.5, 450.0)))
    assert row["translation_error_m"] == row["rotation_error_deg"] == ""
    assert row["height_m"] == "450.000"


# --- Drawn reports of roll, pitch and height ----------------------------------------------------


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
    assert (config.attitude.tilt_sigma_deg, config.height_sigma_m) == (1.0, None)
