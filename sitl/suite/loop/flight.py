"""Flies one scenario with the complete companion, its faults, and its record."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import yaml
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.offline.record import read_estimates
from localizer.map.cache.cache import TileCache
from mavlink_bridge.link.tlog import read_tlog
from sitl.camera.movers import Mover, traffic
from sitl.camera.pose_sender import GimbalError, truth_feed
from sitl.camera.process import WorldCameraProcess
from sitl.camera.zoom import ReportingCamera, Zooming
from sitl.demo.assets import FlightAssets
from sitl.demo.companion_process import (
    FlightCompanion,
    Health,
    Ports,
    free_udp_port,
    write_deployment,
)
from sitl.demo.flight import camera_config, home_of, vehicle_parameters
from sitl.demo.script import mission
from sitl.ground.pilot import Pilot
from sitl.ground.vehicle_record import VEHICLE
from sitl.suite.case import RunningRamp
from sitl.suite.flight import longest_stall, slowest_pace
from sitl.suite.loop.case import DeploymentErrors, LoopCase, LoopEvent, OperatorHint, Zoom
from sitl.suite.loop.disturbances import CpuLoad
from sitl.suite.loop.evaluation import LoopRecord, LoopSample, RestartTimes, standing_alerts
from sitl.suite.loop.inner_map import terrain_file
from sitl.suite.record import Text
from sitl.vehicles.launch import VISION_SOURCE, VehicleSetup, open_vehicle
from sitl.vehicles.process import VehicleKind, VehicleProcess

_STEP_S = 0.25
_TRACKING_S, _WRONG_S, _GO_S = 90.0, 15.0, 40.0
_LOCALIZER = 197  # component
_POSITION_FRESH_S = 1.0  # LOCAL_POSITION_NED comes 25 times a second, while there is a position


@dataclass(frozen=True)
class LoopAssets:
    """The world of a flight. wrong_map: another map's cache for the companion; None: its own."""

    world: FlightAssets
    wrong_map: Path | None = None


class FlightParticipant(Protocol):
    """Code that takes part in a flight, for example a simulated operator or pilot."""

    def movers(self, epoch_ns: int) -> tuple[Mover, ...]:
        """Additional moving objects in the world; epoch_ns: CLOCK_MONOTONIC."""
        ...

    def take_part(
        self, vehicle: VehicleProcess, pilot: Pilot, frames: Path
    ) -> AbstractContextManager[None]:
        """Context manager around the recorded part: entered at its start, left at its end. frames:
        the world camera's log.
        """
        ...


def fly(
    case: LoopCase, assets: LoopAssets, kind: VehicleKind, seed: int, out: Path,
    participant: FlightParticipant | None = None,
) -> LoopRecord:  # fmt: skip
    """Fly a case; `out` receives the logs. seed: of world, light and errors. participant: None:
    nobody takes part. `SimulationError` if it could not be flown.
    """
    out.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        flight = _LoopFlight(case, assets, kind, seed, out, stack, participant)
        flight.prepare()
        flight.run()
    return flight.record()


class _LoopFlight:
    """The running of one case; everything it opens is closed by `stack`.

    Above 200 lines: the steps of a flight, read from top to bottom, share all that is open.
    """

    def __init__(
        self, case: LoopCase, assets: LoopAssets, kind: VehicleKind, seed: int, out: Path,
        stack: ExitStack, participant: FlightParticipant | None = None,
    ) -> None:  # fmt: skip
        self._case, self._assets, self._kind = case, assets, kind
        self._participant = participant
        self._seed, self._out, self._stack = seed, out, stack
        self._home = home_of(assets.world)
        self._samples: list[LoopSample] = []
        self._waiting = list(case.timeline)
        self._due: list[tuple[float, Callable[[], None]]] = []
        self._ramp = RunningRamp(seed)
        self._reporting: ReportingCamera | None = None
        self._zooming = Zooming(1.0, 1.0, 0, 0)
        self._ticks: list[tuple[float, float]] = []
        self._tlog = out.resolve() / "flight.tlog"
        self._start_ns = 0
        self._ended_ns: int | None = None
        self._shadow: Health | None = None

    def prepare(self) -> None:
        """Start all processes and take off; returns when the companion tracks at height."""
        case = self._case
        self._ports = Ports(free_udp_port(), free_udp_port())
        vehicle = self._vehicle = self._open_vehicle()
        self._pilot = self._stack.enter_context(Pilot(vehicle.gcs_endpoint, alive=vehicle.check))
        with self._pilot.fast_forward():
            self._pilot.wait_ready()
        config = self._write_deployment(vehicle)
        self._companion = FlightCompanion(
            config, self._out, self._stack, supervised=case.supervised
        )
        if not case.cold:
            self._companion.start()  # a processor for each while both load their programs
        self._open_camera()
        if case.zoom_points:
            camera = ReportingCamera(vehicle.spare_endpoint)
            self._reporting = self._stack.enter_context(camera)
        if not case.cold:
            self._companion.wait_up()
        pilot = self._pilot
        if not case.hover:
            pilot.missions.upload(mission(case.scenario, self._home))
        pilot.point_gimbal(case.scenario.legs[0].gimbal_pitch_deg, 0.0)
        pilot.set_mode("GUIDED")
        pilot.arm()
        pilot.takeoff(case.height_m)
        self._wait_tracking()
        if case.wind_m_s:
            pilot.link.set_parameter("SIM_WIND_DIR", 270.0)
            pilot.link.set_parameter("SIM_WIND_SPD", case.wind_m_s)
            pilot.link.sleep(8.0)
        if case.needs_shadow_check:
            pilot.link.wait_wall(self._has_go, _GO_S)
            self._shadow = self._companion.health()
        if case.gated:
            self._open_gate()

    def _wait_tracking(self) -> None:
        """Wait for a health that is ok; where something is wrong it may never be, or say why."""
        case, link = self._case, self._pilot.link
        if case.wrong == DeploymentErrors() and not case.cold:
            link.wait(self._is_tracking, _TRACKING_S, "the localizer to track")
        elif not case.wrong.other_map and not case.cold:
            link.wait_wall(self._is_tracking, _WRONG_S)

    def run(self) -> None:
        """Fly the recorded part: inject the faults and take samples until its time is over."""
        if self._case.deny:
            self._pilot.use_source_set(VISION_SOURCE)
            self._pilot.switch_gnss(False)
        if not self._case.hover:
            self._pilot.start_mission()
        self._start_ns = time.monotonic_ns()
        with self._riding():
            while self._now_s < self._case.seconds:
                while self._waiting and self._waiting[0].at_s <= self._now_s:
                    self._happen(self._waiting.pop(0))
                while self._due and self._due[0][0] <= self._now_s:
                    self._due.pop(0)[1]()
                for name, value in self._ramp.due(self._now_s).items():
                    self._pilot.link.set_parameter(name, value)
                self._sample()
                self._pilot.link.sleep(_STEP_S)
        self._end_ns = time.monotonic_ns()
        self._camera.stop()

    def record(self) -> LoopRecord:
        """The data for the expectations; call it after the processes have ended."""
        texts = [
            Text((t.time_ns - self._start_ns) * 1e-9, t.component, t.severity, t.text)
            for t in self._pilot.record.texts
            if t.time_ns <= self._end_ns
        ]
        before = [t for t in texts if t.at_s < 0.0]
        return LoopRecord(
            self._with_errors(),
            tuple(t for t in texts if t.at_s >= 0.0),
            tuple(self._fix_errors()),
            slowest_pace(self._ticks),
            longest_stall(self._ticks),
            self._back(),
            self._shadow,
            standing_alerts(before) if self._case.wrong != DeploymentErrors() else (),
        )

    # --- before ----------------------------------------------------------------------------------

    def _open_vehicle(self) -> VehicleProcess:
        log = self._out / "vehicle.log"
        parameters = vehicle_parameters(self._case.scenario) | self._case.vehicle
        setup = VehicleSetup(parameters=parameters, seed=self._seed, log=log)
        vehicle = open_vehicle(self._kind, self._home, setup)
        return self._stack.enter_context(vehicle)

    def _write_deployment(self, vehicle: VehicleProcess) -> Path:
        """The demo's deployment file, with what this case has wrong or different."""
        case, assets = self._case, self._assets
        flown = assets.world
        if assets.wrong_map is not None:
            flown = replace(flown, map_cache=assets.wrong_map)
        path = write_deployment(self._out, flown, case.scenario, vehicle, self._ports)
        settings = yaml.safe_load(path.read_text(encoding="utf-8"))
        for axis in ("fx", "fy"):
            settings["camera"]["model"][axis] *= case.wrong.focal
        settings["bridge"]["mode"] = "rc" if case.gated else settings["bridge"]["mode"]
        settings["bridge"]["injection"]["force"] = not case.needs_shadow_check and not case.cold
        if case.wrong.terrain_off_m is not None:
            terrain = terrain_file(flown.world, self._out / "terrain.tif", case.wrong.terrain_off_m)
            settings["localizer"].setdefault("odometry", {})["terrain"] = str(terrain)
        if case.zoom_points:
            settings["camera"]["zoom"] = {"points": [list(point) for point in case.zoom_points]}
        settings["record"]["snapshot_interval_s"] = 5.0
        settings["bridge"]["tlog"] = str(self._tlog)
        path.write_text(yaml.safe_dump(_merged(settings, case.deployment), sort_keys=False))
        return path

    def _open_camera(self) -> None:
        case, world = self._case, self._assets.world
        cache = TileCache.open(world.map_cache)
        epoch_ns = time.monotonic_ns()
        movers = traffic(
            world.world, cache.frame, cars=3, people=3, seed=self._seed, epoch_ns=epoch_ns
        )
        if self._participant is not None:
            movers += self._participant.movers(epoch_ns)
        config = camera_config(world, case.scenario, self._ports, self._seed, self._out, movers)
        self._camera = WorldCameraProcess(config)
        self._stack.enter_context(self._camera)
        fault = np.radians(case.wrong.gimbal_deg)
        gimbal = GimbalError(self._seed, (float(fault[0]), float(fault[1]), float(fault[2])))
        shift = case.wrong.map_shift_m
        self._stack.enter_context(truth_feed(self._pilot, self._camera, cache, gimbal, shift))

    # --- during ----------------------------------------------------------------------------------

    def _riding(self) -> AbstractContextManager[None]:
        if self._participant is None:
            return nullcontext()
        frames = self._out / "frames.csv"
        return self._participant.take_part(self._vehicle, self._pilot, frames)

    @property
    def _now_s(self) -> float:
        return (time.monotonic_ns() - self._start_ns) * 1e-9

    def _happen(self, event: LoopEvent) -> None:
        for name, value in event.vehicle.items():
            self._pilot.link.set_parameter(name, value)
        if event.picture is not None:
            self._camera.send(event.picture.fault)
            self._later(event.picture.for_s, lambda: self._camera.send(None))
        if event.zoom is not None:
            self._zoom_to(event.zoom)
        self._ramp.begin(event, self._now_s)
        if event.load is not None:
            work = CpuLoad(event.load, self._companion)
            self._stack.callback(work.end)
            self._later(event.load.for_s, work.end)
        if event.hint is not None:
            self._tell_place(event.hint)
        if event.start:
            self._companion.start()
        if event.kill or event.hang:
            self._ended_ns = time.monotonic_ns()
        if event.hang:
            self._companion.hang()
        if event.kill:
            self._companion.kill()
        if event.kill and not self._case.supervised:
            self._later(event.restart_after_s, self._companion.start)

    def _open_gate(self) -> None:
        """Send MAV_CMD_USER_1 (inject) to the companion, as the pilot's command would."""
        self._pilot.link.send(
            mavlink.MAVLink_command_long_message(
                VEHICLE, _LOCALIZER, mavlink.MAV_CMD_USER_1, 0, 1.0, *[0.0] * 6
            )
        )
        self._pilot.link.sleep(1.0)

    def _tell_place(self, hint: OperatorHint) -> None:
        place = self._pilot.record.truth.location.offset(hint.off_north_m, 0.0, 0.0)
        self._pilot.link.send(
            mavlink.MAVLink_command_int_message(
                VEHICLE, _LOCALIZER, mavlink.MAV_FRAME_GLOBAL,
                mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE, 0, 0, 0.0, 0.0, hint.radius_m, 0.0,
                round(place.latitude_deg * 1e7), round(place.longitude_deg * 1e7), math.nan,
            )
        )  # fmt: skip

    def _zoom_to(self, zoom: Zoom) -> None:
        """The lens moves, and says so where it is one that does."""
        now_ns = time.monotonic_ns()
        before = self._zooming.at(now_ns)
        end_ns = now_ns + round(zoom.over_s * 1e9)
        self._zooming = Zooming(before, zoom.to, now_ns, end_ns)
        self._camera.send(self._zooming)
        if self._reporting is not None:
            self._reporting.set(self._zooming)

    def _later(self, seconds: float, do: Callable[[], None]) -> None:
        """Let the flight's loop call `do`, so many seconds from now."""
        self._due.append((self._now_s + seconds, do))
        self._due.sort(key=lambda item: item[0])

    def _sample(self) -> None:
        record, health = self._pilot.record, self._companion.health()
        north_m, east_m, _ = self._home.ned_of(record.truth.location)
        self._ticks.append((self._now_s, record.time_s))
        self._samples.append(
            LoopSample(
                self._now_s, math.inf, north_m, east_m, record.mode or "", health.level,
                health.text, health.age_s, health.findings, health.rate_hz,
            )
        )  # fmt: skip

    def _has_go(self) -> bool:
        self._companion.require()
        return self._companion.health().ready

    def _is_tracking(self) -> bool:
        self._companion.require()
        return self._companion.health().is_tracking

    # --- after -----------------------------------------------------------------------------------

    def _with_errors(self) -> tuple[LoopSample, ...]:
        """The samples with the newest EKF position's horizontal error; infinite if too old."""
        pairs = list(self._pilot.record.ekf_pairs())
        times = np.array([(ekf.time_ns - self._start_ns) * 1e-9 for ekf, _ in pairs])
        samples = []
        for sample in self._samples:
            i = int(np.searchsorted(times, sample.at_s, side="right")) - 1
            error_m = math.inf
            if i >= 0 and sample.at_s - times[i] < _POSITION_FRESH_S:
                ekf, true = pairs[i]
                north_m, east_m, _ = true.ned_of(ekf.location) if ekf.location else (math.inf,) * 3
                error_m = math.hypot(north_m, east_m)
            samples.append(replace(sample, error_m=error_m))
        return tuple(samples)

    def _back(self) -> RestartTimes | None:
        """When the companion worked again after kill or hang; None if there was neither."""
        if self._ended_ns is None:
            return None
        ended_ns = self._ended_ns
        utc_ns = time.time_ns() - time.monotonic_ns() + ended_ns
        sent = [
            stamp_ns
            for stamp_ns, message in (read_tlog(self._tlog) if self._tlog.exists() else ())
            if message.get_type() == "VISION_POSITION_ESTIMATE" and stamp_ns > utc_ns
        ]
        known = [
            (e.known_ns, e.accepted, e.is_tracking)
            for path in sorted(self._out.glob("companion*/estimates.csv"))
            for e in read_estimates(path)
            if e.exposure_time_ns > ended_ns
        ]
        return RestartTimes(
            _first_s((t for t, accepted, _ in known if accepted), ended_ns),
            _first_s((t for t, accepted, tracks in known if accepted and tracks), ended_ns),
            _first_s(sent, utc_ns),
        )

    def _fix_errors(self) -> list[float]:
        """Horizontal errors of every position that was injected in the recorded part, metres."""
        origin = self._pilot.record.origin
        if origin is None or not self._tlog.exists():
            return []
        errors = []
        for _, message in read_tlog(self._tlog):
            if message.get_type() != "VISION_POSITION_ESTIMATE":
                continue
            time_ns = message.usec * 1000  # CLOCK_MONOTONIC, of the exposure
            truth = self._pilot.record.truth_at(time_ns)
            if truth is None or not self._start_ns <= time_ns <= self._end_ns:
                continue
            true = origin.ned_of(truth.location)
            errors.append(math.hypot(message.x - true[0], message.y - true[1]))
        return errors


def _first_s(times_ns: Iterable[int], since_ns: int) -> float:
    return (min(times_ns, default=math.inf) - since_ns) * 1e-9


def _merged(base: dict[str, object], over: dict[str, object]) -> dict[str, object]:
    """`over` laid on `base`, mappings inside mappings."""
    merged = dict(base)
    for key, value in over.items():
        below = merged.get(key)
        if isinstance(below, dict) and isinstance(value, dict):
            merged[key] = _merged(below, value)
        else:
            merged[key] = value
    return merged
