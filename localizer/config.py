"""Settings of the localizer: one frozen model, unknown keys are errors."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from localizer.integrity.acceptance import IntegrityConfig
from localizer.odometry.config import OdometryConfig
from localizer.registration.calibration import CalibrationSigmas
from localizer.registration.config import JNGOConfig
from localizer.registration.devices import DeviceChoice
from localizer.relocalization.config import RelocalizationConfig
from localizer.render.select import RendererName
from localizer.sensors.error_model import SENSORS
from localizer.tracking.attitude_bias import AttitudePrior
from localizer.tracking.motion import MotionConfig


class LocalizerConfig(BaseModel):
    """Settings of the localizer and the dual-thread engine.

    Fields with `exclude=True` are constants of the algorithms: code may set them, a deployment file
    cannot.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    width: int = Field(320, ge=64, le=2048, description="width of query and reference, pixels")
    model: Path | None = Field(None, description="ONNX feature network; null: the shipped one")
    anchors: int = Field(4000, exclude=True)  # geo-anchors per reference view
    # a reference is used while its anchors move less, px of an image 320 wide; 0: one per frame
    reference_shift_px: float = Field(2.0, exclude=True)
    renderer: RendererName = Field(
        "auto", description="auto: a GPU if there is one, otherwise numba"
    )
    device: DeviceChoice = Field(
        "cpu", description="runs the optimizer; auto, cuda: a working GPU, otherwise the CPU"
    )
    threads: int = Field(
        2,
        ge=1,
        le=256,
        description="CPU threads of rendering and optimization; features use half as many",
    )
    # CPU threads of each feature extraction; None: half of `threads`, beside the optimizer
    feature_threads: int | None = Field(None, exclude=True)
    terrain: Path | None = Field(
        None, description="GeoTIFF of ground heights outside the map, for the odometry"
    )
    feature_half: bool = Field(False, description="TensorRT computes features in float16")
    cache_mib: int = Field(384, ge=16, le=1 << 20, description="resident tiles, MiB")
    focal_fit_s: float = Field(0.0, exclude=True)  # interval of focal length fits, s; 0: none
    seed: int = Field(0, exclude=True)  # seed of anchors and hypotheses
    registration: JNGOConfig = Field(JNGOConfig(), exclude=True)
    calibration: CalibrationSigmas = Field(
        CalibrationSigmas(), description="remaining errors of camera.model, 1 sigma"
    )
    # fuse roll and pitch of autopilot and gimbal with each fix; None: no
    attitude: AttitudePrior | None = Field(AttitudePrior(), exclude=True)
    # of the autopilot's height (barometer) against the map's; None: not used
    height_sigma_m: float | None = Field(SENSORS.height_m, exclude=True)
    motion: MotionConfig = Field(MotionConfig(), exclude=True)
    integrity: IntegrityConfig = Field(IntegrityConfig(), exclude=True)
    # propagates the pose where the map does not match; None: off
    odometry: OdometryConfig | None = Field(OdometryConfig(), exclude=True)
    relocalization: RelocalizationConfig = Field(RelocalizationConfig(), exclude=True)
