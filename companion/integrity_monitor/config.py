"""The integrity monitor's keys in the deployment file."""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import Field

from companion.calibration_watch.config import CalibrationLimits
from localizer.sensors.error_model import SENSORS
from mavlink_bridge.config import StrictModel


@dataclass(frozen=True)
class VideoCheckConfig:
    """Limits of the check of the frames."""

    still_share: float = 3e-4  # motion below which a frame is frozen, as a share of its width
    still_s: float = 3.0  # time after which a frozen frame is reported
    repeat_memory_s: float = 60.0  # time over which repetition is searched
    repeat_s: float = 2.0  # length of a repetition that is reported
    # `FrameVerdict.detail` that is too low; refusals begin below it (docs/results/real.md)
    low_detail: float = 2.0


@dataclass(frozen=True)
class MotionCheckConfig:
    """Limits of the mean deviation of vision from the IMU over 1, 3 and 10 s."""

    limit_1s_m: float = 1.5
    limit_3s_m: float = 1.0
    limit_10s_m: float = 0.8
    still_m: float = 0.1  # position changes below this do not count as motion


class ProtectionConfig(StrictModel):
    """Error sources of the protection level that the fix's covariance does not contain, each as one
    standard deviation along an axis.

    The covariance contains the camera errors that `localizer.calibration` states. After a
    calibration the remaining camera error is small. Without one these values are a guess, and the
    remaining error may be larger.
    """

    risk: float = Field(
        default=1e-3, gt=0.0, le=0.1, description="probability of an error beyond the level"
    )
    map_m: float = Field(SENSORS.map_m, exclude=True)  # map, north and east
    map_height_m: float = Field(SENSORS.map_height_m, exclude=True)  # map height
    # camera, share of the height, without a recent `camera.calibrated`
    calibration_share: float = Field(0.003, exclude=True)
    calibrated_share: float = Field(0.001, exclude=True)  # the same with a recent calibration
    time_bias_s: float = Field(SENSORS.time_bias_s, exclude=True)  # time error, times the speed

    def of_camera(self, *, calibrated: bool) -> ProtectionConfig:
        """A copy for a camera with a recent calibration (`calibrated`), or without one."""
        share = self.calibrated_share if calibrated else self.calibration_share
        return self.model_copy(update={"calibration_share": share})


class IntegrityMonitorConfig(StrictModel):
    """Settings of the integrity monitor."""

    enabled: bool = True
    picture: VideoCheckConfig = Field(VideoCheckConfig(), exclude=True)
    motion: MotionCheckConfig = Field(MotionCheckConfig(), exclude=True)
    protection: ProtectionConfig = ProtectionConfig()
    calibration: CalibrationLimits = Field(CalibrationLimits(), exclude=True)
    height_m: float = Field(8.0, exclude=True)  # largest height difference to the barometer
    jump_m: float = Field(10.0, exclude=True)  # announced jumps above this are held
    unreported_jump_m: float = Field(3.0, exclude=True)  # unannounced jumps above this are held
    # time that a jumped position must agree in motion
    jump_hold_s: float = Field(5.0, exclude=True)
    # roll and pitch of gimbal and autopilot with mounting, 1 sigma an axis
    tilt_deg: float = Field(SENSORS.mounted_tilt_deg, exclude=True)
    gnss_accuracy_cap_m: float = Field(3.0, exclude=True)  # largest receiver error that is believed
    gnss_repeat_s: float = Field(10.0, exclude=True)  # interval of the GNSS report
