"""The demo flight: every process started, the mission flown on vision alone, records kept.

Four processes, as on a real aircraft and its surroundings: the vehicle, the world camera, the
companion (`companion run`), and this one, which plays the ground station. They share only MAVLink,
the video stream, and detections.
"""

from __future__ import annotations

import csv
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from companion.geometry import GimbalAngles, GimbalFrame
from localizer.map.cache import TileCache
from localizer.synth.appearance import sample_appearance
from sitl.assets import FlightAssets
from sitl.camera_process import CameraStatistics, WorldCameraConfig, WorldCameraProcess
from sitl.detector import Observed
from sitl.embedded.geodesy import Location
from sitl.errors import SimulationError
from sitl.gimbal_error import GimbalError
from sitl.mission_steps import MissionStep, gimbal_step, speed_step, waypoint_step
from sitl.moving import Mover
from sitl.pilot import Pilot
from sitl.process import VehicleProcess
from sitl.scenario import Scenario, VehicleKind
from sitl.targets import observed_targets
from sitl.traffic import traffic
from sitl.truth import TruthSample
from sitl.vehicles import (
    GIMBAL,
    SPEEDS,
    VISION_SOURCE,
    gps_input_parameters,
    open_vehicle,
    vision_parameters,
)

_TRUTH_PERIOD_S = 0.02
_TRACKING_TIMEOUT_S = 60.0
_LEG_MARGIN_S = 60.0
_COMPANION_START_S = 300.0
_COMPANION_STOP_S = 20.0

Progress = Callable[[str, float], None]


class FlightError(SimulationError):
    """A flight that could not be flown to its end; says which part failed and where its log is."""


@dataclass(frozen=True)
class FlightRecord:
    """What a flight left behind. denied_ns: from GNSS off to the end of the mission."""

    folder: Path
    vehicle: str
    denied_ns: tuple[int, int]
    camera: CameraStatistics
    home_error_m: float
    targets: tuple[Observed, ...]
    texts: tuple[str, ...]


@dataclass(frozen=True)
class _Ports:
    video: int
    detections: int


def fly(
    assets: FlightAssets,
    scenario: Scenario,
    kind: VehicleKind,
    seed: int,
    folder: Path,
    progress: Progress = lambda *_: None,
) -> FlightRecord:
    """Fly the scenario; `folder` receives every record. Progress is (phase, share done)."""
    folder.mkdir(parents=True, exist_ok=True)
    cache = TileCache.open(assets.map_cache)
    home = _home(assets)
    ports = _Ports(_free_udp_port(), _free_udp_port())
    with ExitStack() as stack:
        progress("starting the vehicle", 0.0)
        vehicle = stack.enter_context(
            open_vehicle(kind, home, 0.0, _parameters(scenario), seed=seed)
        )
        pilot = stack.enter_context(Pilot(vehicle.gcs_endpoint, alive=vehicle.check))
        progress("waiting for GNSS and the EKF", 0.0)
        with pilot.fast_forward():
            pilot.wait_ready()
        movers = traffic(
            assets.world, cache.frame, cars=scenario.cars, people=scenario.people, seed=seed,
            epoch_ns=time.monotonic_ns(),
        )  # fmt: skip
        targets = observed_targets(assets, scenario, movers)
        config = _write_companion_config(folder, assets, scenario, vehicle, ports)
        progress("starting the world camera", 0.0)
        camera = WorldCameraProcess(
            _camera_config(folder, assets, scenario, movers, targets, ports, seed)
        )
        stack.enter_context(camera)
        stack.enter_context(_truth_feed(pilot, camera, cache, GimbalError(seed)))
        companion = stack.enter_context(_companion(config, folder))
        run = _Run(pilot, scenario, home, folder, companion, progress)
        denied_ns = run.fly()
        home_error_m = run.distance_from_home()
        camera.stop()
        texts = tuple(t.text for t in pilot.texts)
        _write_vehicle_csv(folder / "vehicle.csv", pilot, cache)
    if camera.statistics is None:
        raise FlightError("the world camera left no statistics")
    return FlightRecord(
        folder,
        vehicle.kind,
        denied_ns,
        camera.statistics,
        home_error_m,
        targets,
        texts,
    )


class _Run:
    """The ground station's script, from arming to the return."""

    def __init__(
        self,
        pilot: Pilot,
        scenario: Scenario,
        home: Location,
        folder: Path,
        companion: subprocess.Popen[bytes],
        progress: Progress,
    ) -> None:
        self._pilot = pilot
        self._scenario = scenario
        self._home = home
        self._folder = folder
        self._companion = companion
        self._progress = progress

    def fly(self) -> tuple[int, int]:
        """Returns the span without GNSS, CLOCK_MONOTONIC ns."""
        pilot, scenario = self._pilot, self._scenario
        self._progress("starting the companion", 0.0)
        self._await_companion()
        steps = mission(scenario, self._home)
        pilot.upload_mission(steps)
        pilot.point_gimbal(scenario.legs[0].gimbal_pitch_deg, 0.0)
        self._progress("taking off on GNSS", 0.05)
        pilot.set_mode("GUIDED")
        pilot.arm()
        pilot.takeoff(scenario.takeoff_height_m)
        at_height_s = pilot.time_s
        self._progress("waiting for the localizer to track", 0.15)
        pilot.wait(self._tracking, _TRACKING_TIMEOUT_S, "the localizer to track")
        pilot.sleep(max(0.0, scenario.deny_after_s - (pilot.time_s - at_height_s)))
        self._require_companion()
        self._deny()
        begin_ns = time.monotonic_ns()
        pilot.start_mission()
        self._follow(len(steps))
        return begin_ns, time.monotonic_ns()

    def distance_from_home(self) -> float:
        """How far, horizontally and in truth, the vehicle is from where it took off."""
        north, east, _ = self._home.ned_of(self._pilot.truth.location)
        return float(np.hypot(north, east))

    def _deny(self) -> None:
        if self._scenario.injection != "gps_input":  # that is a second receiver of the same set
            self._pilot.use_source_set(VISION_SOURCE)
        self._pilot.gps(False)

    def _follow(self, last_item: int) -> None:
        """Wait for the mission's last item, watching the companion."""
        legs = self._scenario.legs
        length = _mission_length(self._scenario)
        limit = length / self._scenario.speed_m_s * 1.5 + _LEG_MARGIN_S
        started = self._pilot.time_s
        while last_item not in self._pilot.reached:
            self._require_companion()
            if self._pilot.mode != "AUTO":
                raise FlightError(
                    f"the vehicle left AUTO for {self._pilot.mode}: "
                    + "; ".join(t.text for t in self._pilot.texts[-4:])
                )
            elapsed = self._pilot.time_s - started
            if elapsed > limit:
                raise FlightError(f"the mission took longer than {limit:.0f} s")
            share = min(0.2 + 0.8 * elapsed * self._scenario.speed_m_s / length / 1.15, 0.99)
            done = sum(1 for item in self._pilot.reached if item > 1)
            self._progress(f"GNSS denied: waypoint {min(done + 1, len(legs))}/{len(legs)}", share)
            self._pilot.sleep(0.5)
        self._progress("returned on vision alone", 1.0)

    def _await_companion(self) -> None:
        """On the ground: its first start on a machine compiles for a minute or more."""
        started = time.monotonic()
        while self._health() is None:
            self._require_companion()
            if time.monotonic() - started > _COMPANION_START_S:
                raise FlightError(
                    f"the companion is not up after {_COMPANION_START_S:.0f} s; "
                    f"{self._folder / 'companion.log'}"
                )
            self._progress("starting the companion", 0.0)
            time.sleep(0.2)

    def _tracking(self) -> bool:
        self._require_companion()
        health = self._health()
        return health is not None and health["text"] == "localization tracking"

    def _health(self) -> dict[str, Any] | None:
        """What the companion says of itself; None while it is not up."""
        try:
            health = json.loads((self._folder / "companion" / "health.json").read_text())
        except (OSError, ValueError):
            return None
        return dict(health)

    def _require_companion(self) -> None:
        code = self._companion.poll()
        if code is not None:
            log = self._folder / "companion.log"
            tail = log.read_text(errors="replace")[-1500:]
            raise FlightError(f"the companion ended with code {code}; {log}:\n{tail}")


def mission(scenario: Scenario, home: Location) -> list[MissionStep]:
    """The legs as mission items: a gimbal command and a waypoint each."""
    steps = [speed_step(scenario.speed_m_s)]
    for leg in scenario.legs:
        place = home.offset(leg.north_m, leg.east_m, 0.0)
        steps.append(gimbal_step(leg.gimbal_pitch_deg, 0.0))
        steps.append(waypoint_step(place.latitude_deg, place.longitude_deg, leg.height_m))
    return steps


def _mission_length(scenario: Scenario) -> float:
    corners = np.array([(0.0, 0.0)] + [(leg.east_m, leg.north_m) for leg in scenario.legs])
    return float(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum())


def _home(assets: FlightAssets) -> Location:
    """The world's centre, on the ground, AMSL."""
    world = assets.world
    position = world.frame.position([0.0, 0.0, float(world.ground_height(0.0, 0.0))])
    altitude = position.height_m - world.geoid_separation_m
    return Location(position.latitude_deg, position.longitude_deg, altitude)


def _parameters(scenario: Scenario) -> dict[str, float]:
    delay_ms = scenario.injection_delay_ms
    if scenario.injection == "gps_input":
        injection = gps_input_parameters(delay_ms=delay_ms)
    else:
        injection = vision_parameters(delay_ms=delay_ms)
    return injection | GIMBAL | SPEEDS | {"WPNAV_SPEED": 100 * scenario.speed_m_s}


def _free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _camera_config(
    folder: Path,
    assets: FlightAssets,
    scenario: Scenario,
    movers: tuple[Mover, ...],
    targets: tuple[Observed, ...],
    ports: _Ports,
    seed: int,
) -> WorldCameraConfig:
    return WorldCameraConfig(
        cache=assets.live_cache,
        origin=TileCache.open(assets.map_cache).manifest.origin,
        camera=scenario.camera.camera(),
        url=f"udp://127.0.0.1:{ports.video}",
        log=folder / "frames.csv",
        rate_hz=scenario.camera.rate_hz,
        appearance=sample_appearance(np.random.default_rng([seed, 11]), scenario.condition),
        movers=movers,
        seed=seed,
        targets=targets,
        detections=f"127.0.0.1:{ports.detections}",
    )


def _write_companion_config(
    folder: Path,
    assets: FlightAssets,
    scenario: Scenario,
    vehicle: VehicleProcess,
    ports: _Ports,
) -> Path:
    """The deployment file of this flight: what an operator would write by hand."""
    camera = scenario.camera.camera()
    config = {
        "map": str(assets.map_cache.resolve()),
        "camera": {
            "source": f"udp://127.0.0.1:{ports.video}",
            "model": camera.to_dict(),
        },
        "localizer": {"width": scenario.localizer_width},
        "bridge": {
            "connection": vehicle.companion_endpoint,
            "mode": "inject",
            "injection": {
                "message": scenario.injection,
                "delay_ms": scenario.injection_delay_ms,
                "gps_id": 1,
            },
        },
        "targets": {"detections": f"127.0.0.1:{ports.detections}"},
        "record": {"folder": str((folder / "companion").resolve())},
    }
    path = folder / "companion.yaml"
    path.write_text(yaml.safe_dump(config, sort_keys=False))
    return path


@contextmanager
def _companion(config: Path, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """``companion run`` as a process; interrupted, as an operator would, at the end."""
    environment = os.environ | {"PYTHONUNBUFFERED": "1", "COLUMNS": "160"}
    with (folder / "companion.log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "companion", "run", str(config.resolve())],
            stdout=log, stderr=subprocess.STDOUT, env=environment,
            cwd=Path(__file__).resolve().parent.parent,
        )  # fmt: skip
        try:
            yield process
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
            try:
                process.wait(_COMPANION_STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


@contextmanager
def _truth_feed(
    pilot: Pilot, camera: WorldCameraProcess, cache: TileCache, gimbal_error: GimbalError
) -> Iterator[None]:
    """Tells the world camera where the vehicle is, 50 times a second, on a thread."""
    stop = threading.Event()

    def feed() -> None:
        last_ns = 0
        while not stop.wait(_TRUTH_PERIOD_S):
            sample = _truth_sample(pilot, cache)
            if sample is not None and sample.time_ns > last_ns:
                last_ns = sample.time_ns
                angles = gimbal_error.true_angles(sample.gimbal, last_ns)
                sample = replace(sample, gimbal=angles)
                try:
                    camera.send(sample)
                except SimulationError:
                    return  # the flight script sees the dead camera by its missing statistics

    thread = threading.Thread(target=feed, name="truth")
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def _truth_sample(pilot: Pilot, cache: TileCache) -> TruthSample | None:
    """The newest instant at which both the vehicle and its gimbal (as it reports) are known."""
    newest = pilot.newest_common_ns()
    truth = pilot.truth_at(newest) if newest else None
    gimbal = pilot.gimbal_at(newest) if newest else None
    if truth is None or gimbal is None:
        return None
    roll, pitch, yaw = gimbal.roll_pitch_yaw
    frame = GimbalFrame.HEADING if gimbal.yaw_in_vehicle_frame else GimbalFrame.EARTH
    angles = GimbalAngles(roll, pitch, yaw, frame)
    return TruthSample(truth.time_ns, _enu(truth.location, cache), truth.quaternion, angles)


def _enu(place: Location, cache: TileCache) -> Any:
    height = place.altitude_m + cache.manifest.geoid_separation_m
    return cache.frame.enu_from_geodetic(place.latitude_deg, place.longitude_deg, height)


def _write_vehicle_csv(path: Path, pilot: Pilot, cache: TileCache) -> None:
    """True and EKF positions in the map's ENU, at the EKF's times."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        names = ("east_m", "north_m", "up_m")
        writer.writerow(("time_ns", *names, *(f"ekf_{n}" for n in names)))
        for sample, true in pilot.ekf_pairs():
            if sample.location is not None:
                values = (*_enu(true, cache), *_enu(sample.location, cache))
                writer.writerow((sample.time_ns, *(f"{v:.4f}" for v in values)))
