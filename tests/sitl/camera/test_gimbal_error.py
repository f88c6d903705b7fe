import numpy as np

from companion.geometry import GimbalAngles
from sitl.camera.gimbal_error import GimbalError


def _errors(seed, seconds=600):
    model = GimbalError(seed)
    zero = GimbalAngles(0.0, 0.0, 0.0)
    angles = [model.true_angles(zero, round(t * 1e9)) for t in np.arange(0, seconds, 0.1)]
    return np.degrees([(a.roll_rad, a.pitch_rad, a.yaw_rad) for a in angles])


def test_alignment_stays_and_wander_is_bounded_and_slow():
    errors = _errors(1)
    assert 0.15 < errors.std(axis=0).mean() < 0.45  # the wander
    assert np.abs(np.diff(errors, axis=0)).max() < 0.4  # degrees in 0.1 s
    first, last = errors[:3000].mean(axis=0), errors[3000:].mean(axis=0)
    np.testing.assert_allclose(first, last, atol=0.2)  # the alignment


def test_seeds_differ_and_repeat():
    np.testing.assert_array_equal(_errors(2, 5), _errors(2, 5))
    means = np.array([_errors(seed, 5).mean(axis=0) for seed in range(40)])
    assert 0.35 < means.std() < 0.8
