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
from localizer.tracking.attitude_bias import AttitudePrior
from localizer.tracking.motion import MotionConfig


class LocalizerConfig(BaseModel):
    """Settings of the localizer and the dual-thread engine."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    width: int = Field(320, ge=64, le=2048, description="width of query and reference, pixels")
    model: Path | None = Field(None, description="ONNX feature network; null: the shipped one")
    anchors: int = Field(4000, ge=50, le=8000, description="geo-anchors per reference view")
    reference_shift_px: float = Field(
        2.0,
        ge=0,
        le=100,
        description="a reference is used while its anchors move less, working px; 0: one per frame",
    )
    renderer: RendererName = Field(
        "auto", description="auto: a GPU if there is one, otherwise numba"
    )
    device: DeviceChoice = Field(
        "cpu", description="of the optimizer; auto, cuda: a working GPU, otherwise the CPU"
    )
    threads: int = Field(2, ge=1, le=256, description="CPU threads of rendering and optimization")
    feature_threads: int = Field(
        1, ge=1, le=256, description="CPU threads of each feature extraction"
    )
    feature_half: bool = Field(False, description="TensorRT computes features in float16")
    cache_mib: int = Field(384, ge=16, le=1 << 20, description="resident tiles, MiB")
    focal_fit_s: float = Field(
        0.0,
        ge=0,
        le=3600,
        description="interval of focal length fits, s; 0: none",
    )
    seed: int = Field(0, ge=0, lt=2**31, description="seed of anchors and hypotheses")
    registration: JNGOConfig = JNGOConfig()
    calibration: CalibrationSigmas = CalibrationSigmas()
    attitude: AttitudePrior | None = Field(
        AttitudePrior(),
        description="fuse roll and pitch of autopilot and gimbal with each fix; null: no",
    )
    height_sigma_m: float | None = Field(
        3.0,
        ge=0.1,
        le=1000,
        description="of the autopilot's height (barometer) against the map's; null: not used",
    )
    motion: MotionConfig = MotionConfig()
    integrity: IntegrityConfig = IntegrityConfig()
    odometry: OdometryConfig | None = Field(
        OdometryConfig(), description="propagates the pose where the map does not match; null: off"
    )
    relocalization: RelocalizationConfig = RelocalizationConfig()
