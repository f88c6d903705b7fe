"""A flight's script as data: where, what is denied when, the legs, and the camera."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from companion.config import CameraModel
from companion.settings_file import SettingsError, read_settings, validated
from localizer.geometry.camera import Camera
from sitl.errors import SimulationError

VehicleChoice = Literal["auto", "ardupilot", "embedded"]
Injection = Literal["vision_position_estimate", "odometry", "gps_input"]


class ScenarioError(SimulationError):
    """A scenario file that cannot be read or does not hold."""


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Leg(_Model):
    """A waypoint: metres east and north of home, height above home, and the gimbal's pitch on the
    way there (-90 looks straight down).
    """

    east_m: float = Field(ge=-20_000, le=20_000)
    north_m: float = Field(ge=-20_000, le=20_000)
    height_m: float = Field(120.0, ge=5, le=1000)
    gimbal_pitch_deg: float = Field(-75.0, ge=-90, le=0)


class CameraSpec(_Model):
    """The world camera's video. H.264 of this chroma format takes even sizes only."""

    width: int = Field(640, ge=64, le=4096, multiple_of=2)
    height: int = Field(480, ge=64, le=4096, multiple_of=2)
    horizontal_fov_deg: float = Field(65.0, gt=20, lt=120)
    distortion: tuple[float, float, float, float, float] = (-0.09, 0.02, 0.0006, -0.0004, 0.0)
    rate_hz: float = Field(10.0, ge=0.5, le=60)

    @model_validator(mode="after")
    def _is_a_lens(self) -> CameraSpec:
        """What the companion would refuse is not filmed with either."""
        c = self.camera()
        CameraModel(width=c.width, height=c.height, fx=c.fx, fy=c.fy, cx=c.cx, cy=c.cy,
                    distortion=c.distortion)  # fmt: skip
        return self

    def camera(self) -> Camera:
        """The calibrated model."""
        ideal = Camera.from_fov(self.width, self.height, self.horizontal_fov_deg)
        return Camera(
            ideal.width, ideal.height, ideal.fx, ideal.fy, ideal.cx, ideal.cy, self.distortion
        )


_LEGS = (
    Leg(east_m=0, north_m=220, height_m=120, gimbal_pitch_deg=-75),
    Leg(east_m=220, north_m=260, height_m=140, gimbal_pitch_deg=-60),
    Leg(east_m=270, north_m=40, height_m=130, gimbal_pitch_deg=-90),
    Leg(east_m=110, north_m=-170, height_m=110, gimbal_pitch_deg=-55),
    Leg(east_m=-140, north_m=-90, height_m=120, gimbal_pitch_deg=-70),
    Leg(east_m=0, north_m=0, height_m=120, gimbal_pitch_deg=-80),
)


class Scenario(_Model):
    """One GNSS-denied flight."""

    takeoff_height_m: float = Field(120.0, gt=20, le=1000)
    deny_after_s: float = Field(
        20.0, gt=0, le=3600, description="after the take-off height is reached"
    )
    speed_m_s: float = Field(10.0, ge=0.5, le=25)
    legs: tuple[Leg, ...] = Field(_LEGS, min_length=1)
    camera: CameraSpec = CameraSpec()
    condition: Literal["day", "dusk", "night", "fog", "rain", "snow"] = "day"
    cars: int = Field(30, ge=1, le=2000)
    people: int = Field(40, ge=0, le=2000)
    localizer_width: int = Field(320, ge=64, le=2048, description="the localizer's working width")
    injection: Injection = "vision_position_estimate"
    injection_delay_ms: float = Field(220.0, ge=0, le=250, description="VISO_DELAY_MS")


def load_scenario(path: Path) -> Scenario:
    """Read a scenario file; unknown keys and bad values are named."""
    try:
        return validated(Scenario, read_settings(path, ScenarioError))
    except SettingsError as error:
        raise ScenarioError(f"{path}:\n{error}") from error


def check_inside(scenario: Scenario, size_m: float) -> None:
    """ScenarioError for a leg that leaves the world, a square of `size_m` about home."""
    for number, leg in enumerate(scenario.legs):
        if not max(abs(leg.east_m), abs(leg.north_m)) <= size_m / 2:
            raise ScenarioError(
                f"legs.{number}: {leg.east_m:g} m east, {leg.north_m:g} m north is outside the "
                f"world, which reaches {size_m / 2:g} m from home"
            )
