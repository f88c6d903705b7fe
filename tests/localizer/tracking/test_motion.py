from dataclasses import replace

import numpy as np
import pytest

from localizer.geometry.pose import Pose, so3_exp
from localizer.integrity.acceptance import IntegrityConfig
from localizer.tracking import motion
from localizer.tracking.motion import MotionConfig
from localizer.types import PosePrior

CONFIG = MotionConfig()
SECOND = 1_000_000_000


def _prior(sigma: float = 1.0) -> PosePrior:
    return PosePrior(Pose.identity(), np.eye(6) * sigma**2, 0)


def test_filter_learns_a_constant_velocity_and_turn_rate():
    velocity, rate = np.array([8.0, -3.0, 1.0]), np.array([0.0, 0.1, 0.3])
    state = motion.start(_prior(), CONFIG)
    for k in range(1, 31):
        t = 0.1 * k
        pose = Pose(so3_exp(rate * t), velocity * t)
        ahead = motion.predict(state, round(t * SECOND), CONFIG)
        state = motion.update(ahead, pose, np.eye(6) * 1e-4)
    ahead = motion.predict(state, round(3.5 * SECOND), CONFIG)
    truth = Pose(so3_exp(rate * 3.5), velocity * 3.5)
    translation, rotation = truth.distance_to(ahead.prior.world_from_camera)
    assert translation < 0.05
    assert rotation < 0.1
    np.testing.assert_allclose(state.velocity, velocity, atol=0.05)


def test_filtered_errors_match_the_filters_own_covariance():
    """NEES over many runs: the mean of chi² with 6 degrees of freedom is 6."""
    rng = np.random.default_rng(1)
    nees = []
    for _ in range(60):
        velocity = rng.normal(0, 5, 3)
        state = motion.start(_prior(3.0), CONFIG)
        truth = Pose.identity()
        for k in range(1, 40):
            dt = 0.1
            velocity = velocity + rng.normal(0, CONFIG.acceleration_sigma, 3) * dt
            truth = Pose(truth.rotation, truth.translation + velocity * dt)
            noise = rng.normal(0, [0.3] * 3 + [0.005] * 3)
            seen = Pose(so3_exp(noise[3:]) @ truth.rotation, truth.translation + noise[:3])
            R = np.diag([0.09] * 3 + [0.005**2] * 3)
            ahead = motion.predict(state, round(k * dt * SECOND), CONFIG)
            state = motion.update(ahead, seen, R)
        nees.append(state.prior.mahalanobis_squared(truth))
    # The rotation never accelerates here, so its part is conservative.
    assert 2.0 < np.mean(nees) < 8.0


def test_a_measured_turn_replaces_the_constant_rate():
    state = motion.start(_prior(0.01), CONFIG)
    turn = so3_exp([0.0, 0.0, 0.5])
    ahead = motion.predict(state, SECOND, CONFIG, turn)
    np.testing.assert_allclose(ahead.rotation, turn, atol=1e-12)
    blind = motion.predict(state, SECOND, CONFIG)
    assert ahead.covariance[5, 5] < 0.01 * blind.covariance[5, 5]
    # and what follows without a measurement goes on turning at that rate
    later = motion.predict(ahead, 2 * SECOND, CONFIG)
    np.testing.assert_allclose(later.rotation, so3_exp([0.0, 0.0, 1.0]), atol=1e-9)


def _registrations(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors (count, 6) of registrations from 120 m and their covariance: who errs in tilt by a
    tenth of a degree is 0.2 m beside.
    """
    P = np.diag([0.03**2] * 6) * 1e-4
    P[:3, :3] += np.eye(3) * 0.03**2
    for position, tilt, sign in ((0, 4, -1.0), (1, 3, 1.0)):
        lever = np.zeros(6)
        lever[position], lever[tilt] = sign * 120.0, 1.0
        P += np.outer(lever, lever) * 0.0015**2
    return rng.multivariate_normal(np.zeros(6), P, count), P


@pytest.mark.parametrize(("rate_deg_s", "share"), [(0.0, 0.75), (40.0, 0.85)])
def test_a_turn_that_is_known_better_mends_the_position(rate_deg_s, share):
    """What the gimbal says of the turn between two frames, and none of its constant error."""
    rng = np.random.default_rng(4)
    noise, P = _registrations(rng, 60)
    mounted = so3_exp([0.02, -0.01, 0.03])
    raw, fused, state, before = [], [], None, mounted
    for k in range(60):
        truth = Pose(so3_exp([0.0, 0.0, np.radians(rate_deg_s) * 0.1 * k]), [1.0 * k, 0, 120.0])
        told = mounted @ so3_exp(rng.normal(0, 7e-4, 3)) @ truth.rotation
        seen = Pose(so3_exp(noise[k, 3:]) @ truth.rotation, truth.translation + noise[k, :3])
        time_ns = round(0.1 * k * SECOND)
        if state is None:
            state = motion.start(PosePrior(seen, P, time_ns, np.array([10.0, 0, 0])), CONFIG)
        else:
            turn = told @ before.T
            ahead = motion.predict(state, time_ns, CONFIG, turn)
            state = motion.update(ahead, seen, P)
        before = told
        raw.append(np.linalg.norm(noise[k, :3]))
        fused.append(truth.distance_to(state.prior.world_from_camera)[0])
    assert np.median(raw[10:]) > 0.15
    assert np.median(fused[10:]) < share * np.median(raw[10:])


def test_a_turn_that_begins_passes_the_gate_only_where_it_is_told():
    """45 degrees a second from one frame to the next; told, the gate is the narrower one, too."""
    chi2_threshold, covariance = (
        IntegrityConfig().chi2_threshold,
        np.diag([0.05**2] * 3 + [0.002**2] * 3),
    )
    turn = so3_exp([0.0, 0.0, np.radians(4.5)])
    state = motion.start(_prior(0.1), CONFIG)
    for k in range(1, 21):
        ahead = motion.predict(state, k * SECOND // 10, CONFIG)
        state = motion.update(ahead, Pose.identity(), covariance)
    time_ns = 21 * SECOND // 10
    blind = motion.predict(state, time_ns, CONFIG).prior
    told = motion.predict(state, time_ns, CONFIG, turn).prior
    assert blind.mahalanobis_squared(Pose(turn, np.zeros(3)), covariance) > chi2_threshold
    assert told.mahalanobis_squared(Pose(turn, np.zeros(3)), covariance) < chi2_threshold
    beside = Pose(so3_exp([0.0, 0.0, np.radians(1.5)]), np.zeros(3))
    steady = motion.predict(state, time_ns, CONFIG, np.eye(3)).prior
    assert blind.mahalanobis_squared(beside, covariance) < chi2_threshold
    assert steady.mahalanobis_squared(beside, covariance) > chi2_threshold


def test_a_turns_error_grows_with_its_rate_and_with_time():
    still, state = np.eye(3), motion.start(_prior(1e-3), CONFIG)
    short = motion.predict(state, SECOND // 10, CONFIG, still).covariance[3, 3]
    long = motion.predict(state, 4 * SECOND, CONFIG, still).covariance[3, 3]
    fast = motion.predict(state, SECOND // 10, CONFIG, so3_exp([0.1, 0.0, 0.0])).covariance[3, 3]
    assert np.sqrt(long - short) > 0.007
    assert np.sqrt(fast - short) == pytest.approx(0.01, rel=0.01)


def test_the_priors_velocity_starts_the_filter():
    """A prior that knows its velocity is moved by it, with less doubt than one that does not."""
    moving = replace(_prior(), velocity=np.array([12.0, 0.0, 0.0]))
    ahead = motion.predict(motion.start(moving, CONFIG), SECOND, CONFIG)
    still = motion.predict(motion.start(_prior(), CONFIG), SECOND, CONFIG)
    np.testing.assert_allclose(ahead.mean[:3] - still.mean[:3], [12.0, 0.0, 0.0], atol=1e-9)
    assert ahead.covariance[0, 0] < 0.25 * still.covariance[0, 0]
