"""`JNGO.register` on the device, except the initial swarm and the final 6x6 algebra."""

from __future__ import annotations

from dataclasses import replace

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.registration.backend import QuadraticPrior, camera_from_local, local_origin
from localizer.registration.config import JNGOConfig
from localizer.registration.cpu.reference import prior_terms
from localizer.registration.cuda.backend import CudaBackend
from localizer.registration.cuda.schedule import CudaSchedule
from localizer.registration.priors import PoseConstraint
from localizer.registration.result import Registration, SearchSurvivors, failure, registration
from localizer.types import Anchors, FeaturePyramid, PosePrior, RegistrationStatus


class CudaRegistration:
    """Registers frames on a `CudaBackend`, with its device and memory."""

    def __init__(self, backend: CudaBackend) -> None:
        self._schedule = CudaSchedule(backend)

    def register(  # noqa: PLR0913
        self,
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
        device (`DeviceArray`). `BackendError` if the device failed.
        """
        origin = local_origin(anchors, prior.world_from_camera)
        local = _local_constraint(constraint, origin) if config.prior_weight > 0 else None
        search = self._schedule.run(
            query, camera, anchors, origin, camera_from_local(*config.swarm(prior, seed), origin),
            config, motion, local,
        )  # fmt: skip
        if not search.finite:
            return failure(prior, RegistrationStatus.BAD_FEATURES)
        found = search.survivors
        if len(found.scores) == 0:
            return failure(prior, RegistrationStatus.NO_OVERLAP, found.evaluations)
        return registration(_with_prior(found, local), config, prior, origin)


def _local_constraint(constraint: PoseConstraint | None, origin: Array) -> QuadraticPrior | None:
    if constraint is None:
        return None
    pose = constraint.world_from_camera
    R, t = camera_from_local(pose.rotation[None], pose.translation[None], origin)
    return QuadraticPrior(Pose(R[0], t[0]), constraint.information, 1.0)


def _with_prior(found: SearchSurvivors, constraint: QuadraticPrior | None) -> SearchSurvivors:
    """The survivors with the constraint in their sums."""
    if constraint is None or found.sums is None:
        return replace(found, prior_weight=0.0)
    _, hessian, _ = prior_terms(constraint, found.rotations[0], found.translations[0])
    return replace(found, sums=replace(found.sums, prior_hessian=found.prior_weight * hessian))
