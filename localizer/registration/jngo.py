"""JNGO: registers a query image against one reference view (paper, section 3.3.2 and A.2).

Hypotheses about the prior are refined coarse to fine by Levenberg-Marquardt, pruned between levels
by successive halving, scored after the last step, and selected with the motion term of Eq. 10.
docs/explanation/registration.md is the specification.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from localizer.device_array import DeviceArray
from localizer.errors import BackendError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.registration.agreement import agreement
from localizer.registration.backend import (
    Backend,
    LevelProblem,
    LMSettings,
    QuadraticPrior,
    camera_from_local,
    level_problems,
    local_origin,
    world_from_camera,
)
from localizer.registration.config import JNGOConfig
from localizer.registration.covariance import (
    CovarianceSums,
    anchor_model,
    covariance_sums,
    curvature_ratio,
    curvature_steps,
    pose_differences,
)
from localizer.registration.cpu.kernel import NumbaBackend
from localizer.registration.cpu.reference import ReferenceBackend, retractions
from localizer.registration.cuda.backend import CudaBackend
from localizer.registration.cuda.registration import CudaRegistration
from localizer.registration.devices import warm_up
from localizer.registration.hypotheses import draw_hypotheses
from localizer.registration.priors import PoseConstraint
from localizer.registration.result import Registration, SearchSurvivors, failure, registration
from localizer.registration.selection import (
    LEAST_SCORE,
    median_residual,
    quality,
    subsample_anchors,
    suppress_duplicates,
)
from localizer.registration.zoom import FocalTest
from localizer.types import Anchors, FeaturePyramid, FocalFit, PosePrior, RegistrationStatus

_log = logging.getLogger(__name__)

_COVARIANCE_ANCHORS = 1000  # enough for a covariance, cheap enough for every frame
_VOTING_ANCHORS = 1000  # likewise
_PRESELECTING_ANCHORS = 125  # likewise, of the coarsest level
_CELLS = 1200  # of that level of a picture of 320 x 240
_ALIKE = 4  # times as many of the best draws as are wanted, because some repeat others
_APART_PX = 0.5  # rms distance on the coarsest level from which two draws are two
_LEAST_SCALE = 0.02  # of the sharpening loss, where features fit perfectly


class JNGO:
    """The optimizer. Keeps its worker threads and scratch memory between frames.

    Above 200 lines: search, final refinement and evidence use the same problems of one frame.
    """

    def __init__(
        self,
        config: JNGOConfig | None = None,
        backend: str | Backend = "numba",
        threads: int = 2,
    ) -> None:
        """backend: one, or the name of one (`make_backend`)."""
        self.config = config or JNGOConfig()
        self.backend = make_backend(backend, threads) if isinstance(backend, str) else backend
        self._threads = threads
        self._whole = (
            CudaRegistration(self.backend) if isinstance(self.backend, CudaBackend) else None
        )

    @property
    def on_gpu(self) -> bool:
        """Whether features may be on the device; False without a GPU or after its failure."""
        return self._whole is not None

    def register(
        self,
        query: FeaturePyramid,
        camera: Camera,
        anchors: Anchors,
        prior: PosePrior,
        *,
        motion: PosePrior | None = None,
        constraint: PoseConstraint | None = None,
        seed: int = 0,
    ) -> Registration:
        """Pose of the query's camera, a pinhole of the query image's size.

        prior: centre and spread of the swarm. motion: the Kalman prediction for the motion term of
        Eq. 10; None before there is one. constraint: attitude, height or position knowledge
        (`priors`); it is ignored if `prior_weight` is 0. Deterministic for a seed. On a GPU the
        query's features may be `DeviceArray`s.

        A failure is a status of the result, with the prior's pose. ValueError if query or anchors
        have not the levels of `iterations`. If the GPU fails, the CPU is used from then on, and the
        log says so; `BackendError` only if this query's features are on the GPU.
        """
        status = _input_status(query, anchors, self.config)
        if status is not RegistrationStatus.OK:
            return failure(prior, status)
        if self._whole is not None:
            try:
                on_device = self._whole.register(
                    self.config, query, camera, anchors, prior,
                    motion=motion, constraint=constraint, seed=seed,
                )  # fmt: skip
                return self._with_agreement(on_device, query, camera, anchors)
            except BackendError as error:
                _log.error("registration continues on the CPU: %s", error)
                self.backend, self._whole = NumbaBackend(self._threads), None
                if any(isinstance(level.features, DeviceArray) for level in query.levels):
                    raise  # this frame's features are where the CPU cannot read them
        if not _all_finite(query, anchors):
            return failure(prior, RegistrationStatus.BAD_FEATURES)
        origin = local_origin(anchors, prior.world_from_camera)
        problems = level_problems(query, camera, anchors, origin)
        searched = len(self.config.iterations)
        swarm = self._refine(
            problems[:searched], origin, prior, motion=motion, constraint=constraint, seed=seed
        )
        if not np.isfinite(swarm.scores[0]):
            return failure(prior, RegistrationStatus.NO_OVERLAP, swarm.evaluations)
        winner = self._sharpen(swarm, problems[searched - 1 :], constraint, origin)
        found = self._found(swarm, winner, problems[searched - 1], query.levels[-1].stride)
        return registration(found, self.config, prior, origin)

    def _with_agreement(
        self, found: Registration, query: FeaturePyramid, camera: Camera, anchors: Anchors
    ) -> Registration:
        """A GPU registration with the patch agreement that the CPU's has; unchanged if the features
        are on the device only.
        """
        on_device = any(isinstance(level.features, DeviceArray) for level in query.levels)
        if found.status is not RegistrationStatus.OK or on_device:
            return found
        origin = local_origin(anchors, found.world_from_camera)
        finest = level_problems(query, camera, anchors, origin)[len(self.config.iterations) - 1]
        pose = found.world_from_camera
        R, t = camera_from_local(pose.rotation[None], pose.translation[None], origin)
        return replace(
            found, agreement=agreement(subsample_anchors(finest, _VOTING_ANCHORS), R[0], t[0])
        )

    def with_focal_gain(
        self, query: FeaturePyramid, camera: Camera, anchors: Anchors, found: Registration
    ) -> Registration:
        """The registration with its `focal_gain` (see `FocalTest.gain`); takes 2 to 3 ms."""
        gain = FocalTest(self.backend, self.config).gain(query, camera, anchors, found)
        return replace(found, focal_gain=gain)

    def fit_focal(
        self, query: FeaturePyramid, camera: Camera, anchors: Anchors, found: Registration
    ) -> FocalFit | None:
        """The focal length that fits a registration best; see `FocalTest.fit`."""
        return FocalTest(self.backend, self.config).fit(query, camera, anchors, found)

    def _refine(
        self,
        problems: tuple[LevelProblem, ...],
        origin: Array,
        prior: PosePrior,
        *,
        motion: PosePrior | None,
        constraint: PoseConstraint | None,
        seed: int,
    ) -> _Swarm:
        c = self.config
        R, t, drawn = _beginning(self.backend, c, problems[0], origin, prior, seed)
        # Shadows of another hour shift the coarsest level's optimum by up to 20 px of the image.
        starts = (R[:0], t[:0]) if drawn.any() else (R, t)
        keep = (*c.survivors[: len(problems) - 1], c.hypotheses)
        evaluations = 0
        for level, iterations, survivors, anchors in zip(
            problems, c.iterations, keep, c.swarm_anchors, strict=True
        ):
            if level is not problems[0]:
                R, t = np.concatenate([R, starts[0]]), np.concatenate([t, starts[1]])
                drawn = np.concatenate([drawn, np.zeros(len(starts[0]), bool)])
                starts = R[:0], t[:0]
            problem = self._constrained(subsample_anchors(level, anchors), constraint, R, t, origin)
            found = self.backend.refine(problem, R, t, iterations, c.settings)
            evaluations += found.evaluations
            R, t, totals = found.rotations, found.translations, found.scores
            if level is problems[-1]:
                totals = _totals(c.motion_weight, R, t, totals, origin, motion)
                drawn = np.zeros(len(R), bool)
            order = _survivors(problem, R, t, totals, drawn, c.duplicate_px, survivors)
            R, t, drawn = R[order], t[order], drawn[order]
            scores, overlaps = found.scores[order], found.overlaps[order]
            if not np.isfinite(scores).any():
                break
        return _Swarm(problem, c.settings, R, t, scores, overlaps, evaluations)

    def _sharpen(
        self,
        swarm: _Swarm,
        problems: tuple[LevelProblem, ...],
        constraint: PoseConstraint | None,
        origin: Array,
    ) -> _Winner:
        """The best pose under ever narrower redescending losses; all anchors on the last level."""
        c = self.config
        R, t = swarm.rotations[:1].copy(), swarm.translations[:1].copy()
        problem, settings, evaluations = swarm.problem, swarm.settings, 0
        scales = (c.sharpen_scales, c.detail_scales)
        for k, level in enumerate(problems if c.sharpen else ()):
            last = k == len(problems) - 1
            problem = self._constrained(
                level if last else subsample_anchors(level, c.swarm_anchors[-1]),
                constraint,
                R,
                t,
                origin,
            )
            median = median_residual(subsample_anchors(problem, c.swarm_anchors[-1]), R[0], t[0])
            for factor in scales[k]:
                scale = max(factor * median, _LEAST_SCALE)
                settings = replace(
                    c.settings, scale=scale, redescending=True, damping=c.sharpen_damping
                )
                result = self.backend.refine(problem, R, t, c.sharpen, settings)
                R, t = result.rotations, result.translations
                evaluations += result.evaluations
        return _Winner(problem, settings, R[0], t[0], evaluations)

    def _constrained(
        self,
        problem: LevelProblem,
        constraint: PoseConstraint | None,
        R: Array,
        t: Array,
        origin: Array,
    ) -> LevelProblem:
        """The problem with the constraint as its prior, weighted by the level's best score."""
        if constraint is None or self.config.prior_weight == 0:
            return problem
        best = self.backend.refine(problem, R, t, 0, self.config.settings).scores.min()
        if not np.isfinite(best):
            return problem
        pose = constraint.world_from_camera
        rotation, translation = camera_from_local(
            pose.rotation[None], pose.translation[None], origin
        )
        target = Pose(rotation[0], translation[0])
        weight = self.config.prior_weight * max(float(best), LEAST_SCORE)
        return replace(problem, prior=QuadraticPrior(target, constraint.information, weight))

    def _found(
        self, swarm: _Swarm, winner: _Winner, level: LevelProblem, stride: int
    ) -> SearchSurvivors:
        """The survivors with the winner in the first's place, and the sums at its pose. level: the
        network's finest level, for the patch agreement.
        """
        c, problem, R, t = self.config, winner.problem, winner.rotation, winner.translation
        return SearchSurvivors(
            np.concatenate([R[None], swarm.rotations[1:]]),
            np.concatenate([t[None], swarm.translations[1:]]),
            swarm.scores,
            swarm.overlaps,
            self._sums(winner, c.correlation_px / stride),
            0.0 if problem.prior is None else problem.prior.weight,
            quality(swarm.problem, R, t, c.settings),
            swarm.evaluations + winner.evaluations,
            agreement(subsample_anchors(level, _VOTING_ANCHORS), R, t),
        )

    def _sums(self, winner: _Winner, cell_px: float) -> CovarianceSums | None:
        """The sums of equation 11 over some of the anchors, and the curvature of 11a over all."""
        R, t, settings = winner.rotation, winner.translation, winner.settings
        few = subsample_anchors(winner.problem, _COVARIANCE_ANCHORS)
        sums = covariance_sums(anchor_model(few, R, t, settings, cell_px))
        if sums is None:
            return None
        steps = curvature_steps(sums.motion, self.config.curvature_px)
        rotations, translations = retractions(R, t, steps)
        free = replace(winner.problem, prior=None)
        found = self.backend.refine(free, rotations, translations, 0, settings)
        count = winner.problem.points.shape[1]
        return replace(
            sums,
            anchors=round(float(found.overlaps[0]) * count),  # the first step is none
            share=few.points.shape[1] / count,
            curvature=curvature_ratio(found.scores, steps, sums.hessian),
        )

    def warm_up(self, channels: int) -> None:
        """Compile (or load from the cache) the kernel for feature maps of `channels`."""
        warm_up(self.backend, channels)


@dataclass(frozen=True)
class _Swarm:
    """Surviving hypotheses, best first, with the problem and the loss that scored them."""

    problem: LevelProblem
    settings: LMSettings
    rotations: Array
    translations: Array
    scores: Array
    overlaps: Array
    evaluations: int


@dataclass(frozen=True)
class _Winner:
    """The sharpened pose, camera_from_local, with the problem and loss of its last steps."""

    problem: LevelProblem
    settings: LMSettings
    rotation: Array
    translation: Array
    evaluations: int


def _beginning(
    backend: Backend,
    c: JNGOConfig,
    problem: LevelProblem,
    origin: Array,
    prior: PosePrior,
    seed: int,
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """The first hypotheses, camera_from_local: the swarm, and for a wide prior also the best of
    many draws, by the coarsest level's cost. Also returns which hypotheses are draws
    (registration.md, section 6).
    """
    R, t = camera_from_local(*c.swarm(prior, seed), origin)
    variance = float(np.linalg.eigvalsh(prior.covariance[:3, :3])[-1])
    wide = c.preselected_from_m**2 <= variance <= c.preselected_to_m**2
    # A cell of a larger picture is a smaller turn, so that as many draws would leave gaps.
    count = round(c.preselected * problem.confidence.size / _CELLS)
    if count == 0 or not wide:
        return R, t, np.zeros(len(R), bool)
    Rd, td = camera_from_local(*draw_hypotheses(prior, count, seed), origin)
    few = subsample_anchors(problem, _PRESELECTING_ANCHORS)
    scores = backend.refine(few, Rd, td, 0, c.settings).scores
    wanted = c.hypotheses // 2
    best = np.argsort(scores, kind="stable")[: _ALIKE * wanted]
    chosen = best[suppress_duplicates(few, Rd[best], td[best], scores[best], _APART_PX)][:wanted]
    drawn = np.arange(len(R) + len(chosen)) >= len(R)
    return np.concatenate([R, Rd[chosen]]), np.concatenate([t, td[chosen]]), drawn


def _survivors(
    problem: LevelProblem,
    R: Array,
    t: Array,
    totals: Array,
    drawn: NDArray[np.bool_],
    distance_px: float,
    count: int,
) -> NDArray[np.int64]:
    """Indices of the best distinct hypotheses: `count` of the swarm, half as many of the draws.

    The draws were selected by their cost, so on a dark coarse level they would displace the right
    hypotheses of the swarm.
    """
    order = np.flatnonzero(~drawn)
    order = order[suppress_duplicates(problem, R[order], t[order], totals[order], distance_px)][
        :count
    ]
    others = np.flatnonzero(drawn)
    if len(others) == 0:
        return order
    best = suppress_duplicates(problem, R[others], t[others], totals[others], distance_px)
    return np.concatenate([order, others[best][: count // 2]])


def _totals(
    weight: float, R: Array, t: Array, scores: Array, origin: Array, motion: PosePrior | None
) -> Array:
    """Eq. 10: photometric cost plus the squared Mahalanobis distance to the prediction."""
    best = max(scores.min(), LEAST_SCORE)
    if motion is None or not np.isfinite(best) or weight == 0:
        return scores
    information = np.linalg.pinv(motion.covariance, hermitian=True)
    rotations, centres = world_from_camera(R, t, origin)
    d = pose_differences(rotations, centres, motion.world_from_camera)
    squared = np.einsum("mi,ij,mj->m", d, information, d)
    totals: Array = scores + weight * best * squared
    return totals


def make_backend(name: str, threads: int = 2) -> Backend:
    """The CPU backend called `name`: "numba" (compiled, uses `threads`) or "reference" (slow NumPy,
    for tests). ValueError for another name. For a GPU see `devices.open_backend`.
    """
    if name == "numba":
        return NumbaBackend(threads)
    if name == "reference":
        return ReferenceBackend()
    raise ValueError(f"no registration backend {name!r}: choose numba or reference")


def _input_status(
    query: FeaturePyramid, anchors: Anchors, config: JNGOConfig
) -> RegistrationStatus:
    levels = len(config.iterations)
    if len(query.levels) not in (levels, levels + 1) or len(anchors.features) != len(query.levels):
        raise ValueError(
            f"iterations {config.iterations} need {levels} feature levels, or one more for detail; "
            f"query has {len(query.levels)}, anchors have {len(anchors.features)}"
        )
    if len(anchors.points_world) < config.min_anchors:
        return RegistrationStatus.TOO_FEW_ANCHORS
    return RegistrationStatus.OK


def _all_finite(query: FeaturePyramid, anchors: Anchors) -> bool:
    arrays: list[NDArray[np.floating]] = [
        anchors.points_world,
        *anchors.features,
        *anchors.confidence,
    ]
    for level in query.levels:
        arrays += [level.features, level.confidence]
    # A sum of squares is not finite when any term is not, and costs little.
    return all(bool(np.isfinite(np.vdot(a, a))) for a in arrays)
