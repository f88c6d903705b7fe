"""Input and output of the odometry for a frame."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.geometry.shutter import Sweep
from localizer.odometry.keyframe import DepthSource
from localizer.odometry.usability import ImageFault
from localizer.types import FeaturePyramid


class OdometryStatus(Enum):
    """Whether the pose was propagated to a frame, and why not."""

    OK = "carried on"
    UNUSABLE_IMAGE = "the picture shows nothing that could be registered"
    NOT_REGISTERED = "the picture does not fit the keyframe"
    LOST = "the thread is lost: nothing was seen for too long, the map must be found again"


@dataclass(frozen=True)
class OdometryFrame:
    """Data of one frame for the odometry.

    features: of the undistorted image, in host memory, as for the map registration. time_ns: the
    exposure's. fault: as by `usability.find_fault`, None also if the frame was not examined. sweep:
    the camera's motion during the readout; None for a global shutter. camera: the pinhole of the
    features; None: the odometry's, for a lens that does not zoom.
    """

    features: FeaturePyramid
    time_ns: int
    fault: ImageFault | None = None
    sweep: Sweep | None = None
    camera: Camera | None = None


@dataclass(frozen=True)
class OdometryEstimate:
    """The odometry's result for one frame.

    world_from_camera: the camera's pose; the predicted pose if the status is not OK. covariance:
    (6, 6) as `PosePrior`'s, including that of the start. quality: 0 to 1, of the registration
    against the keyframe. reason: why the status is not OK, as text. bridged_s, way_m: time and
    distance since the pose was last known from another source (`begin`). drift_m: 95 % bound of the
    horizontal error added since then. keyframe_age_s: since the keyframe's exposure. source: of the
    keyframe's depth. scale_sigma: relative sigma of distance and velocity, equal to that of the
    height above the ground.
    """

    world_from_camera: Pose
    covariance: Array
    quality: float
    status: OdometryStatus
    reason: str
    time_ns: int
    bridged_s: float
    way_m: float
    drift_m: float
    keyframe_age_s: float
    source: DepthSource
    scale_sigma: float

    @property
    def usable(self) -> bool:
        """Whether the pose may be used as a measurement."""
        return self.status is OdometryStatus.OK
