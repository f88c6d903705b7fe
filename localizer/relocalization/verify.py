"""Whether a candidate is the place: rendered there, registered, and held against the sensors."""

from __future__ import annotations

from dataclasses import dataclass, replace

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
from localizer.relocalization.align import FrameShift, moved
from localizer.relocalization.config import RelocalizationConfig
from localizer.relocalization.types import PlaceCandidate, PlaceQuery
from localizer.render.base import MapRenderer
from localizer.render.holes import fill_holes
from localizer.types import FeaturePyramid, PosePrior, RegistrationStatus, RenderedView

_PLACE_SIGMA_M = 5.0  # of a candidate: some cells, and houses that lean
_HEADING_SIGMA_RAD = np.radians(5.0)  # half a step of the headings tried
_LEAST_TILT_SIGMA_RAD = np.radians(0.3)
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
        """World z of what is seen, the median over the image."""
        v, u = np.nonzero(self.view.depth)
        some = slice(None, None, max(1, len(u) // 500))
        pixels = np.stack([u[some], v[some]], axis=-1) + 0.5
        points = self.view.camera.rays(pixels) * self.view.depth[v[some], u[some], None]
        return float(np.median(self.view.world_from_camera.apply(points)[:, 2]))


@dataclass(frozen=True)
class Aligned:
    """A candidate's prior after alignment. score: of `Shift`, 0 where there is hardly any map."""

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

    extractor: with the detail level, as the tracker's; coarse: without.
    """

    renderer: MapRenderer
    extractor: FeatureExtractor
    coarse: FeatureExtractor
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

    def reference(
        self, prior: PosePrior, camera: Camera, extractor: FeatureExtractor | None = None
    ) -> RenderedReference | None:
        """The map as the prior's pose sees it; None where that is hardly any."""
        view = self.renderer.render(prior.world_from_camera, camera, wait=True)
        if np.count_nonzero(view.depth) < _MIN_MAP_SHARE * view.depth.size:
            return None
        return RenderedReference(view, (extractor or self.extractor).extract(fill_holes(view)))

    def screened(self, small: QueryFeatures, prior: PosePrior) -> Aligned:
        """The prior moved to where the frame, at a small size, lies over its rendering."""
        reference = self.reference(prior, small.camera, self.coarse)
        if reference is None:
            return Aligned(prior, 0.0)
        shift = small.shift.over(reference.features.levels)
        away = moved(prior.world_from_camera, small.camera, shift, reference.ground_m)
        near = float(np.linalg.norm(away)) <= _ALIGNED_M
        return Aligned(shifted(prior, away) if near else prior, shift.score)

    def from_place(
        self, sight: QueryFeatures, place: Aligned, query: PlaceQuery
    ) -> tuple[PosePrior, Registration]:
        """A screened place aligned once more, at full size, and registered from there."""
        prior = place.prior
        reference = self.reference(prior, sight.camera)
        for _ in range(_ALIGNMENTS):
            if reference is None:
                break
            shift = sight.shift.over(reference.features.levels)
            away = moved(prior.world_from_camera, sight.camera, shift, reference.ground_m)
            if not _MOVED_M <= np.linalg.norm(away) <= _ALIGNED_M:
                break
            prior = shifted(prior, away)
            reference = self.reference(prior, sight.camera)
        return prior, self.register(sight, prior, query, reference)

    def around(self, sight: QueryFeatures, prior: PosePrior, query: PlaceQuery) -> Registration:
        """The best of registrations that begin to all sides of an aligned place."""
        reference = self.reference(prior, sight.camera)
        if reference is None:
            return failure(prior, RegistrationStatus.NO_OVERLAP)
        above = prior.world_from_camera.translation[2] - reference.ground_m
        reach = _AROUND * float(np.clip(above, *_AROUND_HEIGHTS_M))
        starts = [shifted(prior, reach * np.array(side)) for side in _SIDES]
        found = [self.register(sight, start, query, reference) for start in starts]
        return max(found, key=lambda result: result.quality)

    def register(
        self,
        sight: QueryFeatures,
        prior: PosePrior,
        query: PlaceQuery,
        reference: RenderedReference | None = None,
    ) -> Registration:
        """One pass: the frame registered to the view at the prior's pose, rendered if not given;
        another focal length is tried where the result is good.
        """
        reference = reference or self.reference(prior, sight.camera)
        if reference is None:
            return failure(prior, RegistrationStatus.NO_OVERLAP)
        anchors = select_anchors(reference.view, reference.features, self.anchors, self.seed)
        constraint = self._constraint(prior.world_from_camera, query)
        found = self.optimizer.register(
            sight.features, sight.camera, anchors, prior, constraint=constraint, seed=self.seed
        )
        if not self.is_good(found):
            return found
        return self.optimizer.focal_tested(sight.features, sight.camera, anchors, found)

    def again(self, prior: PosePrior, result: Registration) -> PosePrior:
        """The prior of the next pass: the same image is no new evidence, sigma only halves."""
        return PosePrior(result.world_from_camera, prior.covariance / 4, prior.time_ns)

    def is_credible(
        self, result: Registration, candidate: PlaceCandidate, query: PlaceQuery
    ) -> bool:
        """Whether a registration is good in itself and agrees with the other sensors."""
        if not self.is_good(result) or result.focal_gain > self.config.max_focal_gain:
            return False
        return self.agrees(result.world_from_camera, candidate, query)

    def is_good(self, result: Registration) -> bool:
        """Whether a registration is good in itself, as far as one focal length tells."""
        c = self.config
        if result.status is not RegistrationStatus.OK:
            return False
        if result.overlap < c.min_overlap or result.quality < c.min_quality:
            return False
        if result.covariance.diagonal()[:3].max() > c.max_sigma_m**2:
            return False
        votes = result.agreement  # None on a GPU: the other tests decide
        return votes is None or votes.share >= c.min_patch_inlier_ratio

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


def shifted(prior: PosePrior, away: Array) -> PosePrior:
    """A prior so far (2,) m to the east and north."""
    pose = prior.world_from_camera
    place = pose.translation + np.array([*away, 0.0])
    return replace(prior, world_from_camera=Pose(pose.rotation, place))


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
