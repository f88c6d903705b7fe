"""One flight with the whole companion in the loop, with its faults, and the record of it."""

from __future__ import annotations

import json
import math
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml

from localizer.map.cache.cache import TileCache
from mavlink_bridge.link.tlog import read_tlog
from sitl.camera.gimbal_error import GimbalError
from sitl.camera.pose_sender import truth_feed
from sitl.camera.process import WorldCameraProcess
from sitl.camera.traffic import traffic
from sitl.demo.assets import FlightAssets
from sitl.demo.companion_process import Ports, free_udp_port, running_companion, write_deployment
from sitl.demo.flight import FilmedFlight, camera_config, home_of, vehicle_parameters
from sitl.demo.script import FlightError, mission
from sitl.ground.pilot import Pilot
from sitl.suite.loop.case import LoopCase, LoopEvent
from sitl.suite.loop.judge import LoopRecord, LoopSample, LoopText
from sitl.vehicles.launch import VISION_SOURCE, open_vehicle
from sitl.vehicles.process import VehicleKind, VehicleProcess

_STEP_S = 0.25
_START_S = 300.0  # of the companion: its first start on a machine compiles
_TRACKING_S = 90.0
_FRESH_S = 2.0  # a health report that is written every second


@dataclass(frozen=True)
class LoopAssets:
    """The world that is flown, and another place's map."""

    world: FlightAssets
    other: FlightAssets | None = None


def fly(case: LoopCase, assets: LoopAssets, kind: VehicleKind, seed: int, out: Path) -> LoopRecord:
    """Fly a case; `out` receives the records. SimulationError when it could not be flown at all."""
    out.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        flight = _LoopFlight(case, assets, kind, seed, out, stack)
        flight.prepare()
        flight.run()
    return flight.record()


class _LoopFlight:
    """The running of one case; everything it opens is closed by `stack`.

    Above 200 lines: the steps of a flight, read from top to bottom, share all that is open.
    """

    def __init__(
        self, case: LoopCase, assets: LoopAssets, kind: VehicleKind, seed: int, out: Path,
        stack: ExitStack,
    ) -> None:  # fmt: skip
        self._case, self._assets, self._kind = case, assets, kind
        self._seed, self._out, self._stack = seed, out, stack
        self._home = home_of(assets.world)
        self._samples: list[LoopSample] = []
        self._waiting = list(case.timeline)
        self._due: list[tuple[float, Callable[[], None]]] = []
        self._starts = 0
        self._tlog = out.resolve() / "flight.tlog"
        self._start_ns = 0

    def prepare(self) -> None:
        """From power on to a companion that tracks at the flight's height."""
        case = self._case
        self._ports = Ports(free_udp_port(), free_udp_port())
        vehicle = self._open_vehicle()
        self._pilot = self._stack.enter_context(Pilot(vehicle.gcs_endpoint, alive=vehicle.check))
        with self._pilot.fast_forward():
            self._pilot.wait_ready()
        self._config = self._write_deployment(vehicle)
        self._open_camera()
        self._start_companion()
        pilot = self._pilot
        if not case.hover:
            pilot.missions.upload(mission(case.scenario, self._home))
        pilot.point_gimbal(case.scenario.legs[0].gimbal_pitch_deg, 0.0)
        pilot.set_mode("GUIDED")
        pilot.arm()
        pilot.takeoff(case.height_m)
        if not case.wrong.other_map:
            pilot.link.wait(self._is_tracking, _TRACKING_S, "the localizer to track")
        if case.wind_m_s:
            pilot.link.set_parameter("SIM_WIND_DIR", 270.0)
            pilot.link.set_parameter("SIM_WIND_SPD", case.wind_m_s)
            pilot.link.sleep(8.0)

    def run(self) -> None:
        """The recorded part: faults, samples, until the time is over."""
        if self._case.deny:
            self._pilot.use_source_set(VISION_SOURCE)
            self._pilot.gps(False)
        if not self._case.hover:
            self._pilot.start_mission()
        self._start_ns = time.monotonic_ns()
        while self._now_s < self._case.seconds:
            while self._waiting and self._waiting[0].at_s <= self._now_s:
                self._happen(self._waiting.pop(0))
            while self._due and self._due[0][0] <= self._now_s:
                self._due.pop(0)[1]()
            self._sample()
            self._pilot.link.sleep(_STEP_S)
        self._end_ns = time.monotonic_ns()
        self._camera.stop()

    def record(self) -> LoopRecord:
        """Everything that the judge needs, after the processes have ended."""
        texts = tuple(
            LoopText((t.time_ns - self._start_ns) * 1e-9, t.component, t.severity, t.text)
            for t in self._pilot.record.texts
            if t.time_ns >= self._start_ns
        )
        return LoopRecord(tuple(self._samples), texts, tuple(self._fix_errors()))

    # --- before ----------------------------------------------------------------------------------

    def _open_vehicle(self) -> VehicleProcess:
        log = self._out / "vehicle.log"
        parameters = vehicle_parameters(self._case.scenario) | self._case.vehicle
        vehicle = open_vehicle(self._kind, self._home, 0.0, parameters, seed=self._seed, log=log)
        return self._stack.enter_context(vehicle)

    def _write_deployment(self, vehicle: VehicleProcess) -> Path:
        """The demo's deployment file, with what this case has wrong or different."""
        case, assets = self._case, self._assets
        flown = assets.world
        if case.wrong.other_map:
            if assets.other is None:
                raise FlightError(f"{case.name}: needs the map of another place, which is not here")
            flown = replace(flown, map_cache=assets.other.map_cache)
        path = write_deployment(self._out, flown, case.scenario, vehicle, self._ports)
        settings = yaml.safe_load(path.read_text(encoding="utf-8"))
        for axis in ("fx", "fy"):
            settings["camera"]["model"][axis] *= case.wrong.focal
        settings["record"]["snapshot_interval_s"] = 5.0
        settings["bridge"]["tlog"] = str(self._tlog)
        path.write_text(yaml.safe_dump(_merged(settings, case.deployment), sort_keys=False))
        return path

    def _open_camera(self) -> None:
        case, world = self._case, self._assets.world
        cache = TileCache.open(world.map_cache)
        movers = traffic(
            world.world, cache.frame, cars=3, people=3, seed=self._seed,
            epoch_ns=time.monotonic_ns(),
        )  # fmt: skip
        filmed = FilmedFlight(world, case.scenario, self._ports, self._seed, movers)
        config = camera_config(filmed, self._out)
        self._camera = WorldCameraProcess(config)
        self._stack.enter_context(self._camera)
        fault = np.radians(case.wrong.gimbal_deg)
        gimbal = GimbalError(self._seed, (float(fault[0]), float(fault[1]), float(fault[2])))
        shift = case.wrong.map_shift_m
        self._stack.enter_context(truth_feed(self._pilot, self._camera, cache, gimbal, shift))

    def _start_companion(self) -> None:
        self._run_companion()
        started = time.monotonic()
        while self._health()[2] > _FRESH_S:
            self._require_companion()
            if time.monotonic() - started > _START_S:
                raise FlightError(
                    f"the companion is not up after {_START_S:.0f} s: see {self._out}"
                )
            time.sleep(0.2)

    def _run_companion(self) -> None:
        folder = self._out / f"log-{self._starts}"
        folder.mkdir()
        self._starts += 1
        self._companion = self._stack.enter_context(running_companion(self._config, folder))

    # --- during ----------------------------------------------------------------------------------

    @property
    def _now_s(self) -> float:
        return (time.monotonic_ns() - self._start_ns) * 1e-9

    def _happen(self, event: LoopEvent) -> None:
        for name, value in event.vehicle.items():
            self._pilot.link.set_parameter(name, value)
        if event.picture is not None:
            self._camera.fault(event.picture.fault)
            self._later(event.picture.for_s, lambda: self._camera.fault(None))
        if event.kill:
            self._companion.send_signal(signal.SIGKILL)
            self._companion.wait()
            self._later(event.restart_after_s, self._run_companion)

    def _later(self, seconds: float, do: Callable[[], None]) -> None:
        """Have something done by the flight's own loop, so many seconds from now."""
        self._due.append((self._now_s + seconds, do))
        self._due.sort(key=lambda item: item[0])

    def _sample(self) -> None:
        pilot = self._pilot
        level, text, age_s = self._health()
        error_m, north_m, east_m = self._ekf_error()
        self._samples.append(
            LoopSample(
                self._now_s, error_m, north_m, east_m, pilot.record.mode or "", level, text, age_s
            )
        )

    def _ekf_error(self) -> tuple[float, float, float]:
        """Horizontal error of the EKF's position now, and where the vehicle truly is."""
        north, east, _ = self._home.ned_of(self._pilot.record.truth.location)
        ekf = self._pilot.record.ekf
        truth = self._pilot.record.truth_at(ekf.time_ns) if ekf is not None else None
        if ekf is None or ekf.location is None or truth is None:
            return math.inf, north, east
        true = self._home.ned_of(truth.location)
        seen = self._home.ned_of(ekf.location)
        return math.hypot(seen[0] - true[0], seen[1] - true[1]), north, east

    def _health(self) -> tuple[str, str, float]:
        """(level, text, age in s) of the companion's newest report; infinite age without one."""
        try:
            reports = self._out.glob("companion*/health.json")
            newest = max(reports, key=lambda path: path.stat().st_mtime)
            report = json.loads(newest.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return "starting", "", math.inf
        age_s = (time.monotonic_ns() - int(report["time_ns"])) * 1e-9
        return str(report["level"]), str(report["text"]), age_s

    def _is_tracking(self) -> bool:
        self._require_companion()
        level, text, _ = self._health()
        return level == "ok" and text.startswith("localization tracking")

    def _require_companion(self) -> None:
        code = self._companion.poll()
        if code is not None:
            raise FlightError(f"the companion ended with code {code}: see {self._out}")

    # --- after -----------------------------------------------------------------------------------

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
