"""The monitor's keys in a deployment's configuration."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from companion.calibration_watch.config import CalibrationLimits


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class VideoCheckConfig(_Model):
    """Limits of the check of the pictures themselves."""

    still_share: float = Field(
        default=3e-4,
        gt=0.0,
        le=0.01,
        description="motion below which a frame is frozen, as a share of its width",
    )
    still_s: float = Field(
        default=3.0, ge=0.2, le=60.0, description="time after which a frozen frame is reported"
    )
    repeat_memory_s: float = Field(
        default=60.0, ge=5.0, le=600.0, description="time over which repetition is searched"
    )
    repeat_s: float = Field(
        default=2.0, ge=0.5, le=30.0, description="length of a repetition that is reported"
    )


class MotionCheckConfig(_Model):
    """Limits of vision's motion against the IMU's, as mean deviations over 1, 3 and 10 s."""

    limit_1s_m: float = Field(default=1.5, gt=0.0, le=50.0)
    limit_3s_m: float = Field(default=1.0, gt=0.0, le=50.0)
    limit_10s_m: float = Field(default=0.8, gt=0.0, le=50.0)
    still_m: float = Field(
        default=0.1,
        ge=0.0,
        le=5.0,
        description="position changes below this do not count as motion",
    )


class ProtectionConfig(_Model):
    """The budget of a protection level: what a fix's covariance does not know of, each as one
    standard deviation along an axis.

    The covariance holds what `localizer.calibration` states of the camera. Where that is the result
    of a calibration, little is left beside it; else it is a guess, and the camera may be worse.
    """

    risk: float = Field(
        default=1e-3, gt=0.0, le=0.1, description="probability of an error beyond the level"
    )
    map_m: float = Field(default=0.28, ge=0.0, le=100.0, description="map, north and east")
    map_height_m: float = Field(default=0.4, ge=0.0, le=100.0, description="map height")
    calibration_share: float = Field(
        default=0.003, ge=0.0, le=0.5,
        description="camera, share of the height, without a recent `camera.calibrated`",
    )  # fmt: skip
    calibrated_share: float = Field(
        default=0.001, ge=0.0, le=0.5,
        description="the same with a recent calibration",
    )  # fmt: skip
    time_bias_s: float = Field(
        default=0.01, ge=0.0, le=1.0, description="time error, times the speed"
    )

    def of_camera(self, *, calibrated: bool) -> ProtectionConfig:
        """The budget of a camera whose deployment states what its calibration left, or guesses."""
        share = self.calibrated_share if calibrated else self.calibration_share
        return self.model_copy(update={"calibration_share": share})


class IntegrityMonitorConfig(_Model):
    """The independent monitor: what it watches and when it withholds fixes."""

    enabled: bool = True
    picture: VideoCheckConfig = VideoCheckConfig()
    motion: MotionCheckConfig = MotionCheckConfig()
    protection: ProtectionConfig = ProtectionConfig()
    calibration: CalibrationLimits = CalibrationLimits()
    height_m: float = Field(
        default=8.0, gt=0.0, le=200.0, description="largest height difference to the barometer"
    )
    jump_m: float = Field(
        default=10.0, gt=0.0, le=1000.0, description="announced jumps above this are held"
    )
    unreported_jump_m: float = Field(
        default=3.0, gt=0.0, le=1000.0, description="unannounced jumps above this are held"
    )
    jump_hold_s: float = Field(
        default=5.0, ge=0.0, le=60.0, description="time that a jumped position must agree in motion"
    )
    tilt_deg: float = Field(
        default=0.9, ge=0.1, le=10.0,
        description="roll and pitch of gimbal and autopilot with mounting, 1 sigma an axis",
    )  # fmt: skip
    gnss_accuracy_cap_m: float = Field(
        default=3.0, gt=0.0, le=50.0, description="largest receiver error that is believed"
    )
    gnss_repeat_s: float = Field(
        default=10.0, ge=1.0, le=600.0, description="interval of the GNSS report"
    )
