"""Estimates the constant bias of the roll and pitch that other sensors measure.

Over some fifty metres of ground a turn of the camera and a shift of its position look nearly the
same. Where the map is old or has little structure, the registration confuses them. Gravity
separates them, but a gimbal's horizon has an unreported bias of about a degree. The registration is
right about that bias on average: over other ground its error differs. So every fix over new ground
measures the bias, and the corrected attitude constrains the next frames
(docs/explanation/registration.md, section 9a).

All angles are about two horizontal world axes: the camera's right-hand side (pitch) and the
direction ahead of it (roll). The bias of a gimbal, a mounting or an autopilot stays the same there
while it turns.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from localizer.geometry.pose import Array, Pose, so3_exp, so3_log
from localizer.registration.priors import PoseConstraint
from localizer.sensors.error_model import SENSORS
from localizer.tracking.motion import RotationAt

_LEAST_SIGMA_DEG = 0.05
_LEAST_LEVEL = 0.3  # of the camera's x axis that is horizontal: rolled further, there is no pitch
_TAKEN = 4.0  # sigmas: beyond, nothing is learned
_CAUTIOUS = 2.0  # sigmas from which a measurement counts less: over some ground vision errs
_REFUSED_IN_ROW = 5  # then it is the constant that has changed: a gimbal that was knocked
_LEAST_SPREAD_COUNT, _MOST_SPREAD_COUNT = 5.0, 60.0  # measurements that the spread is a mean of
_MOST_SPREAD_RAD = float(np.radians(3.0))
_LARGEST_SIGMA_RAD = float(np.radians(2.0))  # of a registration that has something to say
_WALK_RAD = float(np.radians(0.01))  # of the constant, per root second: a gimbal warms up
# Nearer to the ground fewer patches of it are in view that err by themselves: from 40 m the
# registration's tilt was off by 1.1 degrees rms where it told 0.4 (docs/results/flights.md, `low`).
_HONEST_M = 100.0
_APART, _LEAST_APART_M = 0.5, 20.0  # of the distance; between two places that see other ground


@dataclass(frozen=True)
class AttitudePrior:
    """Accuracy of the camera's reported roll and pitch. tilt_sigma_deg: of the varying error;
    alignment_sigma_deg: of the constant bias.
    """

    tilt_sigma_deg: float = SENSORS.tilt_deg  # smallest error of roll and pitch, without the bias
    alignment_sigma_deg: float = (
        SENSORS.alignment_deg
    )  # their bias before it is estimated in flight

    @classmethod
    def with_sigma(cls, sigma_deg: float) -> AttitudePrior:
        """Roll and pitch with this sigma (at least 0.05 degrees) and without a constant bias."""
        return cls(max(sigma_deg, _LEAST_SIGMA_DEG), _LEAST_SIGMA_DEG)


@dataclass(frozen=True)
class AttitudeBias:
    """Estimated bias of the other sensors' roll and pitch.

    mean: (2,) rad about the two axes; the reported attitude rotated by it is the true one.
    covariance: (2, 2) of the mean. spread: variance (rad²) of the varying part, averaged over
    `count` measurements. place: (2,) east and north (m) of the last measurement, made at
    `time_ns`. refused: number of measurements refused in a row.
    """

    covariance: Array
    spread: float
    mean: Array = field(default_factory=lambda: np.zeros(2))
    count: float = _LEAST_SPREAD_COUNT
    place: Array | None = None
    time_ns: int = 0
    refused: int = 0

    @property
    def sigma_rad(self) -> float:
        """Sigma of the reported roll and pitch after correction, along the worse axis."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1] + self.spread))

    @property
    def off_deg(self) -> tuple[float, float]:
        """`mean` in degrees: pitch (up positive) and roll (right side down positive) to add to the
        reported attitude.
        """
        pitch, roll = np.degrees(self.mean)
        return float(pitch), float(roll)

    @property
    def reported_deg(self) -> tuple[float, float, float]:
        """Rounded `off_deg` (pitch, roll) and `sigma_rad` in degrees, for health reports."""
        pitch, roll, sigma = (
            round(float(v), 2) for v in (*self.off_deg, np.degrees(self.sigma_rad))
        )
        return pitch, roll, sigma


def initial_bias(config: AttitudePrior) -> AttitudeBias:
    """The bias before the first observation: zero, with the prior's sigmas."""
    alignment, tilt = np.radians([config.alignment_sigma_deg, config.tilt_sigma_deg])
    return AttitudeBias(np.eye(2) * alignment**2, float(tilt**2))


def horizontal_axes(rotation: Array) -> Array | None:
    """(3, 2) horizontal unit vectors in the world: to a camera's right, and ahead of it. rotation:
    its world_from_camera (3, 3). None if it is rolled on its side.
    """
    right = np.array([rotation[0, 0], rotation[1, 0], 0.0])
    length = float(np.hypot(right[0], right[1]))
    if length < _LEAST_LEVEL:
        return None
    right /= length
    return np.column_stack([right, np.array([-right[1], right[0], 0.0])])


def constraint(bias: AttitudeBias, reported: Array) -> PoseConstraint | None:
    """Constraint of the camera's roll and pitch from its reported rotation (3, 3), corrected by the
    bias; None if it is rolled on its side.
    """
    axes = horizontal_axes(reported)
    if axes is None:
        return None
    rotation = so3_exp(axes @ bias.mean) @ reported
    known = bias.covariance + np.eye(2) * bias.spread
    information = np.zeros((6, 6))
    information[3:, 3:] = axes @ np.linalg.inv(known) @ axes.T
    return PoseConstraint(Pose(rotation, np.zeros(3)), information)


@dataclass(frozen=True)
class AttitudeObservation:
    """A registration at `time_ns` that did not use the attitude. covariance: (6, 6) of its pose,
    with map and calibration errors; distance_m: to the ground in view.
    """

    pose: Pose
    covariance: Array
    distance_m: float
    time_ns: int


def is_new_ground(bias: AttitudeBias, place: Array, distance_m: float) -> bool:
    """Whether an observation from the position `place` (3,), world m, is independent of the last
    one: at least 20 m from it, and half of `distance_m`, the distance to the ground in view. Over
    the same ground, errors repeat.
    """
    apart_m = max(_LEAST_APART_M, _APART * distance_m)
    return bias.place is None or bool(np.hypot(*(place[:2] - bias.place)) >= apart_m)


def without_observation(bias: AttitudeBias, place: Array, time_ns: int) -> AttitudeBias:
    """The bias after uninformative ground at `place` (3,), world m, which then counts as the place
    of the last observation. The covariance grows with the time since the one before.
    """
    apart_s = abs(time_ns - bias.time_ns) * 1e-9 if bias.place is not None else 0.0
    walked = np.eye(2) * _WALK_RAD**2 * min(apart_s, 60.0)
    covariance = bias.covariance + walked
    return replace(bias, covariance=covariance, place=place[:2].copy(), time_ns=time_ns)


def with_observation(
    bias: AttitudeBias, config: AttitudePrior, reported: Array, observation: AttitudeObservation
) -> AttitudeBias:
    """The bias after another observation. reported: rotation (3, 3) world_from_camera by the
    sensors, of the observation's time. An observation more than 4 sigmas off is refused; the fifth
    refusal in a row resets the bias to `initial_bias`. An observation too uncertain to count only
    sets place and time; a camera rolled on its side changes nothing.
    """
    axes = horizontal_axes(reported)
    if axes is None:
        return bias
    seen = observation.pose
    here = without_observation(bias, seen.translation, observation.time_ns)
    R = (
        axes.T
        @ observation.covariance[3:, 3:]
        @ axes
        * max(1.0, _HONEST_M / observation.distance_m) ** 2
    )
    if np.linalg.eigvalsh(R)[-1] > _LARGEST_SIGMA_RAD**2:
        return here
    P = here.covariance
    off = axes.T @ so3_log(seen.rotation @ reported.T) - bias.mean
    S = P + R + np.eye(2) * bias.spread
    sigmas = _sigmas(off, S)
    if sigmas > _TAKEN:
        if bias.refused + 1 < _REFUSED_IN_ROW:
            return replace(here, refused=bias.refused + 1)
        return replace(initial_bias(config), place=here.place, time_ns=here.time_ns)
    S = S * max(1.0, sigmas / _CAUTIOUS) ** 2
    gain = P @ np.linalg.inv(S)
    count = min(bias.count + 1.0, _MOST_SPREAD_COUNT)
    beside = float(off @ off - np.trace(P + R)) / 2.0
    spread = bias.spread + (beside - bias.spread) / count
    least = float(np.radians(config.tilt_sigma_deg)) ** 2
    return replace(
        here, mean=bias.mean + gain @ off, covariance=P - gain @ S @ gain.T, count=count,
        spread=max(min(spread, _MOST_SPREAD_RAD**2), least), refused=0,
    )  # fmt: skip


class AttitudeBiasEstimator:
    """Estimates the attitude bias of one camera; use it on the localization thread.

    config: None: there is no bias and no constraint. rotation_at: returns the reported (3, 3)
    world_from_camera at a time in ns, or None.
    """

    def __init__(self, config: AttitudePrior | None, rotation_at: RotationAt) -> None:
        self._config, self._rotation_at = config, rotation_at
        self.bias = None if config is None else initial_bias(config)
        """None where nothing is constrained."""

    def constraint(self, time_ns: int) -> PoseConstraint | None:
        """Constraint of the camera's roll and pitch at a frame's exposure; None if unknown."""
        reported = self._rotation_at(time_ns)
        if self.bias is None or reported is None:
            return None
        return constraint(self.bias, reported)

    def is_due(self, place: Array, distance_m: float) -> bool:
        """Whether an observation from the position `place` (3,) is wanted."""
        return self.bias is not None and is_new_ground(self.bias, place, distance_m)

    def skip_ground(self, place: Array, time_ns: int) -> None:
        """Call instead of `learn` if the ground seen from `place` (3,) is uninformative: the next
        observation is due at another position.
        """
        if self.bias is not None:
            self.bias = without_observation(self.bias, place, time_ns)

    def learn(self, observation: AttitudeObservation) -> None:
        """Add an observation; without a reported attitude it only counts as made."""
        reported = self._rotation_at(observation.time_ns)
        if reported is None:
            self.skip_ground(observation.pose.translation, observation.time_ns)
        elif self.bias is not None and self._config is not None:
            self.bias = with_observation(self.bias, self._config, reported, observation)


def _sigmas(off: Array, covariance: Array) -> float:
    """Mahalanobis distance of a vector (2,) from zero."""
    return float(np.sqrt(off @ np.linalg.solve(covariance, off)))
