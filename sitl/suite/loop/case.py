"""Scenario file of a flight with the complete companion: faults in time, and expectations."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pydantic import Field, model_validator

from companion.settings_file import SettingsError, read_settings, validated
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.config import StrictModel
from sitl.camera.faults import PictureFault, PictureFaultKind
from sitl.camera.zoom import MOST as ZOOM_MOST
from sitl.demo.scenario import CameraSpec, Scenario, ScenarioError, ScenarioLeg
from sitl.suite.checks import AlertExpectation
from sitl.suite.ramp import Ramp

LOOP_SCENARIOS = Path(__file__).parents[2] / "scenarios" / "loop"

# Light, because it flies in real time on what may be two cores.
_CAMERA = CameraSpec(width=480, height=360, rate_hz=8)
_CORNERS = ((0, 60), (60, 60), (60, -60), (-60, -60), (-60, 60), (0, 0))  # east, north; metres
_PITCH_DEG = -80.0


class VideoFault(StrictModel):
    """A video fault of some seconds; see `PictureFault`."""

    kind: PictureFaultKind
    for_s: float = Field(gt=0, le=300)
    late_s: float = Field(0.0, ge=0, le=2, description="of stamped_late and late")
    halves_s: float = Field(4.0, gt=0, le=60, description="of darkens")

    @property
    def fault(self) -> PictureFault:
        """The fault for the world camera."""
        return PictureFault(self.kind, self.halves_s if self.kind == "darkens" else self.late_s)


class Zoom(StrictModel):
    """A change of the focal length to a multiple of the shortest, over some seconds."""

    to: float = Field(ge=1.0, le=ZOOM_MOST)
    over_s: float = Field(2.0, ge=0, le=60)


class Load(StrictModel):
    """CPU load: `processes` busy processes run on one processor with the companion."""

    processes: int = Field(ge=1, le=32)
    for_s: float = Field(gt=0, le=300)


class OperatorHint(StrictModel):
    """The operator sends a position hint that is off_north_m from the true position."""

    radius_m: float = Field(gt=0, le=5000)
    off_north_m: float = Field(0.0, ge=-2000, le=2000)


class LoopEvent(Ramp):
    """A fault or command, at_s seconds after the recorded part began (and GNSS was denied).

    picture: a fault of the video. zoom: of the lens. kill: SIGKILL to the companion, started again
    restart_after_s later, or by its supervisor. hang: SIGSTOP to the flight process. start: of a
    companion that did not run until now (`cold`). vehicle: parameters that the ground station sets.
    """

    at_s: float = Field(ge=0)
    picture: VideoFault | None = None
    zoom: Zoom | None = None
    load: Load | None = None
    hint: OperatorHint | None = None
    start: bool = False
    kill: bool = False
    hang: bool = False
    restart_after_s: float = Field(1.0, ge=0, le=60)
    vehicle: dict[str, float] = Field(default_factory=dict)


class DeploymentErrors(StrictModel):
    """Errors in the deployment file or the map from the start.

    map_shift_m: east, north, up of where the map shows the ground. gimbal_deg: roll, pitch, yaw
    that the gimbal does not report. focal: the calibration's focal length over the true one.
    other_map: the map of another generated place. map_reach_m: nothing is in the map further east,
    west, north or south of home; a multiple of 200 m. terrain_off_m: the companion has a terrain
    model of the whole world, a height each 30 m, so much too high.
    """

    map_shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gimbal_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    focal: float = Field(1.0, gt=0.5, lt=2.0)
    other_map: bool = False
    map_reach_m: float | None = Field(None, ge=200, multiple_of=200)
    terrain_off_m: float | None = Field(None, ge=-100, le=100)


class Expectation(StrictModel):
    """Limits and alerts to check between start and end of the recorded part.

    told_within_s: an EKF error beyond `beyond_m` is told (health worse than ok, or a finding of the
    monitor that stands) at latest so long after it began. never_modes: flight modes that must not
    be entered. max_error_m: of the EKF. false_fixes: injected positions further off than 5 m;
    injects: and some are injected. back_within_s: of a kill or a hang, injected again.
    repeats: how often the companion may say the same, figures aside. ends_tracking: the last health
    is ok. reports: alerts that must come from the companion; alerts: those that must come, or
    must not, within a time; warns_first: one that must come before the first text that localization
    is degraded or lost.
    silent: no warning text, no finding of the monitor, and a health that is ok throughout.
    """

    beyond_m: float = Field(10.0, gt=0)
    told_within_s: float = Field(2.0, ge=0)
    never_modes: tuple[str, ...] = ()
    max_error_m: float | None = Field(None, gt=0)
    false_fixes: int | None = Field(0, ge=0)
    injects: bool = True
    back_within_s: float | None = Field(None, gt=0)
    ends_tracking: bool = False
    reports: tuple[AlertId, ...] = ()
    alerts: tuple[AlertExpectation, ...] = ()
    warns_first: AlertId | None = None
    silent: bool = False
    repeats: int | None = Field(None, ge=1)


class LoopCase(StrictModel):
    """One flight. seconds: length of the recorded part. hover: stay; else the corners are flown in
    AUTO (metres east and north of home, at `height_m`). wind_m_s: from the west. deny: GNSS is
    switched off when it begins. cold: no companion runs until an event starts it. supervised: by
    `companion run --supervised`. gated: injection is opened by the pilot's command (mode ``rc``).
    size_m: of the world. honest: that world as another visit shows it, with the demo's camera and
    the errors drawn for it. ci: flown in every test run on the embedded vehicle. deployment: keys
    that differ from the demo's deployment file; vehicle: parameters likewise (FS_EKF_ACTION 0: no
    landing while the place is searched). zoom_points: the deployment's table of a lens that reports
    its zoom (level, focal length over the model's); none: a lens that says nothing of it.
    """

    name: str
    title: str
    ci: bool = False
    seconds: float = Field(60.0, gt=0, le=600)
    hover: bool = False
    height_m: float = Field(80.0, gt=10, le=300)
    speed_m_s: float = Field(6.0, gt=0, le=25)
    corners_m: tuple[tuple[float, float], ...] = Field(_CORNERS, min_length=1)
    size_m: float = Field(400.0, ge=400, le=4000, multiple_of=400)
    wind_m_s: float = Field(0.0, ge=0, le=15)
    honest: bool = False
    deny: bool = True
    cold: bool = False
    supervised: bool = False
    gated: bool = False
    deployment: dict[str, Any] = Field(default_factory=dict)
    vehicle: dict[str, float] = Field(default_factory=dict)
    wrong: DeploymentErrors = DeploymentErrors()
    zoom_points: tuple[tuple[float, float], ...] = ()
    timeline: tuple[LoopEvent, ...] = ()
    expect: Expectation = Expectation()

    @model_validator(mode="after")
    def _in_order(self) -> LoopCase:
        times = [event.at_s for event in self.timeline]
        if times != sorted(times) or any(t >= self.seconds for t in times):
            raise ValueError("timeline: events must be in order, and before the end")
        return self

    @model_validator(mode="after")
    def _starts_once(self) -> LoopCase:
        if sum(event.start for event in self.timeline) != self.cold:
            raise ValueError("timeline: a cold flight needs exactly one `start`, any other none")
        return self

    @property
    def earns(self) -> bool:
        """Whether the shadow check must pass before GNSS is denied. Otherwise injection is forced:
        for errors that would fail the check, and for a companion that starts later.
        """
        return self.wrong == DeploymentErrors() and not self.cold

    @property
    def is_normal(self) -> bool:
        """Whether no fault is injected, so that each alert is a false one."""
        told = bool(self.zoom_points) and all(e.zoom is not None for e in self.timeline)
        return self.wrong == DeploymentErrors() and (not self.timeline or told) and not self.cold

    @property
    def scenario(self) -> Scenario:
        """The demo scenario of this flight."""
        legs = tuple(
            ScenarioLeg(
                east_m=east, north_m=north, height_m=self.height_m, gimbal_pitch_deg=_PITCH_DEG
            )
            for east, north in self.corners_m
        )
        if self.honest:
            return Scenario(
                takeoff_height_m=self.height_m, deny_after_s=3, speed_m_s=self.speed_m_s,
                legs=legs, cars=3, people=3,
            )  # fmt: skip
        return Scenario(
            takeoff_height_m=self.height_m, deny_after_s=3, speed_m_s=self.speed_m_s, legs=legs,
            cars=3, people=3, camera=_CAMERA, localizer_width=256,
        ).ideal()  # fmt: skip


def load_loop_cases(
    names: Iterable[str] = (), folder: Path = LOOP_SCENARIOS
) -> tuple[LoopCase, ...]:
    """Load all scenarios of a folder, or those named; `ScenarioError` for an invalid file.

    ``normal`` names all flights in which nothing is wrong.
    """
    files = {path.stem: path for path in sorted(folder.glob("*.yaml"))}
    if not files:
        raise ScenarioError(f"{folder}: holds no flights (NAME.yaml)")
    cases = {name: _load(path) for name, path in files.items()}
    groups = {"normal": tuple(name for name, case in cases.items() if case.is_normal)}
    chosen = list(names) or list(files)
    unknown = [name for name in chosen if name not in cases and name not in groups]
    if unknown:
        raise ScenarioError(f"no {', '.join(unknown)} in {folder}; there are: {', '.join(files)}")
    wanted = [single for name in chosen for single in groups.get(name, (name,))]
    return tuple(cases[name] for name in dict.fromkeys(wanted))


def _load(path: Path) -> LoopCase:
    try:
        return validated(LoopCase, {"name": path.stem, **read_settings(path, ScenarioError)})
    except SettingsError as error:
        raise ScenarioError(f"{path}:\n{error}") from error
