"""Track of one target: static or moving; seen, held by geometry or hidden.

`TargetFilter` estimates position and motion; a velocity is reported only if the target more
probably moves. What is implausible (`limits`) is refused.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from localizer.geometry.pose import Array
from localizer.targets.filter import TargetFilter
from localizer.targets.limits import (
    LastPosition,
    RefusalReason,
    SharedBias,
    TargetRefusal,
    is_at_seen_depth,
    is_near_map_hole,
    is_on_map,
)
from localizer.targets.locate import (
    RayCaster,
    RaySpread,
    locate,
    ray_in_world,
    ray_spread,
    surface_covariance,
)
from localizer.types import PoseEstimate, TargetFix, TargetSurface, Visibility

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
        self._filter = TargetFilter()
        self._last = LastPosition(round(settings.confirm_s * 1e9))
        self._aim: Array = np.zeros((3, 3))
        self.refusal: TargetRefusal | None = None

    @property
    def moves(self) -> bool:
        """Whether the target more probably moves than stands."""
        return self._filter.moves

    @property
    def velocity(self) -> Array | None:
        """(3,) m/s, world axes, of a moving target; None otherwise."""
        return self._filter.velocity

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
        if self._filter.update(eye, d, surfaces, time_ns):
            fix = self._fix(estimate, pixel)
            spread = ray_spread(estimate, pixel, sigma, distance, drift)
            why = self._objection(fix, eye, d, spread, surfaces)
        else:
            why = TargetRefusal(RefusalReason.ELSEWHERE)
        if why and self._last.fix is None and why.reason is not RefusalReason.UNCONFIRMED:
            # Nothing was reported yet: earlier observations have no precedence over this one.
            self._begin_anew()
            self._filter.update(eye, d, surfaces, time_ns)
        return self._refuse(why) if why else fix

    def _begin_anew(self) -> None:
        self._filter = TargetFilter()
        self._last = LastPosition(round(self._settings.confirm_s * 1e9))

    def expected(self, time_ns: int) -> tuple[Array, Array] | None:
        """Predicted position (3,) and covariance (3, 3), common errors not in it; None if
        unknown.
        """
        if self._last.fix is None:
            return None
        return self._filter.expected(time_ns)

    def coast(self, estimate: PoseEstimate) -> TargetFix | None:
        """Predicted position of an unseen moving target, HIDDEN; None for a static one, outside the
        image or map, or beyond `max_sigma_m`.
        """
        expected = self.expected(estimate.exposure_time_ns) if self.moves else None
        if expected is None:
            return None
        position, P = expected
        if float(np.sqrt(np.trace(P))) > self._settings.max_sigma_m:
            return None
        bias = self._settings.bias.covariance(position - estimate.world_from_camera.translation)
        pixel = pixel_of(estimate, position)
        fix = TargetFix(
            self._id, position, P + bias + self._aim, pixel,
            estimate.exposure_time_ns, 0.0, self._filter.velocity,
            self._filter.velocity_covariance, Visibility.HIDDEN,
        )  # fmt: skip
        return fix if pixel is not None and is_on_map(fix, self._cast) else None

    def hold(self, estimate: PoseEstimate) -> TargetFix | None:
        """A static target's position in a frame without an observation: HELD where the pose
        projects it, HIDDEN by the map, or OUTSIDE. None for a moving one and before the first
        report.
        """
        if self.moves or self._last.fix is None:
            return None
        fix = self._fix(estimate, None)
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
        velocity = self._filter.velocity
        ahead = position if velocity is None else position + _ENTERS_S * velocity
        return self.is_hidden(estimate, position) or self.is_hidden(estimate, ahead)

    def is_hidden(self, estimate: PoseEstimate, point: Array, beyond_m: float = 0.0) -> bool:
        """Whether the map hides a point (3,), by more than `beyond_m` and 1.5 m."""
        eye = estimate.world_from_camera.translation
        distance = float(np.linalg.norm(point - eye))
        first = float(self._cast(eye, (point - eye)[None] / distance).distances[0])
        return distance - first > max(_HIDDEN_M, beyond_m)

    def _fix(self, estimate: PoseEstimate, pixel: tuple[float, float] | None) -> TargetFix:
        """The filter's position; the errors common to all targets are in its covariance."""
        away = self._filter.position - estimate.world_from_camera.translation
        position, covariance, elsewhere = self._filter.place(self._settings.bias.covariance(away))
        covariance += self._aim if self.moves else 0.0
        return TargetFix(
            self._id, position, covariance, pixel, estimate.exposure_time_ns, elsewhere,
            self._filter.velocity, self._filter.velocity_covariance,
        )  # fmt: skip

    def _objection(
        self, fix: TargetFix, eye: Array, direction: Array, spread: RaySpread,
        surfaces: tuple[TargetSurface, ...],
    ) -> TargetRefusal | None:  # fmt: skip
        """Why this position may not be reported; None if it may.

        A position may be reported if it lies under the observed pixel, at a depth that its frame
        shows, on the map, is known to some metres, and is no farther from the last one than both
        errors and a vehicle's speed allow.
        """
        P, sigma = fix.covariance, float(np.sqrt(np.trace(fix.covariance)))
        if not np.isfinite(sigma) or sigma > self._settings.max_sigma_m:
            return TargetRefusal(RefusalReason.UNCERTAIN, sigma)
        away = fix.position_world - eye
        distance = float(np.linalg.norm(away))
        S = spread.sideways
        r = S @ (away / distance - direction)
        C = spread.covariance + S @ P @ S.T / distance**2
        if float(r @ np.linalg.solve(C, r)) > _REPROJECTED**2:
            return TargetRefusal(RefusalReason.NOT_UNDER_PIXEL)
        if not is_on_map(fix, self._cast):
            return TargetRefusal(RefusalReason.OFF_MAP)
        if not is_at_seen_depth(fix, eye, direction, surfaces):
            return TargetRefusal(RefusalReason.OTHER_DEPTH)
        return self._last.check(fix, moves=self.moves)

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
