"""The pose that the odometry propagates: predicted, tested, and updated by each frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from localizer.geometry.pose import Array, Pose
from localizer.integrity.probability import log_odds
from localizer.odometry.config import GrowthModel, OdometryConfig
from localizer.odometry.estimate import OdometryFrame
from localizer.odometry.growth import (
    between,
    distance_covariance,
    fuse,
    kalman_update,
    transferred,
    without_constant_error,
)
from localizer.odometry.keyframe import DepthSource, Keyframe
from localizer.registration.priors import PoseConstraint
from localizer.registration.result import Registration
from localizer.types import PosePrior, RegistrationStatus

_SEARCH_M, _SEARCH_RAD = 1.0, float(np.radians(2.0))  # sigmas of a search without a prediction
_SPEED_SIGMA = 1.0  # m/s, of a prediction's velocity


@dataclass(frozen=True)
class OdometryStart:
    """Last pose from another source, and data for the first keyframe."""

    frame: OdometryFrame
    pose: Pose
    covariance: Array
    surface: Array | None
    constraint: PoseConstraint | None

    def corrected(self, constraint: PoseConstraint | None) -> PoseConstraint | None:
        """The constraint without the sensors' constant error at the start, whose variances are
        added: that error is measured with the start's pose and is as wrong. None stays.
        """
        if constraint is None or self.constraint is None:
            return constraint
        corrected = without_constant_error(constraint, self.constraint, self.pose)
        information = np.diag(corrected.information)
        widened = information / (1.0 + information * self.covariance.diagonal())
        return replace(corrected, information=np.diag(widened))


@dataclass(frozen=True)
class OdometryTrack:
    """The last usable estimate. covariance: without the scale error. way_m: distance flown since
    the start. aided_rotation: the sensors' rotation then, if any. constraint: the other sensors'
    measurements without their constant error. relative: (6, 6) covariance relative to the keyframe.
    best: quality of the keyframe's first registration. unmatched_m2: variance of east and north
    beyond the covariance, which no measurement reduces.
    """

    pose: Pose
    covariance: Array
    velocity: Array
    time_ns: int
    way_m: float
    aided_rotation: Array | None
    constraint: PoseConstraint | None
    relative: Array
    best: float = 0.0
    unmatched_m2: float = 0.0

    def predict(
        self, config: OdometryConfig, time_ns: int, constraint: PoseConstraint | None
    ) -> PosePrior:
        """The predicted pose at time_ns, with its covariance: constant velocity, and the change of
        the sensors' rotation since the last frame (None: the last rotation).
        """
        dt = seconds(self.time_ns, time_ns)
        rotation, aided = self.pose.rotation, aided_rotation(constraint)
        if aided is not None and self.aided_rotation is not None:
            rotation = aided @ self.aided_rotation.T @ rotation
        pose = Pose(rotation, self.pose.translation + self.velocity * dt)
        reach = _SEARCH_M + 0.5 * config.acceleration_sigma * dt**2
        sigma = np.repeat([reach, _SEARCH_RAD * (1.0 + dt)], 3)
        return PosePrior(pose, np.diag(sigma**2), time_ns, self.velocity)

    def since_keyframe(
        self,
        config: OdometryConfig,
        prior: PosePrior,
        time_ns: int,
        constraint: PoseConstraint | None,
    ) -> PosePrior:
        """The prediction `prior`, with its covariance relative to the keyframe: errors of both are
        in `covariance` only.
        """
        dt = seconds(self.time_ns, time_ns)
        reach = np.hypot(_SPEED_SIGMA * dt, 0.5 * config.acceleration_sigma * dt**2)
        turn = np.repeat(_SEARCH_RAD * (1.0 + dt), 3)
        if self.aided_rotation is not None and aided_rotation(constraint) is not None:
            turn = config.turn_sigma
        motion = np.diag(np.concatenate([np.repeat(reach, 3), turn]) ** 2)
        return PosePrior(prior.world_from_camera, self.relative + motion, time_ns)


def growth_of(config: OdometryConfig, source: DepthSource) -> GrowthModel:
    """The error growth model for a depth source."""
    return {
        DepthSource.MAP: config.with_map,
        DepthSource.GROUND: config.with_ground,
        DepthSource.RANGE: config.with_range,
        DepthSource.PLANE: config.with_plane,
    }[source]


def rejection(
    config: OdometryConfig, result: Registration, keyframe: Keyframe, predicted: PosePrior
) -> str:
    """Why a registration against the keyframe is rejected; "" if it is used. predicted: relative to
    the keyframe.

    Image and prediction are two independent pieces of evidence, so their log likelihoods add up.
    What does not move with the ground (dirt, fixed noise of a dark image) matches the keyframe's
    own pose.
    """
    if result.status is not RegistrationStatus.OK:
        return str(result.status.value)
    if result.overlap < config.min_overlap:
        return f"overlap {result.overlap:.2f} is below {config.min_overlap:g}"
    sigma = float(np.sqrt(result.covariance.diagonal()[:3].max()))
    if sigma > config.max_sigma_m:
        return f"position sigma {sigma:.1f} m is beyond {config.max_sigma_m:g}"
    pose, covariance = result.world_from_camera, result.covariance
    distance = predicted.mahalanobis_squared(pose, covariance)
    still = PosePrior(keyframe.world_from_camera, covariance, keyframe.time_ns)
    # In a hover both are near 0: it is surer by as much as a step has to be.
    if 0.5 * (distance - still.mahalanobis_squared(pose)) > config.min_log_odds:
        return "the picture stands still, and the prediction does not"
    odds = log_odds(result) - 0.5 * distance
    if not odds >= config.min_log_odds:
        return f"log odds {odds:.1f} are below {config.min_log_odds:g}"
    return ""


def track_after(
    config: OdometryConfig,
    track: OdometryTrack,
    keyframe: Keyframe,
    result: Registration,
    time_ns: int,
    sensed: tuple[PoseConstraint | None, PoseConstraint | None],
) -> OdometryTrack:
    """The track after a registration against the keyframe.

    sensed: other sensors' constraint of this frame, as measured and without their constant error.
    """
    constraint, corrected = sensed
    model, begun = growth_of(config, keyframe.source), keyframe.world_from_camera
    hop = float(np.linalg.norm(result.world_from_camera.translation - begun.translation))
    relative = model.registration * result.covariance + distance_covariance(model, hop)
    pose = result.world_from_camera
    if keyframe.constraint is not None and corrected is not None:
        turn, rise = config.turn_sigma, config.rise_sigma_m
        if known := between(keyframe.constraint, corrected, begun, turn, rise):
            pose, relative = kalman_update(pose, relative, known)
    lever = pose.translation - begun.translation
    pose, covariance = fuse(pose, transferred(keyframe.covariance, lever) + relative, corrected)
    dt = seconds(track.time_ns, time_ns)
    velocity = (pose.translation - track.pose.translation) / dt if dt > 0 else track.velocity
    unmatched = (model.unmatched * (1.0 - result.quality)) ** 2 * hop
    return OdometryTrack(
        pose, covariance, velocity, time_ns, keyframe.way_m + hop, aided_rotation(constraint),
        corrected, relative, track.best or result.quality, keyframe.unmatched_m2 + unmatched,
    )  # fmt: skip


def aided_rotation(constraint: PoseConstraint | None) -> Array | None:
    """Rotation (3, 3) of a constraint; None if it has none."""
    known = constraint is not None and bool(np.diag(constraint.information)[3:].all())
    return constraint.world_from_camera.rotation if known and constraint is not None else None


def seconds(begin_ns: int, end_ns: int) -> float:
    """Seconds between two times in nanoseconds."""
    return (end_ns - begin_ns) * 1e-9
