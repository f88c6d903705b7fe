"""Whether a candidate is the place: rendered there, registered, and held against the sensors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from localizer.features.extractor import FeatureExtractor
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose, so3_log
from localizer.registration.anchors import select_anchors
from localizer.registration.jngo import JNGO
from localizer.registration.priors import (
    PoseConstraint,
    attitude_constraint,
    combine,
    height_constraint,
)
from localizer.registration.result import Registration, failure
from localizer.relocalization.config import RelocalizationConfig
from localizer.relocalization.types import PlaceCandidate, PlaceQuery
from localizer.render.base import MapRenderer
from localizer.render.holes import fill_holes
from localizer.types import FeaturePyramid, PosePrior, RegistrationStatus

_PLACE_SIGMA_M = 5.0  # of a candidate: some cells, and houses that lean
_HEADING_SIGMA_RAD = np.radians(5.0)  # half a step of the headings tried
_LEAST_TILT_SIGMA_RAD = np.radians(0.3)
_FARTHEST_M = 60.0  # of an answer from its candidate: a registration that ran so far ran away
_MIN_MAP_SHARE = 0.1  # of the view


@dataclass(frozen=True)
class Verifier:
    """Renders the map at a candidate and registers the frame to it.

    extractor: with the detail level, as the tracker's; camera: the pinhole of the query's features.
    """

    renderer: MapRenderer
    extractor: FeatureExtractor
    optimizer: JNGO
    config: RelocalizationConfig
    anchors: int
    seed: int

    def prior(self, candidate: PlaceCandidate, query: PlaceQuery) -> PosePrior:
        """The candidate with its covariance."""
        tilt = max(query.tilt_sigma_rad, _LEAST_TILT_SIGMA_RAD)
        rise = max(query.height_sigma_m, 1.0)
        sigma = np.array(
            [_PLACE_SIGMA_M, _PLACE_SIGMA_M, rise, tilt, tilt, _HEADING_SIGMA_RAD], np.float64
        )
        time_ns = query.frame.exposure_time_ns
        return PosePrior(candidate.world_from_camera, np.diag(sigma**2), time_ns)

    def register(
        self, features: FeaturePyramid, camera: Camera, prior: PosePrior, query: PlaceQuery
    ) -> Registration:
        """One pass: the view at the prior's pose, and the frame registered to it."""
        view = self.renderer.render(prior.world_from_camera, camera, wait=True)
        if np.count_nonzero(view.depth) < _MIN_MAP_SHARE * view.depth.size:
            return failure(prior, RegistrationStatus.NO_OVERLAP)
        reference = self.extractor.extract(fill_holes(view))
        anchors = select_anchors(view, reference, self.anchors, self.seed)
        constraint = self._constraint(prior.world_from_camera, query)
        return self.optimizer.register(
            features, camera, anchors, prior, constraint=constraint, seed=self.seed
        )

    def again(self, prior: PosePrior, result: Registration) -> PosePrior:
        """The prior of the next pass: the same image is no new evidence, sigma only halves."""
        return PosePrior(result.world_from_camera, prior.covariance / 4, prior.time_ns)

    def is_credible(
        self, result: Registration, candidate: PlaceCandidate, query: PlaceQuery
    ) -> bool:
        """Whether a registration is good in itself and agrees with the other sensors."""
        c = self.config
        if result.status is not RegistrationStatus.OK:
            return False
        if result.overlap < c.min_overlap or result.quality < c.min_quality:
            return False
        if result.covariance.diagonal()[:3].max() > c.max_sigma_m**2:
            return False
        votes = result.agreement  # None on a GPU: the other tests decide
        if votes is not None and votes.share < c.min_agreement:
            return False
        return self.agrees(result.world_from_camera, candidate, query)

    def agrees(self, pose: Pose, candidate: PlaceCandidate, query: PlaceQuery) -> bool:
        """Whether a pose is where the candidate was, as high and as level as the sensors say."""
        c = self.config
        place = candidate.world_from_camera
        moved = float(np.linalg.norm((pose.translation - place.translation)[:2]))
        rise = abs(float(pose.translation[2]) - query.height_m)
        tilt, heading = tilt_and_heading(pose.rotation, query.rotation)
        if query.heading_sigma_rad is not None:
            limit = c.heading_reach * query.heading_sigma_rad + 3 * _HEADING_SIGMA_RAD
            if abs(heading) > limit:
                return False
        return (
            moved <= _FARTHEST_M
            and rise <= 3 * query.height_sigma_m + c.height_gate_m
            and tilt <= 3 * query.tilt_sigma_rad + np.radians(c.tilt_gate_deg)
        )

    def _constraint(self, pose: Pose, query: PlaceQuery) -> PoseConstraint:
        """Roll and pitch as the autopilot has them, at the candidate's heading; and the height."""
        _, heading = tilt_and_heading(pose.rotation, query.rotation)
        c, s = np.cos(heading), np.sin(heading)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        tilt = max(query.tilt_sigma_rad, _LEAST_TILT_SIGMA_RAD)
        return combine(
            attitude_constraint(turn @ query.rotation, tilt, np.pi),
            height_constraint(query.height_m, max(query.height_sigma_m, 0.3)),
        )


def tilt_and_heading(rotation: Array, reference: Array) -> tuple[float, float]:
    """How far a rotation (3, 3) world_from_camera is tilted (rad, >= 0) against a reference's, and
    turned about the vertical (rad, counter-clockwise).
    """
    relative = rotation @ reference.T
    # Twist of the swing-twist decomposition: what of the turn is about the vertical.
    heading = float(np.arctan2(relative[1, 0] - relative[0, 1], relative[0, 0] + relative[1, 1]))
    c, s = np.cos(heading), np.sin(heading)
    upright = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ relative
    return float(np.linalg.norm(so3_log(upright))), heading
