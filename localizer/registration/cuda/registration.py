"""`JNGO.register` with everything but the first draw and the last 6x6 algebra on the device."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from localizer.camera import Camera
from localizer.pose import Array, Pose
from localizer.registration.backend import (
    QuadraticPrior,
    camera_from_local,
    local_origin,
    world_from_camera,
)
from localizer.registration.covariance import (
    CovarianceSums,
    mode_spread,
    pose_covariance,
    pose_differences,
    sandwich_covariance,
)
from localizer.registration.cuda.schedule import CudaSchedule, Search
from localizer.registration.hypotheses import generate_hypotheses
from localizer.registration.priors import PoseConstraint
from localizer.registration.reference import prior_terms
from localizer.registration.selection import mode_probabilities
from localizer.types import Anchors, FeaturePyramid, PosePrior, RegistrationStatus

if TYPE_CHECKING:
    from localizer.registration.jngo import JNGOConfig, Registration


def register_on_device(
    schedule: CudaSchedule,
    config: JNGOConfig,
    query: FeaturePyramid,
    camera: Camera,
    anchors: Anchors,
    prior: PosePrior,
    *,
    motion: PosePrior | None = None,
    constraint: PoseConstraint | None = None,
    seed: int = 0,
) -> Registration:
    """As `JNGO.register`, for levels and anchors that it has checked; features may be on the
    device (`DeviceArray`).
    """
    origin = local_origin(anchors, prior.world_from_camera)
    rotations, centres = generate_hypotheses(
        prior,
        config.hypotheses,
        box_deg=config.box_deg,
        step_deg=config.step_deg,
        translation_limit_m=config.translation_sigma_m,
        reach=config.spread_sigmas,
        seed=seed,
    )
    local = _local_constraint(constraint, origin) if config.prior_weight > 0 else None
    search = schedule.run(
        query, camera, anchors, origin, camera_from_local(rotations, centres, origin), config,
        motion, local,
    )  # fmt: skip
    if not search.finite:
        return _failure(prior, RegistrationStatus.BAD_FEATURES)
    if len(search.scores) == 0:
        return _failure(prior, RegistrationStatus.NO_OVERLAP, search.evaluations)
    return _result(search, config, prior, origin, local)


def _local_constraint(constraint: PoseConstraint | None, origin: Array) -> QuadraticPrior | None:
    if constraint is None:
        return None
    pose = constraint.world_from_camera
    R, t = camera_from_local(pose.rotation[None], pose.translation[None], origin)
    return QuadraticPrior(Pose(R[0], t[0]), constraint.information, 1.0)


def _result(
    search: Search,
    config: JNGOConfig,
    prior: PosePrior,
    origin: Array,
    constraint: QuadraticPrior | None,
) -> Registration:
    from localizer.registration.jngo import Registration

    R, t = search.rotations[0], search.translations[0]
    prior_hessian, weight = np.zeros((6, 6)), 0.0
    if constraint is not None:
        weight = search.prior_weight
        prior_hessian = weight * prior_terms(constraint, R, t)[1]
    sums = CovarianceSums(
        search.hessian, search.meat, search.isotropic, search.cells, prior_hessian
    )
    tangent = sandwich_covariance(sums, config.correlation, config.covariance_floor, weight)
    if tangent is None:
        return _failure(prior, RegistrationStatus.NO_TEXTURE, search.evaluations)
    rotations, centres = world_from_camera(search.rotations, search.translations, origin)
    pose = Pose(rotations[0], centres[0])
    probabilities = mode_probabilities(search.scores, search.cells)
    spread = mode_spread(pose_differences(rotations, centres, pose), probabilities)
    covariance = pose_covariance(tangent, R, t) + spread
    if np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]) > config.max_sigma_m:
        return _failure(prior, RegistrationStatus.NO_TEXTURE, search.evaluations)
    return Registration(
        pose,
        covariance,
        float(search.scores[0]),
        float(search.overlaps[0]),
        search.quality,
        RegistrationStatus.OK,
        len(search.scores),
        search.evaluations,
    )


def _failure(prior: PosePrior, status: RegistrationStatus, evaluations: int = 0) -> Registration:
    from localizer.registration.jngo import Registration

    return Registration(
        prior.world_from_camera, prior.covariance, np.inf, 0.0, 0.0, status, 0, evaluations
    )
