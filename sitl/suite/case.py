"""Scenario file of the suite: injection, faults in time, expectations."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import Field, model_validator

from companion.integrity_monitor.config import IntegrityMonitorConfig
from companion.settings_file import SettingsError, read_settings, validated
from mavlink_bridge import BridgeConfig
from mavlink_bridge.config import StrictModel
from sitl.demo.scenario import ScenarioError
from sitl.suite.checks import Check
from sitl.suite.simulated_localizer import FixModel
from sitl.vehicles.launch import (
    GPS_OFF,
    SPEEDS,
    gps_input_only_parameters,
    vision_only_parameters,
    vision_parameters,
)

_STEP_S = 0.4


class Ramp(StrictModel):
    """Base of a scenario's events. ramp: parameters that go linearly from one value to another in
    over_s. scattered: parameters of the ramp that are drawn at each step, uniform within plus or
    minus the value that is due.
    """

    ramp: dict[str, tuple[float, float]] = Field(default_factory=dict)
    over_s: float = Field(0.0, ge=0, le=600)
    scattered: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _belongs_together(self) -> Ramp:
        if not set(self.scattered) <= set(self.ramp) or bool(self.ramp) != (self.over_s > 0):
            raise ValueError("over_s belongs to a ramp, and `scattered` names parameters of it")
        return self

    def values(self, share: float, rng: np.random.Generator) -> dict[str, float]:
        """The parameters at a share (0 to 1) of over_s."""
        due = {name: first + share * (last - first) for name, (first, last) in self.ramp.items()}
        return {
            name: value * float(rng.uniform(-1, 1)) if name in self.scattered else value
            for name, value in due.items()
        }


class RunningRamp:
    """The running ramp; a new one replaces it. seed: of the scattered values."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._ramp, self._begun_s, self._due_s = Ramp(), 0.0, math.inf

    def begin(self, event: Ramp, now_s: float) -> None:
        """Begin the event's ramp; an event without a ramp changes nothing."""
        if event.ramp:
            self._ramp, self._begun_s, self._due_s = event, now_s, now_s

    def due(self, now_s: float) -> dict[str, float]:
        """Parameters to set now; empty between the steps."""
        if now_s < self._due_s:
            return {}
        share = min((now_s - self._begun_s) / self._ramp.over_s, 1.0)
        self._due_s = self._due_s + _STEP_S if share < 1.0 else math.inf
        return self._ramp.values(share, self._rng)


SCENARIOS = Path(__file__).parents[1] / "scenarios"
AnyCase = TypeVar("AnyCase", bound=StrictModel)


class VehicleSpec(StrictModel):
    """Parameters of the vehicle: a named set and changes to it.

    vision: EK3_SRC1 on external navigation, no receiver. gnss_then_vision: a receiver in source
    set 1, vision in set 2. gps_input: GPS_INPUT is the only receiver. px4, px4_with_gnss: PX4's
    defaults, without and with a receiver; embedded vehicle only.
    origin_north_m: None leaves the EKF origin to the injector; a number sets it before, this far
    north of home.
    """

    sources: Literal["vision", "gnss_then_vision", "gps_input", "px4", "px4_with_gnss"]
    parameters: dict[str, float] = Field(default_factory=dict)
    origin_north_m: float | None = None

    @property
    def receiver(self) -> bool:
        """Whether the simulated GNSS receiver is on at the start."""
        return self.sources in ("gnss_then_vision", "px4_with_gnss")

    @property
    def px4(self) -> bool:
        """Whether the vehicle behaves as PX4 (modes, parameters, messages), not as ArduPilot."""
        return self.sources.startswith("px4")

    def all_parameters(self) -> dict[str, float]:
        """Values of all parameters that differ from the firmware's defaults: the named set, the
        speeds, and `parameters`, which win.
        """
        named = {
            "vision": vision_only_parameters,
            "gnss_then_vision": vision_parameters,
            "gps_input": gps_input_only_parameters,
        }
        off = {} if self.receiver else GPS_OFF
        own = {} if self.px4 else named[self.sources]()
        return {**own, **SPEEDS, **off, **self.parameters}


class Flight(StrictModel):
    """Flight path: a square of side_m (0: hover). seconds None: until the square is closed.

    ground: never arms; `seconds` are spent on the ground.
    """

    side_m: float = Field(200.0, ge=0, le=1000)
    height_m: float = Field(60.0, ge=5, le=200)
    seconds: float | None = Field(None, gt=0, le=300)
    ground: bool = False

    @model_validator(mode="after")
    def _ends(self) -> Flight:
        if self.seconds is None and (self.ground or self.side_m == 0):
            raise ValueError("a hover, or a case on the ground, needs `seconds`")
        return self


class CaseEvent(Ramp):
    """A fault or command, at_s seconds after the take-off height is reached.

    fixes: fields of `Case.fixes` that change. reset: the next fix increments the reset counter, as
    after an announced jump. vehicle: parameters that the ground station sets. source_set: EKF
    source set that the ground station orders; None: no order. reboot: the autopilot reboots.
    """

    at_s: float = Field(ge=0)
    fixes: dict[str, Any] = Field(default_factory=dict)
    reset: bool = False
    vehicle: dict[str, float] = Field(default_factory=dict)
    source_set: int | None = Field(None, ge=1, le=3)
    reboot: bool = False

    @model_validator(mode="after")
    def _does_something(self) -> CaseEvent:
        if not (self.fixes or self.vehicle or self.ramp or self.source_set or self.reboot):
            raise ValueError("nothing happens: give fixes, vehicle, ramp, source_set or reboot")
        return self


class GroundSetup(StrictModel):
    """Steps before take-off. doctor: run `companion doctor --fix`, which corrects wrong parameters.
    reboot: reboot the autopilot after injection has begun.
    """

    doctor: bool = False
    reboot: bool = False


class Case(StrictModel):
    """One scenario. bridge: the bridge's configuration without `connection`. integrity_monitor: the
    monitor that checks the fixes before the bridge gets them.

    ci: whether every test run flies it on the embedded vehicle.
    """

    name: str
    title: str
    ci: bool = False
    vehicle: VehicleSpec
    fixes: FixModel = FixModel()
    bridge: dict[str, Any]
    integrity_monitor: IntegrityMonitorConfig = IntegrityMonitorConfig()
    flight: Flight = Flight()
    before: GroundSetup = GroundSetup()
    timeline: tuple[CaseEvent, ...] = ()
    expect: tuple[Annotated[Check, Field(discriminator="check")], ...] = Field(min_length=1)

    @property
    def is_honest(self) -> bool:
        """Whether the monitor runs without an injected fault: each of its alerts is false."""
        f = self.fixes
        wrong = f.rotation_deg or f.yaw_error_deg or f.offset_north_m or f.silent or f.frozen
        watched = self.integrity_monitor.enabled and not self.flight.ground
        return watched and not wrong and not self.timeline

    @model_validator(mode="after")
    def _is_whole(self) -> Case:
        BridgeConfig.model_validate(self.bridge)
        if list(self.timeline) != sorted(self.timeline, key=lambda e: e.at_s):
            raise ValueError("timeline: events must be in the order of at_s")
        ends_s = self.flight.seconds
        if ends_s is not None and any(event.at_s >= ends_s for event in self.timeline):
            raise ValueError(f"timeline: an event comes after the flight's end at {ends_s:g} s")
        for event in self.timeline:
            self.changed(self.fixes, event)
        return self

    @staticmethod
    def changed(model: FixModel, event: CaseEvent) -> FixModel:
        """The fixes after an event."""
        return FixModel.model_validate({**model.model_dump(), **event.fixes})


def load_case(path: Path, model: type[AnyCase]) -> AnyCase:
    """Read a scenario file; ScenarioError names the file and every problem in it."""
    data = read_settings(path, ScenarioError)
    if "name" in data:
        raise ScenarioError(f"{path}: name: a scenario is named by its file, leave it out")
    try:
        return validated(model, {"name": path.stem, **data})
    except SettingsError as error:
        raise ScenarioError(f"{path}:\n{error}") from error


def load_all(folder: Path, model: type[AnyCase]) -> dict[str, AnyCase]:
    """All scenarios of a folder by name; `ScenarioError` without any."""
    files = sorted(folder.glob("*.yaml"))
    if not files:
        raise ScenarioError(f"{folder}: holds no scenario files (NAME.yaml)")
    return {path.stem: load_case(path, model) for path in files}


def require_known(names: Iterable[str], known: Iterable[str], folder: Path) -> None:
    """`ScenarioError` for names that are not there."""
    known = list(known)
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ScenarioError(
            f"no scenario {', '.join(unknown)} in {folder}; there are: {', '.join(known)}"
        )


def load_cases(names: Iterable[str] = (), folder: Path = SCENARIOS) -> tuple[Case, ...]:
    """All scenarios of a folder, or those named; ScenarioError for a name that is not there."""
    cases, names = load_all(folder, Case), list(names)
    require_known(names, cases, folder)
    return tuple(cases[name] for name in names or cases)
