"""What a backend offers that registers a whole frame by itself, and not level by level."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from localizer.geometry.camera import Camera
from localizer.registration.config import JNGOConfig
from localizer.registration.priors import PoseConstraint
from localizer.registration.result import Registration
from localizer.types import Anchors, FeaturePyramid, PosePrior


class DeviceRegistration(Protocol):
    """`JNGO.register` on a device, from the first draw to the covariance's sums."""

    def register(
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
        """As `JNGO.register`, for levels and anchors that it has checked; the query's features may
        be on the device (`DeviceArray`). `BackendError` if the device failed.
        """
        ...


@runtime_checkable
class DeviceBackend(Protocol):
    """A `Backend` that registers whole frames, too: where the way to its memory is long."""

    def whole(self) -> DeviceRegistration:
        """The registration, which shares the backend's device and memory."""
        ...
