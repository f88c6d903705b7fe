"""Scenario file of a flight with the complete companion: faults in time, and expectations."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pydantic import Field, model_validator

from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.config import StrictModel
from sitl.camera.faults import PictureFault, PictureFaultKind
from sitl.camera.zoom import MOST as ZOOM_MOST
from sitl.demo.scenario import CameraSpec, Scenario, ScenarioLeg
from sitl.suite.case import Ramp, load_all, require_known
from sitl.suite.checks import AlertExpectation

LOOP_SCENARIOS = Path(__file__).parents[2] / "scenarios" / "loop"

# Light, because it flies in real time on what may be two cores.
_CAMERA = CameraSpec(width=480, height=360, rate_hz=8)
_CORNERS = ((0, 60), (60, 60), (60, -60), (-60, -60), (-60, 60), (0, 0))  # east, north; metres
_PITCH_DEG = -80.0


class VideoFault(StrictModel):
    """A fault of the camera's video that lasts for_s; kinds: see `PictureFault`."""

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
    """A position hint of uncertainty radius_m, off_north_m north of the true position."""

    radius_m: float = Field(gt=0, le=5000)
    off_north_m: float = Field(0.0, ge=-2000, le=2000)


class LoopEvent(Ramp):
    """A fault or command, at_s seconds after the start of the recorded part (where GNSS is switched
    off).

    picture: a fault of the video. zoom: a change of the focal length. load: CPU load. hint: a
    position hint. kill: SIGKILL to the companion; the supervisor starts it again, or the flight
    does restart_after_s later. hang: SIGSTOP to the flight process. start: start the companion (for
    `cold`). vehicle: parameters that the ground station sets.
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
    """Errors of the deployment file or the map, present from the start.

    map_shift_m: offset of the companion's map from the world (east, north, up). gimbal_deg: roll,
    pitch, yaw that the gimbal does not report. focal: the file's focal length over the true one.
    other_map: the companion's map is of another generated world. map_reach_m: the map ends at this
    distance from home, east, west, north and south. terrain_off_m: the companion also has a terrain
    model with a height every 30 m, all too high by this; None: no terrain model.
    """

    map_shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gimbal_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    focal: float = Field(1.0, gt=0.5, lt=2.0)
    other_map: bool = False
    map_reach_m: float | None = Field(None, ge=200, multiple_of=200)
    terrain_off_m: float | None = Field(None, ge=-100, le=100)


class Expectation(StrictModel):
    """Limits and alerts to check over the recorded part.

    told_within_s: longest time with an EKF error above `beyond_m` and neither a health worse than
    ok nor an active finding of the monitor. never_modes: flight modes that the vehicle must not
    enter. max_error_m: of the EKF. false_fixes: allowed number of injected positions with an error
    above 5 m; None: any. injects: at least one position is injected. back_within_s: time from a
    kill or hang to the next injected position. ends_tracking: the last health is ok. reports:
    alerts that the companion must raise at any time; alerts: alerts that it must or must not raise
    within a span. warns_first: an alert that it must raise before DEGRADED, BRIDGING or LOST.
    silent: no warning, no finding, and a health that is always ok. repeats: how often the companion
    may raise one alert.
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
    """One flight. seconds: length of the recorded part. hover: the vehicle stays above home;
    otherwise it flies the corners in AUTO (metres east and north of home, at `height_m`). wind_m_s:
    from the west.

    deny: GNSS is switched off at the start of the recorded part. cold: no companion runs until an
    event starts it. supervised: `companion run --supervised`. gated: bridge mode ``rc``, where the
    pilot's command opens injection. size_m: side of the world. honest: the world has changed since
    the survey, and camera and map have drawn errors, as in the demo. ci: whether every test run
    flies it on the embedded vehicle.

    deployment: keys that differ from the demo's deployment file. vehicle: parameters likewise
    (FS_EKF_ACTION 0: no landing during relocalization). zoom_points: the deployment's zoom table
    (level, focal length over the model's) of a lens that reports its zoom; empty: the lens does not
    report it.
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
    def needs_shadow_check(self) -> bool:
        """Whether injection waits for a passed shadow check before GNSS is switched off. Otherwise
        injection is forced: with deployment errors, which would fail the check, and for a companion
        that starts later.
        """
        return self.wrong == DeploymentErrors() and not self.cold

    @property
    def is_normal(self) -> bool:
        """Whether no fault is injected (a reported zoom is none): each alert is a false one."""
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
    """Load all scenarios of a folder, or those named. The name ``normal`` stands for all flights
    without a fault. Raises `ScenarioError` for an invalid file or an unknown name.
    """
    cases = load_all(folder, LoopCase)
    groups = {"normal": tuple(name for name, case in cases.items() if case.is_normal)}
    chosen = list(names) or list(cases)
    require_known(chosen, [*cases, *groups], folder)
    wanted = [single for name in chosen for single in groups.get(name, (name,))]
    return tuple(cases[name] for name in dict.fromkeys(wanted))
