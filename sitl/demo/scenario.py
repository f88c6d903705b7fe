"""Demo scenario file: mission, camera, weather, GNSS denial, and the errors that a flight draws."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from companion.config import CameraModel
from companion.settings_file import SettingsError, read_settings, validated
from localizer.geometry.camera import Camera
from localizer.synth.config import Character
from mavlink_bridge.config import StrictModel
from sitl.camera.detector import DetectorErrors
from sitl.camera.realism import CameraRealism
from sitl.errors import SimulationError

VehicleChoice = Literal["auto", "ardupilot", "embedded"]
Shift = Annotated[float, Field(ge=0, le=50)]
Condition = Literal["day", "dusk", "night", "fog", "rain", "snow"]
Injection = Literal["vision_position_estimate", "odometry", "gps_input"]


DEMO_SCENARIOS = Path(__file__).parents[1] / "scenarios" / "demo"


class ScenarioError(SimulationError):
    """A scenario file that cannot be read or is invalid."""


class ScenarioLeg(StrictModel):
    """A waypoint: metres east and north of home, height above home, and the gimbal's pitch on the
    leg to it (-90 is straight down).
    """

    east_m: float = Field(ge=-20_000, le=20_000)
    north_m: float = Field(ge=-20_000, le=20_000)
    height_m: float = Field(120.0, ge=5, le=1000)
    gimbal_pitch_deg: float = Field(-75.0, ge=-90, le=0)


class ErrorSpec(StrictModel):
    """Differences between deployment file and aircraft, as standard deviations from which each
    flight draws (map_shift_m: smallest and largest value). The defaults are the residuals of a
    careful calibration.
    """

    focal_percent: float = Field(0.1, ge=0, le=5, description="of the focal length")
    principal_px: float = Field(0.7, ge=0, le=50, description="of the principal point, per axis")
    distortion: float = Field(0.003, ge=0, le=0.1, description="of k1; k2 as much, p1, p2 a tenth")
    lever_arm_m: float = Field(0.05, ge=0, le=2, description="camera to autopilot, per axis")
    stamp_offset_ms: float = Field(3.0, ge=0, le=200, description="of the camera's clock")
    stamp_jitter_ms: float = Field(2.0, ge=0, le=100, description="from frame to frame")
    readout_ms: float = Field(1.0, ge=0, le=20, description="of the shutter's readout time")
    map_shift_m: tuple[Shift, Shift] = Field(
        (0.3, 1.5), description="least and most that the map lies beside GNSS, horizontally"
    )
    map_shift_up_m: float = Field(0.3, ge=0, le=10)
    detector_px: float = Field(1.0, ge=0, le=50)
    detector_missed: float = Field(0.1, ge=0, lt=1, description="share of frames, per target")
    detector_false: float = Field(0.02, ge=0, lt=1, description="share of frames")
    detector_swapped: float = Field(0.01, ge=0, lt=1, description="share of frames")
    detector_box_centre: bool = Field(True, description="of what moves, not its ground point")

    @classmethod
    def none(cls) -> ErrorSpec:
        """No calibration or map errors, and a detector noise of one pixel."""
        return cls(
            focal_percent=0, principal_px=0, distortion=0, lever_arm_m=0, stamp_offset_ms=0,
            stamp_jitter_ms=0, readout_ms=0, map_shift_m=(0.0, 0.0), map_shift_up_m=0,
            detector_missed=0, detector_false=0, detector_swapped=0, detector_box_centre=False,
        )  # fmt: skip

    @model_validator(mode="after")
    def _in_order(self) -> ErrorSpec:
        least, most = self.map_shift_m
        if least > most:
            raise ValueError(f"map_shift_m: the least, {least:g}, is more than the most, {most:g}")
        return self


class CameraSpec(StrictModel):
    """The world camera's video. Width and height must be even (H.264 4:2:0)."""

    width: int = Field(640, ge=64, le=4096, multiple_of=2)
    height: int = Field(480, ge=64, le=4096, multiple_of=2)
    horizontal_fov_deg: float = Field(65.0, gt=20, lt=120)
    distortion: tuple[float, float, float, float, float] = (-0.09, 0.02, 0.0006, -0.0004, 0.0)
    rate_hz: float = Field(10.0, ge=0.5, le=60)
    bit_rate_kbps: int = Field(2500, ge=200, le=50_000)
    packet_loss: float = Field(1e-4, ge=0, le=0.2, description="share of the stream's datagrams")
    readout_ms: float = Field(20.0, ge=0, le=60, description="rolling shutter, first to last row")
    vibration_deg: float = Field(0.02, ge=0, le=1, description="root mean square per axis")
    auto_exposure: bool = True
    supersample: float = Field(1.25, ge=1, le=4, description="rendered pixels per pixel and axis")

    @model_validator(mode="after")
    def _is_a_lens(self) -> CameraSpec:
        """What the companion would refuse is not filmed with either."""
        c = self.camera()
        CameraModel(width=c.width, height=c.height, fx=c.fx, fy=c.fy, cx=c.cx, cy=c.cy,
                    distortion=c.distortion)  # fmt: skip
        return self

    def camera(self) -> Camera:
        """The calibrated camera model."""
        ideal = Camera.from_fov(self.width, self.height, self.horizontal_fov_deg)
        return Camera(
            ideal.width, ideal.height, ideal.fx, ideal.fy, ideal.cx, ideal.cy, self.distortion,
            self.readout_ms,
        )  # fmt: skip


class SatelliteMap(StrictModel):
    """A satellite mosaic over bare-earth terrain as the map. off_nadir_deg: angle between the line
    of sight and the vertical. azimuth_deg: direction to the satellite, clockwise from north.
    """

    off_nadir_deg: float = Field(12.0, ge=0, le=45)
    azimuth_deg: float = Field(180.0, ge=0, lt=360)
    texel_m: float = Field(0.25, ge=0.1, le=5)
    blur_px: float = Field(1.3, ge=0, le=20, description="sigma of the mosaic's blur")

    @property
    def name(self) -> str:
        """Name of its cache folder."""
        numbers = (self.off_nadir_deg, self.azimuth_deg, self.texel_m, self.blur_px)
        return "satellite-" + "-".join(f"{number:g}" for number in numbers)


_LEGS = (
    ScenarioLeg(east_m=0, north_m=220, height_m=120, gimbal_pitch_deg=-75),
    ScenarioLeg(east_m=220, north_m=260, height_m=140, gimbal_pitch_deg=-60),
    ScenarioLeg(east_m=270, north_m=40, height_m=130, gimbal_pitch_deg=-90),
    ScenarioLeg(east_m=110, north_m=-170, height_m=110, gimbal_pitch_deg=-55),
    ScenarioLeg(east_m=-140, north_m=-90, height_m=120, gimbal_pitch_deg=-70),
    ScenarioLeg(east_m=0, north_m=0, height_m=120, gimbal_pitch_deg=-80),
)


class Scenario(StrictModel):
    """A flight without GNSS. The defaults have realistic errors; `ideal` has none."""

    takeoff_height_m: float = Field(120.0, gt=20, le=1000)
    deny_after_s: float = Field(
        20.0, gt=0, le=3600, description="after the take-off height is reached"
    )
    speed_m_s: float = Field(10.0, ge=0.5, le=25)
    legs: tuple[ScenarioLeg, ...] = Field(_LEGS, min_length=1)
    world: Character = "mixed"
    world_m: float = Field(
        1600.0, ge=400, le=8000, multiple_of=400, description="side of the world"
    )
    satellite: SatelliteMap | None = Field(
        None, description="the map is a satellite's mosaic; none: a survey's surface"
    )
    camera: CameraSpec = CameraSpec()
    errors: ErrorSpec = ErrorSpec()
    condition: Condition = "day"
    land: bool = Field(False, description="at home, on vision alone, before the flight ends")
    cars: int = Field(30, ge=1, le=2000)
    people: int = Field(40, ge=0, le=2000)
    localizer_width: int = Field(320, ge=64, le=2048, description="the localizer's working width")
    injection: Injection = "vision_position_estimate"
    injection_delay_ms: float = Field(220.0, ge=0, le=250, description="VISO_DELAY_MS")

    def ideal(self) -> Scenario:
        """The same flight with a perfect camera and an exact deployment file."""
        perfect = {
            "bit_rate_kbps": 4000, "packet_loss": 0.0, "readout_ms": 0.0, "vibration_deg": 0.0,
            "auto_exposure": False, "supersample": 1.0,
        }  # fmt: skip
        camera = self.camera.model_copy(update=perfect)
        return self.model_copy(update={"camera": camera, "errors": ErrorSpec.none()})


def load_scenario(path: Path) -> Scenario:
    """Read a scenario file. `ScenarioError` names unknown keys and invalid values."""
    try:
        return validated(Scenario, read_settings(path, ScenarioError))
    except SettingsError as error:
        raise ScenarioError(f"{path}:\n{error}") from error


def scenario_names() -> tuple[str, ...]:
    """Names of the scenarios in the package."""
    return tuple(sorted(path.stem for path in DEMO_SCENARIOS.glob("*.yaml")))


def named_scenario(name: str) -> Scenario:
    """Load a scenario by path or by its name in the package; else `ScenarioError`."""
    shipped = DEMO_SCENARIOS / f"{name}.yaml"
    if shipped.exists() and not Path(name).exists():
        return load_scenario(shipped)
    if Path(name).suffix in (".yaml", ".yml") or Path(name).exists():
        return load_scenario(Path(name))
    raise ScenarioError(
        f"no scenario {name!r}; there are: {', '.join(scenario_names())}, or give a file.yaml"
    )


def check_inside(scenario: Scenario, size_m: float) -> None:
    """`ScenarioError` if a leg leaves the world, a square of side `size_m` about home."""
    for number, leg in enumerate(scenario.legs):
        if not max(abs(leg.east_m), abs(leg.north_m)) <= size_m / 2:
            raise ScenarioError(
                f"legs.{number}: {leg.east_m:g} m east, {leg.north_m:g} m north is outside the "
                f"world, which reaches {size_m / 2:g} m from home"
            )


@dataclass(frozen=True)
class FlightErrors:
    """True values that differ from the deployment file.

    camera: the true intrinsics. lever_arm_m: the camera's true position, body axes (the file says
    zero). map_shift_m: offset of the map from the world (east, north, up).
    """

    camera: Camera
    lever_arm_m: tuple[float, float, float]
    map_shift_m: tuple[float, float, float]
    realism: CameraRealism
    detector: DetectorErrors


def draw_errors(scenario: Scenario, seed: int) -> FlightErrors:
    """Draw the errors of a flight from its scenario's standard deviations. Each error has its own
    random generator, so that disabling one does not change the others.
    """
    spec, nominal = scenario.errors, scenario.camera.camera()

    def normal(key: int, count: int) -> np.ndarray:
        return np.random.default_rng([seed, 41, key]).normal(size=count)

    c = scenario.camera
    rolls = c.readout_ms > 0
    readout_ms = max(c.readout_ms + spec.readout_ms * float(normal(6, 1)[0]), 0.0) if rolls else 0.0
    scale = 1.0 + 0.01 * spec.focal_percent * float(normal(0, 1)[0])
    principal = spec.principal_px * normal(1, 2)
    bend = spec.distortion * normal(2, 5) * (1.0, 1.0, 0.1, 0.1, 0.0)
    k1, k2, p1, p2, k3 = (float(x) for x in np.asarray(nominal.distortion) + bend)
    camera = Camera(
        nominal.width, nominal.height, nominal.fx * scale, nominal.fy * scale,
        nominal.cx + float(principal[0]), nominal.cy + float(principal[1]), (k1, k2, p1, p2, k3),
        readout_ms,
    )  # fmt: skip
    rng = np.random.default_rng([seed, 41, 4])
    away, bearing = rng.uniform(*spec.map_shift_m), rng.uniform(0, 2 * np.pi)
    up = spec.map_shift_up_m * float(rng.normal())
    arm = spec.lever_arm_m * normal(3, 3)
    realism = CameraRealism(
        readout_ms, c.vibration_deg, c.auto_exposure, c.supersample, c.packet_loss,
        spec.stamp_offset_ms * float(normal(5, 1)[0]), spec.stamp_jitter_ms,
    )  # fmt: skip
    detector = DetectorErrors(
        spec.detector_px, spec.detector_missed, spec.detector_false, spec.detector_swapped,
        spec.detector_box_centre,
    )  # fmt: skip
    return FlightErrors(
        camera,
        (float(arm[0]), float(arm[1]), float(arm[2])),
        (float(away * np.sin(bearing)), float(away * np.cos(bearing)), up),
        realism,
        detector,
    )
