"""Track of one target: static or moving; seen, held by geometry or hidden.

An observation updates both a static (`StaticTarget`) and a moving hypothesis (`TargetFilter`). The
target is static until its rays contradict that, and again after it has stood for a while. A
velocity is reported only if motion was measured.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from localizer.geometry.pose import Array
from localizer.targets.filter import TargetFilter
from localizer.targets.limits import (
    LastPosition,
    RefusalReason,
    TargetRefusal,
    is_at_seen_depth,
    is_near_map_hole,
    is_on_map,
)
from localizer.targets.locate import (
    RayCaster,
    locate,
    ray_in_world,
    ray_spread,
    surface_covariance,
)
from localizer.targets.static import ObservedRay, StaticTarget
from localizer.types import PoseEstimate, TargetFix, TargetSighting, TargetSurface, Visibility


@dataclass(frozen=True)
class SharedBias:
    """Sigmas of the common error: metres along each axis, and radians as seen from the camera."""

    sigma_m: float = 0.2
    sigma_rad: float = 0.0005

    def covariance(self, offset: Array) -> Array:
        """(3, 3) m², world axes, of a target at `offset` (3,) from the camera."""
        distance = float(np.linalg.norm(offset))
        d = offset / max(distance, 1e-6)
        across = np.eye(3) - np.outer(d, d)
        shared: Array = self.sigma_m**2 * np.eye(3) + (self.sigma_rad * distance) ** 2 * across
        return shared


_STANDS_S = 2.0  # for so long it must agree with standing before it stands again
_STANDS_MPS = 1.0
_GAP_S = 5.0  # a moving target unseen for so long may be anywhere: it begins anew
_ELSEWHERE = 9.0
_OUTLIERS = 3
_REPROJECTED = 5.0  # sigmas of pixel and pose between a fix and the pixel that it was seen at
_ENTERS_S = 0.5
_HIDDEN_M = 1.5  # what stands before a place by more than this hides it


@dataclass(frozen=True)
class TargetSettings:
    """Settings of a target's track. pixel_sigma: of an observation, px; map_sigma_m: of the map's
    surface; bias: errors common to all targets; max_sigma_m, max_range_m: limits of reported
    positions; outline_sigma_m: of the map's outlines, across the ray; confirm_s: time over which
    observations must agree before the first report, 0 for single ones.
    """

    pixel_sigma: float = 1.5
    map_sigma_m: float = 0.3
    bias: SharedBias = field(default_factory=SharedBias)
    max_sigma_m: float = 50.0
    max_range_m: float = 5000.0
    outline_sigma_m: float = 0.5
    confirm_s: float = 0.5


class TargetTrack:
    """Track of one target; not thread-safe. refusal: why the last `observe` gave no position."""

    def __init__(self, target_id: str, settings: TargetSettings, cast: RayCaster) -> None:
        self._id, self._settings, self._cast = target_id, settings, cast
        self._static = StaticTarget(settings.map_sigma_m)
        self._moving = TargetFilter()
        self._moves = False
        self._stands_since_ns = 0
        self._outliers = 0
        self._last = LastPosition(round(settings.confirm_s * 1e9))
        self._seen_ns = 0
        self._aim: Array = np.zeros((3, 3))
        self.refusal: TargetRefusal | None = None

    @property
    def moves(self) -> bool:
        """Whether motion was measured and it has not stood since for 2 s."""
        return self._moves

    @property
    def velocity(self) -> Array | None:
        """(3,) m/s, world axes, of a moving target; None otherwise."""
        return self._moving.velocity if self._moves else None

    def observe(
        self,
        estimate: PoseEstimate,
        pixel: tuple[float, float],
        *,
        drift: tuple[float, float] = (0.0, 0.0),
        pixel_sigma: float | None = None,
    ) -> TargetFix | None:
        """Add the target's pixel in the next accepted frame; its position, or None with `refusal`
        set. drift: see `ray_spread`; pixel_sigma: px, None: of the settings.
        """
        settings, sigma = self._settings, pixel_sigma or self._settings.pixel_sigma
        time_ns, self.refusal = estimate.exposure_time_ns, None
        eye, d = ray_in_world(estimate, pixel)
        surfaces = locate(
            estimate, pixel, self._cast, sigma, settings.map_sigma_m, drift,
            settings.outline_sigma_m,
        )  # fmt: skip
        if not surfaces:
            return self._refuse(TargetRefusal(RefusalReason.NO_MAP))
        distance = float(np.linalg.norm(surfaces[0].position - eye))
        if distance > settings.max_range_m:
            return self._refuse(TargetRefusal(RefusalReason.TOO_FAR, distance))
        if self._last.fix is None and is_near_map_hole(eye, d, distance, self._cast):
            self._begin_anew()
            return self._refuse(TargetRefusal(RefusalReason.HOLE))
        if any(drift):
            self._aim = _aim(estimate, pixel, sigma, drift, surfaces[0])
        if self._moves and time_ns - self._seen_ns > _GAP_S * 1e9:
            self._moving = TargetFilter()
        ray = ObservedRay(eye, d, ray_spread(estimate, pixel, sigma, distance, drift))
        moving = self._moving.update(TargetSighting(self._id, surfaces, pixel, time_ns))
        fits = self._static.update(ray, surfaces)
        self._outliers = 0 if fits else self._outliers + 1
        if (fits and self._static.moves) or self._outliers >= _OUTLIERS:
            self._moves = True
            self._stands_since_ns = time_ns
            self._outliers = 0
            self._static = StaticTarget(settings.map_sigma_m)
            fits = self._static.update(ray, surfaces)
        elif self._moves and time_ns - self._stands_since_ns > _STANDS_S * 1e9:
            velocity = self._moving.velocity
            self._moves = velocity is None or float(np.hypot(*velocity[:2])) > _STANDS_MPS
        fix = moving if self._moves else self._standing(estimate, pixel) if fits else None
        if fix is None:
            return self._refuse(TargetRefusal(RefusalReason.ELSEWHERE))
        if self._moves:
            bias = settings.bias.covariance(fix.position_world - eye)
            fix = replace(fix, covariance=fix.covariance + bias + self._aim)
        why = self._objection(fix, ray, surfaces)
        if why and self._last.fix is None and why.reason is not RefusalReason.UNCONFIRMED:
            # Nothing was told yet, so nothing speaks for what was seen before rather than for this.
            self._begin_anew()
            self._static.update(ray, surfaces)
            self._moving.update(TargetSighting(self._id, surfaces, pixel, time_ns))
        if why:
            return self._refuse(why)
        self._seen_ns = time_ns
        return fix

    def _begin_anew(self) -> None:
        self._static = StaticTarget(self._settings.map_sigma_m)
        self._moving = TargetFilter()
        self._moves = False
        self._outliers = 0
        self._last = LastPosition(round(self._settings.confirm_s * 1e9))

    def expected(self, time_ns: int) -> tuple[Array, Array] | None:
        """Predicted position (3,) and covariance (3, 3), common errors not in it; None if
        unknown.
        """
        if self._last.fix is None:
            return None
        if self._moves:
            return self._moving.expected(time_ns)
        best = self._static.hypotheses()[0]
        return best.position, best.covariance

    def coast(self, estimate: PoseEstimate) -> TargetFix | None:
        """Predicted position of an unseen moving target, HIDDEN; None for a static one, outside the
        image or map, or beyond `max_sigma_m`.
        """
        expected = self.expected(estimate.exposure_time_ns) if self._moves else None
        if expected is None:
            return None
        position, P = expected
        if float(np.sqrt(np.trace(P))) > self._settings.max_sigma_m:
            return None
        bias = self._settings.bias.covariance(position - estimate.world_from_camera.translation)
        pixel = pixel_of(estimate, position)
        fix = TargetFix(
            self._id, position, P + bias + self._aim, pixel,
            estimate.exposure_time_ns, 0.0, self._moving.velocity,
            self._moving.velocity_covariance, Visibility.HIDDEN,
        )  # fmt: skip
        return fix if pixel is not None and is_on_map(fix, self._cast) else None

    def hold(self, estimate: PoseEstimate) -> TargetFix | None:
        """A static target's position in a frame without an observation: HELD where the pose
        projects it, HIDDEN by the map, or OUTSIDE. None for a moving one and before the first
        report.
        """
        if self._moves or self._last.fix is None:
            return None
        fix = self._standing(estimate, None)
        away = fix.position_world - estimate.world_from_camera.translation
        pixel = pixel_of(estimate, fix.position_world)
        if pixel is None:
            return replace(fix, visibility=Visibility.OUTSIDE)
        sigma = float(np.sqrt(away @ fix.covariance @ away)) / float(np.linalg.norm(away))
        is_hidden = self.is_hidden(estimate, fix.position_world, 3.0 * sigma)
        seen = Visibility.HIDDEN if is_hidden else Visibility.HELD
        return replace(fix, pixel=pixel, visibility=seen)

    def is_being_hidden(self, estimate: PoseEstimate, position: Array) -> bool:
        """Whether the map hides a moving target at `position` (3,), world, now or within half a
        second. A target that is half hidden is seen at its visible side, so its observations are
        biased.
        """
        velocity = self._moving.velocity
        ahead = position if velocity is None else position + _ENTERS_S * velocity
        return self.is_hidden(estimate, position) or self.is_hidden(estimate, ahead)

    def is_hidden(self, estimate: PoseEstimate, point: Array, beyond_m: float = 0.0) -> bool:
        """Whether the map hides a point (3,), by more than `beyond_m` and 1.5 m."""
        eye = estimate.world_from_camera.translation
        distance = float(np.linalg.norm(point - eye))
        first = float(self._cast(eye, (point - eye)[None] / distance).distances[0])
        return distance - first > max(_HIDDEN_M, beyond_m)

    def _standing(self, estimate: PoseEstimate, pixel: tuple[float, float] | None) -> TargetFix:
        """The position with the smallest expected error; other hypotheses widen its covariance."""
        places = self._static.hypotheses()
        best = places[0]
        eye = estimate.world_from_camera.translation
        bias = self._settings.bias.covariance(best.position - eye)
        covariance, elsewhere = bias.copy(), 0.0
        for place in places:
            offset = place.position - best.position
            spread = self._static.residual_ratio * place.covariance
            covariance += place.weight * (spread + np.outer(offset, offset))
            if offset @ np.linalg.solve(best.covariance + bias, offset) > _ELSEWHERE:
                elsewhere += place.weight
        return TargetFix(
            self._id, best.position, covariance, pixel, estimate.exposure_time_ns, elsewhere
        )

    def _objection(
        self, fix: TargetFix, ray: ObservedRay, surfaces: tuple[TargetSurface, ...]
    ) -> TargetRefusal | None:
        """Why this position may not be reported; None if it may.

        A position may be reported if it lies under the observed pixel, at a depth that its frame
        shows, on the map, is known to some metres, and is no farther from the last one than both
        errors and a vehicle's speed allow.
        """
        P, sigma = fix.covariance, float(np.sqrt(np.trace(fix.covariance)))
        if not np.isfinite(sigma) or sigma > self._settings.max_sigma_m:
            return TargetRefusal(RefusalReason.UNCERTAIN, sigma)
        away = fix.position_world - ray.eye
        distance = float(np.linalg.norm(away))
        S = ray.spread.sideways
        r = S @ (away / distance - ray.direction)
        C = ray.spread.covariance + S @ P @ S.T / distance**2
        if float(r @ np.linalg.solve(C, r)) > _REPROJECTED**2:
            return TargetRefusal(RefusalReason.NOT_UNDER_PIXEL)
        if not is_on_map(fix, self._cast):
            return TargetRefusal(RefusalReason.OFF_MAP)
        if not is_at_seen_depth(fix, ray.eye, ray.direction, surfaces):
            return TargetRefusal(RefusalReason.OTHER_DEPTH)
        return self._last.check(fix, moves=self._moves)

    def _refuse(self, why: TargetRefusal) -> TargetFix | None:
        self.refusal = why
        return None


def _aim(
    estimate: PoseEstimate,
    pixel: tuple[float, float],
    pixel_sigma: float,
    drift: tuple[float, float],
    surface: TargetSurface,
) -> Array:
    """(3, 3) m²: uncertainty of the clicked position itself, from the errors of hand, delay and
    pose in the clicked frame. Tracking this position in later frames does not reduce it.
    """
    offset = surface.position - estimate.world_from_camera.translation
    spread = ray_spread(estimate, pixel, pixel_sigma, float(np.linalg.norm(offset)), drift)
    normal = surface.normal if surface.normal is not None else np.array([0.0, 0.0, 1.0])
    return surface_covariance(offset, normal, spread, 0.0)


def pixel_of(estimate: PoseEstimate, point: Array) -> tuple[float, float] | None:
    """Pixel of a world point (3,) in a frame; None outside the image.

    A lens model may project a point far outside the view into the image. So the pixel counts only
    if its ray leads back to the point.
    """
    at = estimate.world_from_camera.inverse.apply(point)
    pixel, inside = estimate.camera.project(at)
    if not bool(inside):
        return None
    ray = estimate.camera.rays(pixel)
    if float(np.abs(ray[:2] - at[:2] / at[2]).max()) > 0.01:
        return None
    return float(pixel[0]), float(pixel[1])
