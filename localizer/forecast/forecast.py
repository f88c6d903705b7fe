"""Forecast at one pose: simulated frames of another day are registered as in flight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from localizer.config import LocalizerConfig
from localizer.features.extractor import FeatureExtractor
from localizer.forecast.risk import RIGHT_M, WORST_M, Figures, expected_sigma_m, failure_risk
from localizer.forecast.rivals import AmbiguousPosition, most_similar_rival
from localizer.forecast.visit import simulate_visit
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose, so3_exp
from localizer.integrity.acceptance import is_acceptable
from localizer.registration.backend import level_problems, local_origin
from localizer.registration.jngo import JNGO
from localizer.registration.result import Registration
from localizer.render.base import MapRenderer
from localizer.tracking.pipeline import reference_anchors, working_camera
from localizer.types import Anchors, Image, PosePrior, RegistrationStatus, RenderedView

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
