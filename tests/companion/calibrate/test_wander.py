"""A heading's error turns about the vertical: what is said of mounting and heading must know it."""

from __future__ import annotations

import numpy as np
import pytest

from companion.calibrate.wander import AttitudeProcess, GaussMarkovProcess
from companion.geometry import GIMBAL_FROM_CAMERA
from localizer.geometry.pose import Array, matrix_from_euler

TIMES_S = np.arange(200) * 0.9
MEMORY_S = 6.0
# Of roll and pitch of a gimbal, and of a heading: a compass's and the gimbal's own yaw, rad.
ROLL, PITCH, HEADING = np.radians([0.3, 0.3, 0.42])
LEAST, WHITE = np.radians(0.05), np.radians(0.03)
PITCHES_DEG = np.array([-90.0, -60.0, -75.0, -50.0, -85.0, -65.0])


def axes() -> tuple[Array, Array]:
    """(K, 3, 3) roll, pitch and heading in the camera's axes; (K, 3) its up."""
    made, up = [], []
    for t in TIMES_S:
        pitch = np.radians(PITCHES_DEG[int(t // 12) % len(PITCHES_DEG)])
        gimbal = matrix_from_euler(0.0, float(pitch), 0.0)
        camera = (gimbal @ GIMBAL_FROM_CAMERA).T
        made.append(camera @ np.stack([gimbal[:, 0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], axis=1))
        up.append(camera @ [0.0, 0.0, -1.0])
    return np.array(made), np.array(up)


def true_covariance(sources: Array) -> Array:
    """(3 K, 3 K) of the errors, exactly."""
    kept = np.exp(-np.abs(TIMES_S[:, None] - TIMES_S) / MEMORY_S)
    scaled = sources * [ROLL, PITCH, HEADING]
    size = 3 * len(TIMES_S)
    made = np.einsum("kip,ljp,kl->kilj", scaled, scaled, kept).reshape(size, size)
    return np.asarray(made + np.eye(size) * WHITE**2)


def said_and_true(wander: GaussMarkovProcess | AttitudeProcess) -> tuple[Array, Array]:
    """(4,) sigmas of mounting and heading as they are said, and as they are."""
    sources, up = axes()
    size = 3 * len(TIMES_S)
    whiten = wander.whitened(np.eye(size).reshape(-1, 3, size), TIMES_S, WHITE)
    columns = np.concatenate([np.broadcast_to(np.eye(3), (len(up), 3, 3)), up[..., None]], axis=2)
    x = whiten @ columns.reshape(size, 4)
    window = np.linalg.inv(x.T @ x)
    gain = window @ x.T @ whiten
    return np.sqrt(np.diag(window)), np.sqrt(np.diag(gain @ true_covariance(sources) @ gain.T))


def test_what_is_said_of_mounting_and_heading_is_as_unsure_as_it_is():
    """By axis of the camera alone, the heading was said twice as surely as it is."""
    _, up = axes()
    by_axis = GaussMarkovProcess(
        np.hypot([PITCH, 0.5 * HEADING, ROLL], [0, 0, HEADING]), np.full(3, MEMORY_S)
    )
    window, true = said_and_true(by_axis)
    assert true[3] > 1.5 * window[3]
    sigmas = np.array([PITCH, 1e-6, ROLL, HEADING, 1e-6])
    said_better, true_better = said_and_true(AttitudeProcess(sigmas, MEMORY_S, up))
    assert said_better == pytest.approx(true_better, rel=1e-3)
    assert true_better[2] < 0.75 * true[2]  # of the mounting about the boresight
    assert true_better[3] < 0.9 * true[3]


def test_errors_about_the_vertical_are_told_from_those_of_the_mounting():
    sources, up = axes()
    rng = np.random.default_rng(4)
    kept = np.exp(-0.9 / MEMORY_S)
    errors = rng.normal(0.0, 1.0, (len(TIMES_S), 3))
    for k in range(1, len(errors)):
        errors[k] = kept * errors[k - 1] + np.sqrt(1.0 - kept**2) * errors[k]
    left = np.einsum("kip,kp->ki", sources * [ROLL, PITCH, HEADING], errors)
    left = left + rng.normal(0.0, WHITE, left.shape)
    found = AttitudeProcess.of(left, up, TIMES_S, LEAST, WHITE)
    assert np.hypot(*found.sigma[3:]) == pytest.approx(HEADING, rel=0.5)
    assert found.sigma[[0, 2]] == pytest.approx([PITCH, ROLL], rel=0.35)
    assert found.sigma[1] < 0.5 * HEADING
    assert 3.0 < found.memory_s < 15.0


def strays(rng: np.random.Generator, sigma_m: float, memory_s: float, smooth_s: float) -> Array:
    """(K, 3): a receiver's errors as an EKF passes them on."""
    kept, passed = np.exp(-np.diff(TIMES_S) / memory_s), np.exp(-0.9 / smooth_s)
    raw = sigma_m * rng.normal(size=(len(TIMES_S), 3))
    for k in range(1, len(raw)):
        raw[k] = kept[k - 1] * raw[k - 1] + np.sqrt(1.0 - kept[k - 1] ** 2) * raw[k]
    made = raw.copy()
    for k in range(1, len(raw)):
        made[k] = passed * made[k - 1] + (1.0 - passed) * raw[k]
    return made


def test_an_ekf_that_smooths_does_not_make_its_receiver_better():
    rng = np.random.default_rng(1)
    short, told = [], []
    for _ in range(20):
        left = strays(rng, 0.25, 60.0, smooth_s=4.0)
        wander = GaussMarkovProcess.of(left, TIMES_S, 0.08)
        short.append(wander.sigma)
        told.append(wander.over_long_steps(left, TIMES_S).sigma)
    assert np.median(short) < 0.6 * 0.25
    assert 0.65 * 0.25 < np.median(told) < 1.2 * 0.25


def test_errors_that_nothing_smooths_are_said_as_before():
    rng = np.random.default_rng(2)
    ratios = []
    for memory_s in (2.0, 8.0):
        left = strays(rng, 0.25, memory_s, smooth_s=1e-3)
        wander = GaussMarkovProcess.of(left, TIMES_S, 0.08)
        ratios.append(wander.over_long_steps(left, TIMES_S).sigma / wander.sigma)
    assert np.max(ratios) < 1.15
    few = TIMES_S[:20]
    assert wander.over_long_steps(left[:20], few).sigma == pytest.approx(wander.sigma)
