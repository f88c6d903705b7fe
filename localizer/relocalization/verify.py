"""Verifies a candidate: renders the map there, registers the frame, and compares with
the sensors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from localizer.features.extractor import FeatureExtractor
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose, so3_log
from localizer.integrity.acceptance import IntegrityConfig
from localizer.integrity.probability import log_odds
from localizer.registration.anchors import select_anchors
from localizer.registration.jngo import JNGO
from localizer.registration.priors import (
    PoseConstraint,
    attitude_constraint,
    height_constraint,
)
from localizer.registration.result import Registration, failure
from localizer.relocalization.align import FrameShift, displacement
from localizer.relocalization.config import RelocalizationConfig
from localizer.relocalization.patch import with_heading
from localizer.relocalization.types import PlaceCandidate, PlaceQuery
from localizer.relocalization.verdict import CREDIBLE
from localizer.render.base import MapRenderer
from localizer.render.holes import fill_holes
from localizer.tracking.sensor_fusion import (
    FusedRegistration,
    fused_registration,
    with_map_error,
)
from localizer.types import FeaturePyramid, PosePrior, RegistrationStatus, RenderedView

_PLACE_SIGMA_M = 5.0  # of a candidate: some cells, and houses that lean
_HEADING_SIGMA_RAD = np.radians(5.0)  # half a step of the headings tried
_LEAST_TILT_SIGMA_RAD = np.radians(0.3)
_LEAST_HEIGHT_SIGMA_M = 0.3
_FARTHEST_M = 60.0  # of an answer from its candidate: a registration that ran so far ran away
_MIN_MAP_SHARE = 0.1  # of the view
_ALIGNMENTS = 1  # after the one at half the size, from nearly the right side of the houses
_MOVED_M = 1.0  # less than a registration minds
_ALIGNED_M = 25.0  # from a candidate: farther is another one's
_AROUND, _AROUND_HEIGHTS_M = 0.1, (30.0, 100.0)  # of the height above ground, which is cut
_SIDES = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))


@dataclass(frozen=True)
class RenderedReference:
    """The map rendered at a pose, with its features."""

    view: RenderedView
    features: FeaturePyramid

    @property
    def ground_m(self) -> float:
        """Median world z of the surface in view."""
        v, u = np.nonzero(self.view.depth)
        some = slice(None, None, max(1, len(u) // 500))
        pixels = np.stack([u[some], v[some]], axis=-1) + 0.5
        points = self.view.camera.rays(pixels) * self.view.depth[v[some], u[some], None]
        return float(np.median(self.view.world_from_camera.apply(points)[:, 2]))


@dataclass(frozen=True)
class Aligned:
    """A candidate's prior after alignment. score: of the shift; 0 with hardly any map in view."""

    prior: PosePrior
    score: float


@dataclass(frozen=True)
class QueryFeatures:
    """The query's frame at one size. camera: its pinhole; features: of the frame."""

    camera: Camera
    features: FeaturePyramid
    shift: FrameShift


@dataclass(frozen=True)
class Verifier:
    """Renders the map at a candidate and registers the frame to it.

    extractor: with the detail level, as the tracker's; coarse: without. height_sigma_m: RMS of the
    object heights that the map lacks.
    """

    renderer: MapRenderer
    extractor: FeatureExtractor
    coarse: FeatureExtractor
    optimizer: JNGO
    config: RelocalizationConfig
    integrity: IntegrityConfig
    height_sigma_m: float
    anchors: int
    seed: int

    def prior(self, candidate: PlaceCandidate, query: PlaceQuery) -> PosePrior:
        """The candidate's pose world_from_camera as a prior of the query's frame. Its covariance is
        that of the search in position and heading, and that of the query in tilt and height.
        """
        tilt = max(query.tilt_sigma_rad, _LEAST_TILT_SIGMA_RAD)
        rise = max(query.height_sigma_m, 1.0)
        sigma = np.array(
            [_PLACE_SIGMA_M, _PLACE_SIGMA_M, rise, tilt, tilt, _HEADING_SIGMA_RAD], np.float64
        )
        time_ns = query.frame.exposure_time_ns
        return PosePrior(candidate.world_from_camera, np.diag(sigma**2), time_ns)

    def reference(
        self, prior: PosePrior, camera: Camera, extractor: FeatureExtractor | None = None
    ) -> RenderedReference | None:
        """Render the map at the prior's pose, waiting for its tiles; None if it fills under 10 % of
        the view. extractor: of its features; None: the one with the detail level.
        """
        view = self.renderer.render(prior.world_from_camera, camera, wait=True)
        if np.count_nonzero(view.depth) < _MIN_MAP_SHARE * view.depth.size:
            return None
        return RenderedReference(view, (extractor or self.extractor).extract(fill_holes(view)))

    def screen(self, small: QueryFeatures, prior: PosePrior) -> Aligned:
        """The prior, displaced by the shift between the small frame and its rendering."""
        reference = self.reference(prior, small.camera, self.coarse)
        if reference is None:
            return Aligned(prior, 0.0)
        shift = small.shift.estimate(reference.features.levels)
        away = displacement(prior.world_from_camera, small.camera, shift, reference.ground_m)
        near = float(np.linalg.norm(away)) <= _ALIGNED_M
        return Aligned(displaced(prior, away) if near else prior, shift.score)

    def register_aligned(
        self, full: QueryFeatures, screened: Aligned, query: PlaceQuery
    ) -> tuple[PosePrior, FusedRegistration]:
        """Align a `screen` result again at full size, and register the frame there."""
        prior = screened.prior
        reference = self.reference(prior, full.camera)
        for _ in range(_ALIGNMENTS):
            if reference is None:
                break
            shift = full.shift.estimate(reference.features.levels)
            away = displacement(prior.world_from_camera, full.camera, shift, reference.ground_m)
            if not _MOVED_M <= np.linalg.norm(away) <= _ALIGNED_M:
                break
            prior = displaced(prior, away)
            reference = self.reference(prior, full.camera)
        return prior, self.register(full, prior, query, reference)

    def register_around(
        self, full: QueryFeatures, prior: PosePrior, query: PlaceQuery
    ) -> FusedRegistration:
        """The best of several registrations whose start is displaced to each side."""
        reference = self.reference(prior, full.camera)
        if reference is None:
            return FusedRegistration(failure(prior, RegistrationStatus.NO_OVERLAP))
        above = prior.world_from_camera.translation[2] - reference.ground_m
        reach = _AROUND * float(np.clip(above, *_AROUND_HEIGHTS_M))
        starts = [displaced(prior, reach * np.array(side)) for side in _SIDES]
        found = [self.register(full, start, query, reference) for start in starts]
        return max(found, key=lambda each: log_odds(each.registration))

    def register(
        self,
        full: QueryFeatures,
        prior: PosePrior,
        query: PlaceQuery,
        reference: RenderedReference | None = None,
    ) -> FusedRegistration:
        """One pass: register the frame to the view at the prior's pose (None: render it) and fuse
        attitude and height. A good result is also tested with other focal lengths.
        """
        reference = reference or self.reference(prior, full.camera)
        if reference is None:
            return FusedRegistration(failure(prior, RegistrationStatus.NO_OVERLAP))
        anchors = select_anchors(reference.view, reference.features, self.anchors, self.seed)
        image = self.optimizer.register(full.features, full.camera, anchors, prior, seed=self.seed)
        if log_odds(image) >= self.integrity.min_log_odds:
            image = self.optimizer.with_focal_gain(full.features, full.camera, anchors, image)
        known = _constraints(image.world_from_camera, query)
        return fused_registration(with_map_error(image, self.height_sigma_m), known)

    def next_prior(self, prior: PosePrior, result: Registration) -> PosePrior:
        """Prior of the next pass. Sigma only halves, because the same image is no new evidence."""
        return PosePrior(result.world_from_camera, prior.covariance / 4, prior.time_ns)

    def is_credible(
        self, found: FusedRegistration, candidate: PlaceCandidate, query: PlaceQuery
    ) -> bool:
        """Whether the image supports the position, it is near the candidate, and attitude, height
        and heading agree.
        """
        result = found.registration
        if found.contradicted or result.overlap < self.config.min_overlap:
            return False
        if result.focal_gain > self.integrity.max_focal_gain:
            return False
        away = result.world_from_camera.translation - candidate.world_from_camera.translation
        if float(np.linalg.norm(away[:2])) > _FARTHEST_M:
            return False
        if query.heading_sigma_rad is not None:
            _, heading = attitude_difference(result.world_from_camera.rotation, query.rotation)
            reach = self.config.heading_reach * query.heading_sigma_rad
            if abs(heading) > reach + 3 * _HEADING_SIGMA_RAD:
                return False
        return log_odds(result) >= self.integrity.min_log_odds + CREDIBLE


def _constraints(pose: Pose, query: PlaceQuery) -> tuple[PoseConstraint, PoseConstraint]:
    """Constraints by the query: roll and pitch, at the pose's heading, and the height."""
    _, heading = attitude_difference(pose.rotation, query.rotation)
    tilt = max(query.tilt_sigma_rad, _LEAST_TILT_SIGMA_RAD)
    return (
        attitude_constraint(with_heading(query.rotation, heading), tilt, np.pi),
        height_constraint(query.height_m, max(query.height_sigma_m, _LEAST_HEIGHT_SIGMA_M)),
    )


def displaced(prior: PosePrior, away: Array) -> PosePrior:
    """A prior displaced by `away` (2,), m to the east and north."""
    pose = prior.world_from_camera
    place = pose.translation + np.array([*away, 0.0])
    return replace(prior, world_from_camera=Pose(pose.rotation, place))


def attitude_difference(rotation: Array, reference: Array) -> tuple[float, float]:
    """(tilt, heading): tilt (rad, >= 0) and rotation about the vertical (rad, counter-clockwise) of
    a rotation (3, 3) world_from_camera relative to a reference.
    """
    relative = rotation @ reference.T
    # Twist of the swing-twist decomposition: what of the turn is about the vertical.
    heading = float(np.arctan2(relative[1, 0] - relative[0, 1], relative[0, 0] + relative[1, 1]))
    c, s = np.cos(heading), np.sin(heading)
    upright = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ relative
    return float(np.linalg.norm(so3_log(upright))), heading
