"""From when on a calibration is called wrong."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class CalibrationLimits(BaseModel):
    """A finding beyond a limit is told, and injection does not begin; four sigmas must agree."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    enabled: bool = True
    focal_share: float = Field(default=0.025, ge=0.005, le=0.5, description="focal length error")
    boresight_deg: float = Field(
        default=3.0, ge=0.2, le=45.0, description="boresight error against gimbal and autopilot"
    )
    time_s: float = Field(default=0.08, ge=0.01, le=2.0, description="time offset")
