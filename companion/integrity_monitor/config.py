"""The integrity monitor's keys in the deployment file."""

from __future__ import annotations

from pydantic import Field

from localizer.sensors.error_model import SENSORS
from mavlink_bridge.config import StrictModel


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
    protection: ProtectionConfig = ProtectionConfig()
