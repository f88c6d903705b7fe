import numpy as np
import pytest

from localizer.geometry.pose import Pose, quaternion_from_matrix, so3_exp
from sitl.demo.analysis import (
    bound_figures,
    ekf_errors,
    frame_errors,
    localization_summary,
    stage_latencies,
    target_errors,
    targets_inside,
)


def _columns(poses, times, **more):
    q = np.array([quaternion_from_matrix(p.rotation) for p in poses]).reshape(-1, 4)
    t = np.array([p.translation for p in poses]).reshape(-1, 3)
    names = ("east_m", "north_m", "up_m", "qw", "qx", "qy", "qz")
    return {
        "exposure_time_ns": np.array(times, dtype=np.int64),
        **dict(zip(names, np.hstack([t, q]).T, strict=True)),
        **more,
    }


def _pose(x, angle=0.0, up=0.0):
    return Pose(so3_exp([0, 0, angle]), np.array([x, 0.0, up]))


def test_frames_are_matched_by_time_and_measured():
    truth = _columns([_pose(0.0), _pose(1.0), _pose(2.0), _pose(3.0)], [0, 10**8, 2 * 10**8, 3e8])
    estimates = _columns(
        [_pose(0.3, up=0.4), _pose(2.0, 0.1), _pose(9.0)], [0, 2 * 10**8, 3 * 10**8],
        accepted=np.array([1, 1, 0]),
    )  # fmt: skip
    errors = frame_errors(truth, estimates, (0, 10**9))
    np.testing.assert_array_equal(errors.processed, [True, False, True, True])
    np.testing.assert_allclose(errors.translation_m, [0.5, np.nan, 0.0, np.nan], atol=1e-9)
    np.testing.assert_allclose(errors.horizontal_m, [0.3, np.nan, 0.0, np.nan], atol=1e-9)
    assert errors.rotation_deg[2] == pytest.approx(np.degrees(0.1))
    summary = localization_summary(errors)
    assert summary.frames == 3
    assert summary.completeness == pytest.approx(200 / 3)
    assert summary.fps == pytest.approx(2 / 0.3)


def test_frames_outside_the_span_do_not_count():
    truth = _columns([_pose(0.0), _pose(1.0)], [0, 10**9])
    estimates = _columns([_pose(0.0), _pose(1.0)], [0, 10**9], accepted=np.array([1, 1]))
    assert len(frame_errors(truth, estimates, (5, 2 * 10**9)).time_ns) == 1


def test_fixes_are_counted_against_their_bound_and_their_protection_level():
    times = [k * 10**8 for k in range(5)]
    truth = _columns([_pose(0.0)] * 5, times)
    wrong_m = [0.5, 1.0, 3.0, 9.0, 9.0]  # 2.45 sigmas are the ellipse; the last is not accepted
    estimates = _columns(
        [_pose(x) for x in wrong_m], times, accepted=np.array([1, 1, 1, 1, 0]),
        sigma_east_m=np.full(5, 1.0), sigma_north_m=np.full(5, 1.0),
        hpl_m=np.array([2.0, 2.0, 4.0, 4.0, 1.0]),
    )  # fmt: skip
    found = bound_figures(truth, estimates, (0, 10**9))
    assert (found.inside_bound, found.inside_level) == (50.0, 75.0)
    assert found.level_m.median == 3.0
    assert bound_figures(truth, {}, (0, 10**9)).inside_level is None


def test_ekf_target_and_stage_errors():
    vehicle = {"time_ns": np.array([0, 1, 2])}
    for axis, offset in (("east", 3.0), ("north", 4.0), ("up", -1.0)):
        vehicle[f"{axis}_m"] = np.zeros(3)
        vehicle[f"ekf_{axis}_m"] = np.full(3, offset)
    np.testing.assert_allclose(ekf_errors(vehicle, (1, 2)), [5.0, 5.0])
    targets = {
        "target_id": np.array(["a", "b", "a"]), "exposure_time_ns": np.array([1, 1, 7]),
        "east_m": np.array([1.0, 0.0, 0.0]), "north_m": np.zeros(3), "up_m": np.zeros(3),
        "cov_ee": np.full(3, 0.1), "cov_en": np.zeros(3), "cov_nn": np.ones(3),
    }  # fmt: skip
    truth = {"a": {1: np.zeros(3)}, "b": {1: np.zeros(3)}}
    np.testing.assert_allclose(target_errors(targets, truth, (0, 5))["a"], [1.0])
    assert targets_inside(targets, truth, (0, 5)) == 50.0  # 1 m at a sigma of 0.32 m is outside
    assert targets_inside(targets, {}, (0, 5)) is None
    stages = stage_latencies({"exposure_time_ns": np.array([0, 9]), "x_ms": np.array([4.0, 8.0])},
                             (0, 5))  # fmt: skip
    assert stages["x"].median == 4.0
