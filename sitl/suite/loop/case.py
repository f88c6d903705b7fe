"""A flight with the whole companion in the loop as data: the faults in time, and what must hold."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

from companion.settings_file import SettingsError, read_settings, validated
from sitl.camera.faults import PictureFault, PictureFaultKind
from sitl.demo.scenario import CameraSpec, Leg, Scenario, ScenarioError

LOOP_SCENARIOS = Path(__file__).parents[2] / "scenarios" / "loop"

# Light, because it flies in real time on what may be two cores.
_CAMERA = CameraSpec(width=480, height=360, rate_hz=8)
_LEGS = (
    Leg(east_m=0, north_m=60, height_m=80, gimbal_pitch_deg=-80),
    Leg(east_m=60, north_m=60, height_m=80, gimbal_pitch_deg=-80),
    Leg(east_m=60, north_m=-60, height_m=80, gimbal_pitch_deg=-80),
    Leg(east_m=-60, north_m=-60, height_m=80, gimbal_pitch_deg=-80),
    Leg(east_m=-60, north_m=60, height_m=80, gimbal_pitch_deg=-80),
    Leg(east_m=0, north_m=0, height_m=80, gimbal_pitch_deg=-80),
)


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Picture(_Model):
    """A fault of the picture for some seconds; see `PictureFault`."""

    kind: PictureFaultKind
    for_s: float = Field(gt=0, le=300)
    late_s: float = Field(0.0, ge=0, le=2, description="of stamped_late")

    @property
    def fault(self) -> PictureFault:
        """As the world camera takes it."""
        return PictureFault(self.kind, self.late_s)


class LoopEvent(_Model):
    """Something that happens at_s seconds after GNSS was denied (or the hover began).

    picture: a fault of the video. kill: SIGKILL to the companion, which is started again
    restart_after_s later. vehicle: parameters that the ground station sets.
    """

    at_s: float = Field(ge=0)
    picture: Picture | None = None
    kill: bool = False
    restart_after_s: float = Field(1.0, ge=0, le=60)
    vehicle: dict[str, float] = {}


class Wrong(_Model):
    """What the deployment has wrong from the start.

    map_shift_m: east, north, up of where the map shows the ground. gimbal_deg: roll, pitch, yaw
    that the gimbal does not report. focal: the calibration's focal length over the true one.
    other_map: the map of another generated place.
    """

    map_shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gimbal_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    focal: float = Field(1.0, gt=0.5, lt=2.0)
    other_map: bool = False


class Expectation(_Model):
    """What must hold between the start and the end of the recorded part.

    told_within_s: an EKF error beyond `beyond_m` is told (health worse than ok) at latest so long
    after it began. never_modes: flight modes that must not be entered. max_error_m: of the EKF.
    false_fixes: injected positions further off than 5 m. ends_tracking: the last health is ok.
    says: parts of texts that must come from the companion. silent: no warning text at all.
    """

    beyond_m: float = Field(10.0, gt=0)
    told_within_s: float = Field(2.0, ge=0)
    never_modes: tuple[str, ...] = ()
    max_error_m: float | None = Field(None, gt=0)
    false_fixes: int | None = Field(0, ge=0)
    ends_tracking: bool = False
    says: tuple[str, ...] = ()
    silent: bool = False


class LoopCase(_Model):
    """One flight. seconds: length of the recorded part. hover: stay; else the legs are flown in
    AUTO. wind_m_s: from the west. deny: GNSS is switched off when it begins. ci: flown in every
    test run on the embedded vehicle. deployment: keys that differ from the demo's deployment file;
    vehicle: parameters likewise (FS_EKF_ACTION 0: no landing while the place is searched).
    """

    name: str
    title: str
    ci: bool = False
    seconds: float = Field(60.0, gt=0, le=600)
    hover: bool = False
    height_m: float = Field(80.0, gt=10, le=300)
    speed_m_s: float = Field(6.0, gt=0, le=25)
    wind_m_s: float = Field(0.0, ge=0, le=15)
    deny: bool = True
    deployment: dict[str, Any] = {}
    vehicle: dict[str, float] = {}
    wrong: Wrong = Wrong()
    timeline: tuple[LoopEvent, ...] = ()
    expect: Expectation = Expectation()

    @model_validator(mode="after")
    def _in_order(self) -> LoopCase:
        times = [event.at_s for event in self.timeline]
        if times != sorted(times) or any(t >= self.seconds for t in times):
            raise ValueError("timeline: events must be in order, and before the end")
        return self

    @property
    def scenario(self) -> Scenario:
        """The demo's scenario that this flight begins with."""
        return Scenario(
            takeoff_height_m=self.height_m, deny_after_s=3, speed_m_s=self.speed_m_s, legs=_LEGS,
            cars=3, people=3, camera=_CAMERA, localizer_width=256,
        )  # fmt: skip


def load_loop_cases(
    names: Iterable[str] = (), folder: Path = LOOP_SCENARIOS
) -> tuple[LoopCase, ...]:
    """All flights of a folder, or those named; ScenarioError names what is wrong with a file."""
    files = {path.stem: path for path in sorted(folder.glob("*.yaml"))}
    chosen = list(names) or list(files)
    unknown = [name for name in chosen if name not in files]
    if unknown:
        raise ScenarioError(f"no {', '.join(unknown)} in {folder}; there are: {', '.join(files)}")
    return tuple(_load(files[name]) for name in chosen)


def _load(path: Path) -> LoopCase:
    try:
        return validated(LoopCase, {"name": path.stem, **read_settings(path, ScenarioError)})
    except SettingsError as error:
        raise ScenarioError(f"{path}:\n{error}") from error
