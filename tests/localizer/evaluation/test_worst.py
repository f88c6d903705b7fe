from types import SimpleNamespace

import numpy as np

from localizer.evaluation.sequences import EvaluatedFrame, error_arrays, worst_first


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
