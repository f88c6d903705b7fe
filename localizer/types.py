"""The frozen dataclasses passed between threads and packages.

World is the map's ENU frame (`geometry.geo.LocalFrame` about the map's origin), float64 metres.
Camera axes are OpenCV's (x right, y down, z forward). Times are CLOCK_MONOTONIC nanoseconds of the
exposure's middle.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from localizer.errors import GreyRangeError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose, so3_log

Float32 = NDArray[np.float32]
Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Frame:
    """One video frame. image: (height, width, 3) uint8 RGB, as the (distorted) camera recorded it;
    a grey image (height, width) gets three equal channels; 16-bit values are a `GreyRangeError`.
    """

    image: Image
    exposure_time_ns: int
    camera: Camera
    sequence: int

    def __post_init__(self) -> None:
        if self.image.dtype != np.uint8:
            raise GreyRangeError(
                f"frame {self.sequence}: an image of {self.image.dtype}; give 8 bits a channel, a "
                "thermal sensor's counts stretched between what shall be black and white"
            )
        if self.image.ndim == 2:
            rgb = np.repeat(self.image[..., None], 3, axis=2)
            object.__setattr__(self, "image", rgb)


@dataclass(frozen=True)
class RenderedView:
    """A rendered view. rgb: (H, W, 3) uint8. depth: (H, W) float32, z in metres along the optical
    axis at pixel centres, 0 without a surface.
    """

    rgb: Image
    depth: Float32
    world_from_camera: Pose
    camera: Camera


@dataclass(frozen=True)
class FeatureLevel:
    """One pyramid level. features: (h, w, C) float32, channels last, C-contiguous, unit length per
    pixel but on the detail level (stride 1); confidence: (h, w) float32 in (0, 1), the complement
    of the paper's uncertainty; stride: image pixels per feature pixel.
    """

    features: Float32
    confidence: Float32
    stride: int


@dataclass(frozen=True)
class FeaturePyramid:
    """Feature levels from coarse to fine of one image of size (width, height)."""

    levels: tuple[FeatureLevel, ...]
    width: int
    height: int


@dataclass(frozen=True)
class Anchors:
    """The N geo-anchors of a reference view (paper, Eq. 1).

    points_world: (N, 3) float64; pixels: (N, 2) float32 in the reference image; per level, coarse
    to fine, the reference features (N, C) float32 and confidences (N,) float32 there.
    """

    points_world: Array
    pixels: Float32
    features: tuple[Float32, ...]
    confidence: tuple[Float32, ...]


@dataclass(frozen=True)
class ReferenceBundle:
    """The rendered reference view and its geo-anchors (paper, Eq. 2). time_ns: of its pose."""

    view: RenderedView
    anchors: Anchors
    time_ns: int


@dataclass(frozen=True)
class PosePrior:
    """A predicted camera pose. covariance: (6, 6) over (position in world axes, m; rotation as a
    left-multiplied small rotation vector in world axes, rad). velocity: (3,) in world axes, m/s;
    None if unknown. independent: whether it does not derive from our own fixes. GNSS and an
    operator are independent; without GNSS the autopilot's position is our last fix, propagated.
    """

    world_from_camera: Pose
    covariance: Array
    time_ns: int
    velocity: Array | None = None
    independent: bool = True

    @classmethod
    def around(
        cls,
        world_from_camera: Pose,
        position_sigma_m: float = 5.0,
        rotation_sigma_deg: float = 4.0,
        time_ns: int = 0,
    ) -> PosePrior:
        """An independent prior of unknown velocity: position_sigma_m on each world axis, and
        rotation_sigma_deg about each.
        """
        sigma = np.repeat([position_sigma_m, np.radians(rotation_sigma_deg)], 3)
        return cls(world_from_camera, np.diag(sigma**2), time_ns)

    def mahalanobis_squared(self, pose: Pose, covariance: Array | float = 0.0) -> float:
        """Squared Mahalanobis distance (6 degrees of freedom) of a pose from the prior. covariance:
        (6, 6) of the pose, as the prior's; 0: it is exact.
        """
        known = self.world_from_camera
        turn = so3_log(pose.rotation @ known.rotation.T)
        difference = np.concatenate([pose.translation - known.translation, turn])
        return float(difference @ np.linalg.solve(self.covariance + covariance, difference))


@dataclass(frozen=True)
class GroundUncertainty:
    """Uncertainty of the ground height that odometry assumes, 1 sigma.

    grade: growth of the height error, m per metre of distance from known ground
    (`localizer.map.terrain`); the default is that of hills. missing_m: mean height of objects that
    the map lacks. model_m: a terrain model's own error: Copernicus states 2 m between neighbouring
    places in 90 % of cases.
    """

    grade: float = 0.1
    missing_m: float = 0.0
    model_m: float = 1.2


class RegistrationStatus(Enum):
    """Result of a registration."""

    OK = "ok"
    NO_OVERLAP = "no overlap: too few anchors project into the image"
    NO_TEXTURE = "the pose is not determined: no texture, or the start is too far off"
    BAD_FEATURES = "features are not finite"
    TOO_FEW_ANCHORS = "too few anchors in the reference view"
    NOT_TRIED = "not tried: elsewhere the map looks more like the image"


class TrackingState(Enum):
    """State of the tracking state machine (`localizer.tracking.states`)."""

    INITIALIZING = "initializing"
    TRACKING = "tracking"
    DEGRADED = "degraded"
    BRIDGING = "bridging"
    LOST = "lost"


@dataclass(frozen=True)
class FocalFit:
    """The best-fitting focal length, as a multiple of the camera's, and its sigma."""

    factor: float
    sigma: float


@dataclass(frozen=True)
class PoseEstimate:
    """The localizer's result for one frame.

    covariance: (6, 6) as in `PosePrior`: east, north, up (m) and rotation about them (rad).
    quality: 0 to 1. status: whether the registration gave a pose. accepted: whether the integrity
    test allows its use; it can refuse a pose with status OK. stage_ms: latency of each stage,
    milliseconds. last_fix_ns: exposure of the newest estimate that the map confirmed, this one
    included; None before the first.

    state: INITIALIZING for a single photo, which cannot be confirmed. BRIDGING estimates come from
    odometry with a growing covariance. focal: the fitted focal length, if it was fitted
    (`LocalizerConfig.focal_fit_s`) and observable. scale_sigma: of BRIDGING, the relative sigma of
    its displacement and velocity; None otherwise.
    """

    world_from_camera: Pose
    covariance: Array
    quality: float
    state: TrackingState
    status: RegistrationStatus
    accepted: bool
    exposure_time_ns: int
    sequence: int
    camera: Camera
    stage_ms: dict[str, float] = field(default_factory=dict)
    last_fix_ns: int | None = None
    focal: FocalFit | None = None
    scale_sigma: float | None = None


def _up() -> Array:
    return np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class TargetSurface:
    """A surface that a target's pixel may show. probability: 0 to 1; position: (3,) world metres;
    covariance: (3, 3) m², world axes, given this surface; normal: (3,) unit, world axes;
    repeats: (3, 3) m², the part of `covariance` that is the same in all frames of one view.
    """

    probability: float
    position: Array
    covariance: Array
    normal: Array = field(default_factory=_up)
    repeats: Array = field(default_factory=lambda: np.zeros((3, 3)))


class Visibility(Enum):
    """How a target's position is known in a frame."""

    SEEN = "seen"
    """Its pixel was measured in this frame."""
    HELD = "held"
    """It stands in the picture where the pose projects it; nobody looked."""
    HIDDEN = "hidden"
    """Something of the map stands before it, or the image no longer shows it."""
    OUTSIDE = "outside"
    """It is beside the picture."""


@dataclass(frozen=True)
class TargetFix:
    """A target's position. position_world: (3,) metres; covariance: (3, 3) m², world axes, mean
    square about the position including other surfaces. elsewhere: probability, 0 to 1, that the
    target is on another surface than the reported one.

    pixel: its position in the frame; None outside the frame. velocity: (3,) m/s, world axes, with
    its covariance (3, 3); None for a static target or after one observation. extent: its width and
    height in the frame, pixels, if known.
    """

    target_id: str
    position_world: Array
    covariance: Array
    pixel: tuple[float, float] | None
    exposure_time_ns: int
    elsewhere: float = 0.0
    velocity: Array | None = None
    velocity_covariance: Array | None = None
    visibility: Visibility = Visibility.SEEN
    extent: tuple[float, float] | None = None
