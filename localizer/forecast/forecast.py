"""Forecast at one pose: simulated frames of another day are registered as in flight.

The view of another day: geometry stays. Light, weather and sensor are
`localizer.synth.appearance`'s, changes of the fine texture `localizer.synth.visits.visit`'s.
Moved shadows and map errors are not simulated; `SIGMA` is fitted on worlds that have both.

`SIGMA` and `WEIGHTS` come from ``python -m benchmarks.planning FOLDER --fit`` on its tuning worlds:
276 legs over seven, and 60 legs over three of them. Its held-out worlds were not used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from localizer.config import LocalizerConfig
from localizer.features.extractor import FeatureExtractor
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose, so3_exp
from localizer.integrity.acceptance import is_acceptable
from localizer.registration.backend import (
    LevelProblem,
    camera_from_local,
    level_problems,
    local_origin,
    world_from_camera,
)
from localizer.registration.covariance import image_gap_px, mean_motion, pose_differences
from localizer.registration.cpu.reference import in_view, project, projection_jacobian
from localizer.registration.jngo import JNGO
from localizer.registration.result import Registration
from localizer.registration.selection import quality, subsample_anchors
from localizer.render.base import MapRenderer
from localizer.synth.appearance.model import CONDITIONS, weathered
from localizer.synth.visits.visit import hard_surfaces, with_new_texture
from localizer.tracking.pipeline import reference_anchors, working_camera
from localizer.types import Anchors, Float32, Image, PosePrior, RegistrationStatus, RenderedView

RIGHT_M = 1.0  # beyond it a position is not "right"
WORST_M = 10.0  # sigmas and errors beyond it count as this
RISK_LIMIT = 0.2  # share of pictures lost or wrong beyond which a place will not do

SIGMA = (0.705, 0.097)
"""Position error in flight, one axis: a factor of the simulated registration's sigma, and what the
ground itself adds, m, see `expected_sigma_m`."""

WEIGHTS = (1.431, 0.578, -0.631, 0.0, -2.07, 0.284, 0.211)
"""Of the logistic model: constant, then those of `predictors`."""


@dataclass(frozen=True)
class Figures:
    """Statistics of simulated registrations at one view. sigma_m: median position sigma (one axis,
    rms), not yet scaled; agreement, quality: means; map_share: of the image; failed: share rejected
    or with an error above `RIGHT_M`; error_m: mean error, at most `WORST_M`.
    """

    sigma_m: float
    agreement: float
    quality: float
    map_share: float
    failed: float
    error_m: float


def predictors(figures: Figures) -> Array:
    """Inputs (6,) of the logistic model."""
    f = figures
    sigma, error = (np.log(np.clip(x, 0.01, WORST_M)) for x in (f.sigma_m, f.error_m))
    return np.array([sigma, f.agreement, f.quality, f.map_share, f.failed, error])


def expected_sigma_m(figures: Figures, constants: tuple[float, float] = SIGMA) -> float:
    """Expected position error of accepted registrations, one axis, m, from the images' equations
    and from errors of the map.
    """
    factor, map_m = constants
    return float(np.hypot(factor * figures.sigma_m, map_m))


def failure_risk(figures: Figures, weights: Sequence[float] = WEIGHTS) -> float:
    """Probability, 0 to 1, that a frame taken there is rejected or has an error above `RIGHT_M`."""
    constant, *slopes = weights
    return float(1.0 / (1.0 + np.exp(-(constant + np.dot(slopes, predictors(figures))))))


SEASON = "season"
FORECAST_CONDITIONS = (*CONDITIONS, SEASON)
_SOFT_PX = (0.4, 1.3)  # a map's texture is coarser than the picture
_CHANGED = (0.0, 0.06)  # share of the picture that shows something else by now
_CHANGE_M = 6.0  # side of such a place: a shed, a lorry, a felled tree
_DRY = np.array([1.12, 1.0, 0.8], np.float32)  # grass and leaves out of season, RGB factors
_LEAST_CELL_M = 0.02


def simulate_visit(view: RenderedView, condition: str, rng: np.random.Generator) -> Image:
    """A simulated image (H, W, 3) of `view` under one of `FORECAST_CONDITIONS`; ValueError for
    another condition.
    """
    surface = view.depth[view.depth > 0]
    if not surface.size:
        return view.rgb
    far_m = float(np.median(surface))
    cell_m = max(far_m / view.camera.fx, _LEAST_CELL_M)
    grown = _other_texture(view.rgb, cell_m, rng, condition == SEASON)
    image = _changed(grown, cell_m, rng)
    if rng.random() < 0.5:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), rng.uniform(*_SOFT_PX)), np.uint8)
    return weathered(image, view.depth, "day" if condition == SEASON else condition, rng)


def _other_texture(rgb: Image, cell_m: float, rng: np.random.Generator, dry: bool) -> Image:
    """The image with another fine texture on soft ground; dry: also out of season."""
    height, width = rgb.shape[:2]
    side = max(height, width)
    square = cv2.copyMakeBorder(
        rgb, 0, side - height, 0, side - width, cv2.BORDER_REFLECT_101
    ).astype(np.uint8, copy=False)
    lasting = hard_surfaces(square)
    albedo: Float32 = square.astype(np.float32) / np.float32(255)
    if dry:
        share = np.float32(rng.uniform(0.3, 1.0)) * (1 - lasting)[..., None]
        albedo = albedo * (1 - share) + albedo.mean(axis=2, keepdims=True) * _DRY * share
    other = with_new_texture(albedo, lasting, cell_m, rng)[:height, :width]
    image: Image = np.clip(other * 255 + 0.5, 0, 255).astype(np.uint8)
    return image


def _changed(image: Image, cell_m: float, rng: np.random.Generator) -> Image:
    """The image with some regions replaced by other parts of it."""
    height, width = image.shape[:2]
    side = int(np.clip(_CHANGE_M / cell_m, 4, min(height, width) // 4))
    count = round(rng.uniform(*_CHANGED) * height * width / side**2)
    changed: Image = image.copy()
    for _ in range(count):
        (i, k), (j, m) = rng.integers(0, height - side, 2), rng.integers(0, width - side, 2)
        changed[i : i + side, j : j + side] = image[k : k + side, m : m + side]
    return changed


_RINGS = (0.08, 0.16, 0.3, 0.45)  # of the ground's width in view
_BEARINGS = 12
_ITERATIONS = (3, 3)  # Levenberg-Marquardt steps on the coarsest and on the finest network level
_ANCHORS = 250


@dataclass(frozen=True)
class AmbiguousPosition:
    """The most similar other position. share: its match divided by the true one's, 0 (chance) to 1
    (equal); distance_m: its distance, 0 without one.
    """

    share: float
    distance_m: float


def most_similar_rival(
    optimizer: JNGO, levels: tuple[LevelProblem, ...], origin: Array, truth: Pose, width_m: float
) -> AmbiguousPosition:
    """The other position that matches the view best: poses on rings about the true one are refined,
    and the best optimum away from it is taken.

    levels: the query's levels, coarse to fine; origin: (3,) origin of their local frame; width_m:
    width of the ground in view.
    """
    angles = np.arange(_BEARINGS) * 2 * np.pi / _BEARINGS
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(_BEARINGS)], axis=1)
    steps = np.concatenate([factor * width_m * ring for factor in _RINGS])
    R, t = camera_from_local(
        np.repeat(truth.rotation[None], len(steps), axis=0), truth.translation + steps, origin
    )
    settings = optimizer.config.settings
    for level, iterations in zip((levels[0], levels[-1]), _ITERATIONS, strict=True):
        found = optimizer.backend.refine(
            subsample_anchors(level, _ANCHORS), R, t, iterations, settings
        )
        R, t = found.rotations, found.translations
    rotation, translation = camera_from_local(truth.rotation[None], truth.translation[None], origin)
    here, there = rotation[0], translation[0]
    fine = levels[-1]
    differences = pose_differences(*world_from_camera(R, t, origin), truth)
    apart = image_gap_px(
        differences, here, there, _motion(subsample_anchors(fine, _ANCHORS), here, there)
    )
    scores = np.where(apart > optimizer.config.mode_px, found.scores, np.inf)
    best = int(np.argmin(scores))
    own = quality(fine, here, there, settings)
    if not np.isfinite(scores[best]) or own <= 0:
        return AmbiguousPosition(0.0, 0.0)
    other = quality(fine, R[best], t[best], settings)
    return AmbiguousPosition(min(other / own, 1.0), float(np.linalg.norm(differences[best, :3])))


def _motion(problem: LevelProblem, rotation: Array, translation: Array) -> Array:
    """(6, 6) of `CovarianceSums.motion` at a pose."""
    x, uv = project(problem, rotation, translation)
    seen = in_view(problem, x, uv)
    return mean_motion(projection_jacobian(problem, x[seen], translation))


LEAST_MAP = 0.1  # share of a reference view, as in flight: with less nothing is registered
PRIOR_SIGMAS = np.array([1.5, 1.5, 1.0, *np.radians([1.0, 1.0, 1.5])])
"""East, north, up (m), tilt and heading (rad) of the prior that the registrations begin with: a
tracker's after a short gap."""


@dataclass(frozen=True)
class ViewForecast:
    """Forecast of the registration at a pose under one condition.

    figures: statistics of the draws; sigma_m: expected position error of accepted registrations,
    one axis; risk: probability that a frame is rejected or more than 1 m off; ground_m: median
    distance to the map along the optical axis, 0 without a map; texture: standard deviation of the
    grey value within 16 px, median, 0 to 255; rival: the most similar other position in reach.
    """

    condition: str
    figures: Figures
    sigma_m: float
    risk: float
    ground_m: float
    texture: float
    rival: AmbiguousPosition


class Forecaster:
    """Forecasts for one camera over one map; use it on one thread.

    camera: of the stream, distorted or not; draws: number of simulated frames of each condition.
    """

    def __init__(
        self,
        renderer: MapRenderer,
        extractor: FeatureExtractor,
        optimizer: JNGO,
        camera: Camera,
        config: LocalizerConfig,
        *,
        draws: int = 2,
    ) -> None:
        self._renderer, self._extractor, self._optimizer = renderer, extractor, optimizer
        self._camera = working_camera(camera, config.width)
        self._config, self._draws = config, draws

    def at(self, pose: Pose, conditions: tuple[str, ...], seed: int) -> tuple[ViewForecast, ...]:
        """One forecast for each of the conditions (`FORECAST_CONDITIONS`), at a true camera pose
        world_from_camera; deterministic for a seed.
        """
        rng = np.random.default_rng((71, seed))
        prior = draw_prior(pose, rng)
        view = self._renderer.render(pose, self._camera, wait=True)
        share = float((view.depth > 0).mean())
        reference = self._renderer.render(prior.world_from_camera, self._camera, wait=True)
        if min(share, float((reference.depth > 0).mean())) < LEAST_MAP:
            return tuple(_nothing(name, share) for name in conditions)
        anchors = reference_anchors(
            reference, self._extractor, self._config.anchors, self._config.seed
        )
        rngs = [np.random.default_rng((72, seed, k)) for k in range(len(conditions))]
        return tuple(
            self._under(name, view, anchors, prior, one)
            for name, one in zip(conditions, rngs, strict=True)
        )

    def _under(
        self,
        condition: str,
        view: RenderedView,
        anchors: Anchors,
        prior: PosePrior,
        rng: np.random.Generator,
    ) -> ViewForecast:
        found, rival = [], AmbiguousPosition(0.0, 0.0)
        for draw in range(self._draws):
            query = self._extractor.extract(simulate_visit(view, condition, rng))
            found.append(self._optimizer.register(query, self._camera, anchors, prior, seed=draw))
            if draw == 0 and found[0].status is RegistrationStatus.OK:
                origin = local_origin(anchors, view.world_from_camera)
                problems = level_problems(query, self._camera, anchors, origin)
                levels = problems[: len(self._optimizer.config.iterations)]
                rival = most_similar_rival(
                    self._optimizer, levels, origin, view.world_from_camera, _width_m(view)
                )
        figures = self._figures(found, prior, view)
        return ViewForecast(
            condition,
            figures,
            expected_sigma_m(figures),
            failure_risk(figures),
            _ground_m(view),
            texture(view.rgb),
            rival,
        )

    def _figures(self, found: list[Registration], prior: PosePrior, view: RenderedView) -> Figures:
        errors = [
            min(r.world_from_camera.distance_to(view.world_from_camera)[0], WORST_M) for r in found
        ]
        good = [
            self.is_accepted(r, prior) and e <= RIGHT_M for r, e in zip(found, errors, strict=True)
        ]
        votes = [r.agreement.share if r.agreement is not None else 0.0 for r in found]
        return Figures(
            sigma_m=float(np.median([position_sigma_m(r) for r in found])),
            agreement=float(np.mean(votes)),
            quality=float(np.mean([r.quality for r in found])),
            map_share=float((view.depth > 0).mean()),
            failed=1.0 - float(np.mean(good)),
            error_m=float(np.mean(errors)),
        )

    def is_accepted(self, found: Registration, prior: PosePrior) -> bool:
        """Whether a registration would be accepted in flight."""
        gate = prior.mahalanobis_squared(found.world_from_camera, found.covariance)
        return is_acceptable(self._config.integrity, found, gate)


def draw_prior(truth: Pose, rng: np.random.Generator) -> PosePrior:
    """A random prior about the true pose with `PRIOR_SIGMAS`."""
    drawn = rng.normal(0.0, PRIOR_SIGMAS)
    begun = Pose(so3_exp(drawn[3:]) @ truth.rotation, truth.translation + drawn[:3])
    return PosePrior(begun, np.diag(PRIOR_SIGMAS**2), 0)


def position_sigma_m(found: Registration) -> float:
    """RMS position sigma of one axis, m, at most `WORST_M`; `WORST_M` without a result."""
    if found.status is not RegistrationStatus.OK:
        return WORST_M
    return min(float(np.sqrt(np.trace(found.covariance[:3, :3]) / 3)), WORST_M)


def texture(rgb: Image) -> float:
    """Median over 16 px blocks of the standard deviation of the grey value, 0 to 255."""
    grey = rgb.astype(np.float32).mean(axis=2)
    h, w = (16 * (n // 16) for n in grey.shape)
    blocks = grey[:h, :w].reshape(h // 16, 16, w // 16, 16)
    return float(np.median(blocks.std(axis=(1, 3))))


def _ground_m(view: RenderedView) -> float:
    seen = view.depth[view.depth > 0]
    return float(np.median(seen)) if seen.size else 0.0


def _width_m(view: RenderedView) -> float:
    return _ground_m(view) * view.camera.width / view.camera.fx


def _nothing(condition: str, share: float) -> ViewForecast:
    """Forecast for a view that does not meet the map."""
    figures = Figures(WORST_M, 0.0, 0.0, share, 1.0, WORST_M)
    return ViewForecast(condition, figures, WORST_M, 1.0, 0.0, 0.0, AmbiguousPosition(0.0, 0.0))
