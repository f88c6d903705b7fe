"""Constant-velocity motion model of the camera pose (paper, Sec. 3.2), on filterpy.

The state is an error state about a nominal rotation: ``x = (p, phi, v, omega)``, shape (12,), in
world axes: position (m), small left rotation (rad), velocity (m/s), angular rate (rad/s).
`MotionState` is immutable and the functions are pure, so the render thread may predict from the
same state that the localization thread is about to replace.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from filterpy.kalman import predict as kalman_predict
from filterpy.kalman import update as kalman_update

from localizer.geometry.pose import Array, Pose, so3_exp, so3_log
from localizer.integrity.confirmation import DisplacementBetween
from localizer.types import PosePrior

# The camera's rotation (3, 3), world_from_camera, at a time in ns by another sensor, or None.
RotationAt = Callable[[int], "Array | None"]

_MAX_SIGMA_M = 10.0  # beyond it nothing is gained: the swarm's own limits are reached
_MAX_SIGMA_RAD = float(np.radians(8.0))
_FULL = 0.99  # of these limits: a prediction that they cut
_LONGEST_S = 10.0  # a camera's clock that jumped, or a gap that no velocity bridges
_H = np.hstack([np.eye(6), np.zeros((6, 6))])


@dataclass(frozen=True)
class MotionConfig:
    """Process noise of the constant-velocity model, as white accelerations.

    The limits are those of flight, and of double precision for adding and inverting.
    """

    acceleration_sigma: float = 3.0  # m/s²
    angular_acceleration_sigma: float = 1.0  # rad/s²
    turn_sigma: float = 0.001  # error of a measured turn between two frames, rad
    turn_walk: float = 0.004  # its growth, rad per root second
    turn_delay_s: float = 0.01  # its delay, times the turn rate
    initial_velocity_sigma: float = 8.0  # m/s, of an unknown velocity
    prior_velocity_sigma: float = 2.0  # m/s, of the velocity of a prior
    initial_angular_rate_sigma: float = 0.3  # rad/s


@dataclass(frozen=True)
class MotionState:
    """Filter state at `time_ns`: error-state mean (12,), covariance (12, 12), nominal rotation."""

    mean: Array
    covariance: Array
    rotation: Array
    time_ns: int

    @property
    def velocity(self) -> Array:
        """Velocity (3,) in world axes, m/s."""
        return self.mean[6:9]

    @property
    def rate(self) -> Array:
        """Angular rate (3,) in world axes, rad/s."""
        return self.mean[9:]

    @property
    def prior(self) -> PosePrior:
        """The state's pose and covariance (6, 6) as a `PosePrior`."""
        pose = Pose(self.rotation, self.mean[:3].copy())
        return PosePrior(pose, self.covariance[:6, :6].copy(), self.time_ns)


def start(prior: PosePrior, config: MotionConfig) -> MotionState:
    """Filter state from a prior, at its time. Without a velocity in the prior, the velocity is
    unknown; the angular rate always is.
    """
    mean = np.zeros(12)
    mean[:3] = prior.world_from_camera.translation
    known = prior.velocity is not None
    if known:
        mean[6:9] = prior.velocity
    P = np.zeros((12, 12))
    P[:6, :6] = prior.covariance
    velocity_sigma = config.prior_velocity_sigma if known else config.initial_velocity_sigma
    P[6:9, 6:9] = np.eye(3) * velocity_sigma**2
    P[9:, 9:] = np.eye(3) * config.initial_angular_rate_sigma**2
    return MotionState(mean, P, prior.world_from_camera.rotation, prior.time_ns)


def predict(
    state: MotionState, time_ns: int, config: MotionConfig, turn: Array | None = None
) -> MotionState:
    """The state at `time_ns`, which may be earlier than the state's own time.

    Over more than 10 s the motion is unknown (`reset_motion`). turn: measured rotation (3, 3) of
    the camera since the state's time in world axes (new = turn @ old); None: the angular rate is
    taken as constant.
    """
    dt = (time_ns - state.time_ns) * 1e-9
    if dt == 0.0:
        return state
    if abs(dt) > _LONGEST_S:
        return reset_motion(state, time_ns, config, turn)
    F = np.eye(12)
    F[:6, 6:] = np.eye(6) * dt
    Q = _process_noise(abs(dt), config)
    if turn is not None:
        F[3:6, 9:] = 0.0
        Q[3:6, :] = Q[:, 3:6] = 0.0
        Q[3:6, 3:6] = np.eye(3) * _turn_variance(turn, abs(dt), config)
    mean, P = kalman_predict(state.mean, state.covariance, F, Q)
    if turn is None:
        return _fold_rotation(mean, P, state.rotation, time_ns)
    mean, P = np.asarray(mean).reshape(12).copy(), np.asarray(P).copy()
    mean[9:] = so3_log(turn) / dt
    P[9:, :] = P[:, 9:] = 0.0
    P[9:, 9:] = np.eye(3) * config.initial_angular_rate_sigma**2
    return _fold_rotation(mean, P, turn @ state.rotation, time_ns)


def update(ahead: MotionState, pose: Pose, covariance: Array) -> MotionState:
    """Fuse a pose measured at the time of the predicted state `ahead`, covariance (6, 6)."""
    z = np.concatenate([pose.translation, so3_log(pose.rotation @ ahead.rotation.T)])
    mean, P = kalman_update(ahead.mean, ahead.covariance, z, covariance, _H)
    return _fold_rotation(mean, P, ahead.rotation, ahead.time_ns)


def inflate(state: MotionState, config: MotionConfig) -> MotionState:
    """The state with sigmas doubled, to at most those of a search, after a registration
    of good quality was rejected by it. If the vehicle manoeuvred, one of the next frames is then
    accepted. A wrong registration would have to be wrong in the same way again.
    """
    sigma = np.sqrt(state.covariance.diagonal())
    scale = np.clip(_limits(config) / sigma, 1.0, 2.0)
    return replace(state, covariance=state.covariance * np.outer(scale, scale))


def horizontal_sigma_m(prior: PosePrior) -> float:
    """Sigma of a prior's position along the worst horizontal direction, metres."""
    return float(np.sqrt(max(np.linalg.eigvalsh(prior.covariance[:2, :2])[-1], 0.0)))


def is_beyond_capture(prior: PosePrior) -> bool:
    """Whether a prediction is too uncertain for a registration to converge: a horizontal sigma of
    10 m or a rotation sigma of 8 degrees.
    """
    turn = float(np.sqrt(prior.covariance.diagonal()[3:].max()))
    return horizontal_sigma_m(prior) >= _FULL * _MAX_SIGMA_M or turn >= _FULL * _MAX_SIGMA_RAD


def reset_motion(
    state: MotionState, time_ns: int, config: MotionConfig, turn: Array | None
) -> MotionState:
    """The state's pose at another time with the sigmas of a search (10 m, 8 degrees) and unknown
    motion.

    Used for a camera whose clock jumped: its frames are consecutive, their times are not. turn: as
    in `predict`; None: the rotation is kept.
    """
    mean = np.concatenate([state.mean[:3], np.zeros(9)])
    rotation = state.rotation if turn is None else turn @ state.rotation
    return MotionState(mean, np.diag(_limits(config) ** 2), rotation, time_ns)


@dataclass(frozen=True)
class AuxiliarySensors:
    """Data of other sensors (autopilot and gimbal) about the camera; functions of a time in ns,
    None where unknown.

    rotation_at: (3, 3) world_from_camera. displacement_between: displacement (3,) between two times
    in world axes (m), and its sigma (m). height_at: the camera's height above the ellipsoid minus
    that of the world's origin (m); may have a constant error. clearance_at: height above the
    surface below (m), by a rangefinder.
    """

    rotation_at: RotationAt = lambda _time_ns: None
    displacement_between: DisplacementBetween = lambda _begin_ns, _end_ns: None
    height_at: Callable[[int], float | None] = lambda _time_ns: None
    clearance_at: Callable[[int], float | None] = lambda _time_ns: None

    def turn(self, begin_ns: int, end_ns: int) -> Array | None:
        """Rotation (3, 3) of the camera between two times, in world axes; None if unknown."""
        begin, end = self.rotation_at(begin_ns), self.rotation_at(end_ns)
        return end @ begin.T if begin is not None and end is not None else None


def _limits(config: MotionConfig) -> Array:
    """Sigmas (12,) of a state of which only the approximate pose is known."""
    return np.repeat(
        [_MAX_SIGMA_M, _MAX_SIGMA_RAD, config.initial_velocity_sigma,
         config.initial_angular_rate_sigma], 3,
    )  # fmt: skip


def _fold_rotation(mean: Array, P: Array, rotation: Array, time_ns: int) -> MotionState:
    """Move the rotation error into the nominal rotation, so that it stays small."""
    mean = np.asarray(mean, dtype=np.float64).reshape(12).copy()
    folded = so3_exp(mean[3:6]) @ rotation
    mean[3:6] = 0.0
    P = np.asarray(P, dtype=np.float64)
    return MotionState(mean, 0.5 * (P + P.T), folded, time_ns)


def _turn_variance(turn: Array, dt: float, config: MotionConfig) -> float:
    """Variance (rad², per axis) of a measured turn: noise, drift and delay of the sensor."""
    late = config.turn_delay_s * float(np.linalg.norm(so3_log(turn))) / dt
    return config.turn_sigma**2 + config.turn_walk**2 * dt + late**2


def _process_noise(dt: float, config: MotionConfig) -> Array:
    """Discrete white-noise acceleration, (12, 12) (Bar-Shalom, Estimation, 6.3.2)."""
    sigmas = np.repeat([config.acceleration_sigma, config.angular_acceleration_sigma], 3)
    by_derivative = np.array([[0.25 * dt**4, 0.5 * dt**3], [0.5 * dt**3, dt**2]])
    noise: Array = by_derivative[:, None, :, None] * np.diag(sigmas**2)[None, :, None, :]
    return noise.reshape(12, 12)
