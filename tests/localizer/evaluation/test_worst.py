from types import SimpleNamespace

import numpy as np

from localizer.evaluation.sequences import EvaluatedFrame, csv_rows, error_arrays, worst_first
from localizer.geometry.camera import Camera
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Pose
from localizer.types import PoseEstimate, RegistrationStatus, TrackingState


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
