"""Fuses attitude and height of other sensors with a registered pose.

The registration uses no other sensor. Its covariance says what the image cannot determine, such as
a tilt against a shift over flat ground, or a tilt against roofs that the map lacks. One Kalman
update with roll, pitch and height, each with its own sigma, then gives the fused pose
(docs/explanation/registration.md, section 9a).

The same registrations estimate two errors that no sensor reports: the constant bias of the reported
attitude (`attitude_bias`) and the map's height error (`localizer.integrity.height_error`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from localizer.geometry.pose import Array, Pose
from localizer.integrity.height_error import MapHeightError, height_likelihood
from localizer.integrity.patch_covariance import patch_covariance
from localizer.map.kind import MapKind
from localizer.registration.priors import PoseConstraint, combine, fuse, height_constraint
from localizer.registration.result import Registration
from localizer.tracking.attitude_bias import (
    AttitudeBiasEstimator,
    AttitudeObservation,
    AttitudePrior,
)
from localizer.tracking.dead_reckoning import curvature_drop_m
from localizer.tracking.motion import AuxiliarySensors
from localizer.types import RegistrationStatus

CONTRADICTS = 4.0
"""Sigmas between the registered pose and a sensor from which one of them is wrong."""


@dataclass(frozen=True)
class FusedRegistration:
    """A registration fused with other sensors. registration: its pose and covariance after the
    update; contradicted: whether a sensor differs so much that it was ignored.
    """

    registration: Registration
    contradicted: bool = False


def with_map_error(result: Registration, height_sigma_m: float) -> Registration:
    """The registration with the covariance from its image patches and the map's height error; its
    own covariance becomes `noise`. NO_TEXTURE if the patches determine no covariance; unchanged
    without patches or if not OK. height_sigma_m: RMS of the heights that the map lacks.
    """
    votes = result.agreement
    if result.status is not RegistrationStatus.OK or votes is None:
        return result
    if votes.displacements is None:
        return result
    by_residuals = result.covariance - result.mode_covariance
    covariance = patch_covariance(votes.displacements, height_sigma_m, by_residuals)
    if covariance is None:
        return replace(result, status=RegistrationStatus.NO_TEXTURE)
    # The patches' displacements are the map's, alike from frame to frame. A motion filter that
    # took them for noise of each frame would lag behind the camera.
    whole = covariance + result.mode_covariance
    return replace(result, covariance=whole, noise=result.covariance)


def fused_registration(
    result: Registration, constraints: Iterable[PoseConstraint]
) -> FusedRegistration:
    """Fuse the registration with the other sensors, one after another; a constraint 4 sigmas away
    is ignored and noted. A registration that is not OK stays as it is.
    """
    if result.status is not RegistrationStatus.OK:
        return FusedRegistration(result)
    pose, covariance, contradicted = result.world_from_camera, result.covariance, False
    for known in constraints:
        found = fuse(pose, covariance, known)
        if found.innovation_squared > CONTRADICTS**2:
            contradicted = True
            continue
        pose, covariance = found.world_from_camera, found.covariance
    together = replace(result, world_from_camera=pose, covariance=covariance)
    return FusedRegistration(together, contradicted)


class SensorFusion:
    """Fuses registrations with attitude and height; use it on the localization thread.

    attitude, height_sigma_m: accuracy of roll and pitch, and of the height; None: not used.
    map_kind: None if unknown.
    """

    def __init__(
        self,
        attitude: AttitudePrior | None,
        height_sigma_m: float | None,
        sensors: AuxiliarySensors,
        map_kind: MapKind | None = None,
    ) -> None:
        self._sensors, self._height_sigma_m = sensors, height_sigma_m
        self.attitude_bias = AttitudeBiasEstimator(attitude, sensors.rotation_at)
        self.height_error = MapHeightError.of_kind(map_kind)
        self._is_surface = map_kind is not None and map_kind.has_buildings

    def fuse(self, result: Registration, time_ns: int) -> FusedRegistration:
        """Fuse a frame's registration with attitude and height at `time_ns`, after widening it by
        the map's error (`with_map_error`).
        """
        known = self._constraints(result.world_from_camera, time_ns)
        return fused_registration(self._with_map_error(result), known)

    def _with_map_error(self, result: Registration) -> Registration:
        return with_map_error(result, self.height_error.sigma_m)

    def learn(
        self, result: Registration, pose: Pose, unknown: Array, distance_m: float, time_ns: int
    ) -> None:
        """Update attitude bias and height error with an accepted frame, if it shows new ground.
        Without `LocalizerConfig.attitude` (never in flight) nothing is learned: the height error
        stays that of the map's kind.

        result: its registration before `fuse`; pose: the accepted pose; unknown: (6, 6) covariance
        of the errors of map and camera model; distance_m: to the ground in view.
        """
        if not self.attitude_bias.is_due(pose.translation, distance_m):
            return
        votes = result.agreement
        if votes is not None and votes.displacements is not None:
            # A gimbal that sinks looks like missing buildings. Over a surface model it would make
            # the pose less sure and pull it along, so there the image alone is heard.
            known = [] if self._is_surface else self._constraints(pose, time_ns)
            likelihood = height_likelihood(
                votes.displacements, result.world_from_camera, combine(*known) if known else None
            )
            if likelihood is not None:
                self.height_error = self.height_error.updated(likelihood)
        seen = self._with_map_error(result)
        if seen.status is not RegistrationStatus.OK:
            self.attitude_bias.skip_ground(pose.translation, time_ns)
            return
        self.attitude_bias.learn(
            AttitudeObservation(
                seen.world_from_camera, seen.covariance + unknown, distance_m, time_ns
            )
        )

    def _constraints(self, about: Pose, time_ns: int) -> list[PoseConstraint]:
        """Constraints by attitude and height at a time; about: the camera's approximate pose."""
        known = []
        tilt = self.attitude_bias.constraint(time_ns)
        if tilt is not None:
            known.append(tilt)
        height_m = self._sensors.height_at(time_ns)
        if height_m is not None and self._height_sigma_m is not None:
            world_z = height_m - curvature_drop_m(about.translation)
            known.append(height_constraint(world_z, self._height_sigma_m))
        return known


def distance_m(points_world: Array, place: Array) -> float:
    """Distance from `place` (3,) to the centroid of points (N, 3), both world m; at least 1 m."""
    return max(float(np.linalg.norm(points_world.mean(axis=0) - place)), 1.0)
