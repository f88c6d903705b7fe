"""Propagates the pose by odometry while the map does not match.

Snow, a building site, the map's edge: the image is good but does not match the map. Every accepted
frame is kept as a possible start, at no cost; after rejected frames odometry continues from it
(docs/explanation/odometry.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from localizer.errors import OdometryError
from localizer.geometry.camera import Camera, with_field_of_view
from localizer.geometry.geo import EARTH_RADIUS_M
from localizer.geometry.pose import Array, Pose
from localizer.geometry.shutter import Sweep
from localizer.odometry.config import OdometryConfig
from localizer.odometry.estimate import OdometryFrame, OdometryStatus
from localizer.odometry.ground import TerrainModel
from localizer.odometry.odometry import VisualOdometry
from localizer.odometry.usability import find_fault
from localizer.registration.jngo import JNGO
from localizer.registration.priors import (
    PoseConstraint,
    attitude_constraint,
    combine,
    height_constraint,
)
from localizer.tracking.motion import AuxiliarySensors
from localizer.types import (
    Anchors,
    FeaturePyramid,
    Frame,
    GroundUncertainty,
    PoseEstimate,
    PosePrior,
)


def curvature_drop_m(place: Array) -> float:
    """Height (m) by which the Earth's curvature lowers the ground at a position (3,) below the
    tangent plane at the world's origin: 7.8 m at 10 km.
    """
    return float(place[:2] @ place[:2]) / (2.0 * EARTH_RADIUS_M)


class PropagationResult(Enum):
    """Result of the odometry for a frame that the map rejected."""

    NONE = "nothing to carry on from"
    CARRIED = "carried on"
    GAP = "this frame shows nothing; the next one may"
    BROKEN = "the thread is lost"


@dataclass(frozen=True)
class PropagatedPose:
    """The odometry's result for one frame. pose, covariance (6, 6), scale_sigma (see
    `OdometryEstimate`): None unless the status is CARRIED.
    """

    status: PropagationResult
    world_from_camera: Pose | None = None
    covariance: Array | None = None
    quality: float = 0.0
    scale_sigma: float | None = None


_NOTHING = PropagatedPose(PropagationResult.NONE)


# Sigmas of what the autopilot knows absolutely; its turns and rises since a keyframe are known
# better (`OdometryConfig`), and constant errors are taken out by the odometry.
_TILT_RAD, _HEADING_RAD, _HEIGHT_M = float(np.radians(0.4)), float(np.radians(3.0)), 0.5
_TRIED_NS = 10_000_000_000  # a map that comes into view, until it is searched


class DeadReckoning:
    """Odometry in parallel to the map's registration; use it on the localization thread.

    camera: the working pinhole, adapted to a lens that zooms. sensors: other sensors' data of the
    camera. terrain: shape of the ground; None: flat. ground: uncertainty of the ground, see
    `Localizer`.
    """

    def __init__(
        self, camera: Camera, optimizer: JNGO, config: OdometryConfig, threads: int,
        sensors: AuxiliarySensors, terrain: TerrainModel | None = None,
        ground: GroundUncertainty | None = None,
    ) -> None:  # fmt: skip
        self._sensors, self._pinhole = sensors, camera
        registration = JNGO(optimizer.config, optimizer.backend, threads)
        self._odometry = VisualOdometry(camera, registration, config, terrain, uncertainty=ground)
        self._longest_sigma_m = config.longest_sigma_m
        self._off_map_sigma_m = config.off_map_sigma_m
        self._in_view_ns: int | None = None

    @property
    def is_ready(self) -> bool:
        """Whether there is a start pose."""
        return self._odometry.ready

    def begin(
        self, estimate: PoseEstimate, query: FeaturePyramid, anchors: Anchors, velocity: Array,
        sweep: Sweep | None = None,
    ) -> None:  # fmt: skip
        """Start, or start again, from a frame that the map located, with its features (query), the
        anchors of its reference, and the camera's velocity (3,) m/s, world axes. sweep: the
        camera's motion during the readout; None: global shutter.
        """
        camera = with_field_of_view(self._pinhole, estimate.camera)
        frame = OdometryFrame(query, estimate.exposure_time_ns, sweep=sweep, camera=camera)
        self._odometry.begin(
            frame,
            estimate.world_from_camera,
            estimate.covariance,
            velocity=velocity,
            surface=anchors.points_world,
            constraint=self._constraint(estimate.exposure_time_ns, estimate.world_from_camera),
        )

    def propagate(
        self, frame: Frame, query: FeaturePyramid, prediction: PosePrior, anchors: Anchors | None,
        sweep: Sweep | None = None,
    ) -> PropagatedPose:  # fmt: skip
        """Propagate the pose to a frame with features `query`.

        prediction: of the motion model, for this frame; anchors: of the reference view at the
        prediction, None without one, for example beyond the map's edge; sweep: as `begin`. Result:
        CARRIED with the pose; GAP if this frame is not usable; BROKEN if the odometry has failed or
        its sigma is too large: then the start pose is dropped, and NONE follows until the next
        `begin`.
        """
        if not self._odometry.ready:
            return _NOTHING
        camera = with_field_of_view(self._pinhole, frame.camera)
        seen = OdometryFrame(query, frame.exposure_time_ns, find_fault(frame.image), sweep, camera)
        surface = anchors.points_world if anchors is not None else None
        constraint = self._constraint(frame.exposure_time_ns, prediction.world_from_camera)
        try:
            estimate = self._odometry.step(
                seen,
                prediction,
                surface=surface,
                constraint=constraint,
                clearance_m=self._sensors.clearance_at(frame.exposure_time_ns),
            )
        except OdometryError:  # no depth for a first keyframe: there will be none later
            self._odometry.forget()
            return PropagatedPose(PropagationResult.BROKEN)
        if estimate.status is OdometryStatus.LOST:
            self._odometry.forget()
            return PropagatedPose(PropagationResult.BROKEN)
        if not estimate.usable:
            return PropagatedPose(PropagationResult.GAP)
        P, now_ns = estimate.covariance, frame.exposure_time_ns
        sigma_m, longest_m = float(np.sqrt(P.diagonal()[:3].max())), self._longest_sigma_m
        self._in_view_ns = None if anchors is None else self._in_view_ns or now_ns
        is_tried = self._in_view_ns is not None and now_ns - self._in_view_ns > _TRIED_NS
        if sigma_m > (longest_m if is_tried else self._off_map_sigma_m):
            self._odometry.forget()
            return PropagatedPose(PropagationResult.BROKEN)
        return PropagatedPose(
            PropagationResult.CARRIED, estimate.world_from_camera, P, estimate.quality,
            estimate.scale_sigma,
        )  # fmt: skip

    def _constraint(self, time_ns: int, about: Pose) -> PoseConstraint | None:
        """Constraint by attitude and height at a time; about: the camera's approximate pose."""
        rotation, height_m = self._sensors.rotation_at(time_ns), self._sensors.height_at(time_ns)
        known = []
        if rotation is not None:
            known.append(attitude_constraint(rotation, _TILT_RAD, _HEADING_RAD))
        if height_m is not None:
            world_z = height_m - curvature_drop_m(about.translation)
            known.append(height_constraint(world_z, _HEIGHT_M))
        return combine(*known) if known else None
