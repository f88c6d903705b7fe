"""Runs the demo flight: starts all processes, flies the mission without GNSS, keeps the records.

Four processes, as on a real aircraft: vehicle, world camera, companion (`companion run`), and this
one as the ground station. They share only MAVLink, the video stream, and detections.
"""

from __future__ import annotations

import csv
import os
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from companion.geometry import Mount
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.map.cache.cache import TileCache
from localizer.map.cache.pick import cast_rays
from localizer.map.cache.stream import TileStreamer
from localizer.map.cache.tile import TileMesh
from localizer.synth.appearance.model import sample_appearance
from sitl.camera.detector import FixedPoint, Observed
from sitl.camera.movers import Mover, traffic
from sitl.camera.pose_sender import GimbalError, map_enu, truth_feed
from sitl.camera.process import CameraStatistics, WorldCameraConfig, WorldCameraProcess
from sitl.demo.assets import FlightAssets
from sitl.demo.companion_process import (
    THIS_PROGRAM,
    FlightCompanion,
    Ports,
    free_udp_port,
    write_deployment,
)
from sitl.demo.kinematic import camera_path
from sitl.demo.scenario import FlightErrors, Scenario, VehicleChoice, draw_errors
from sitl.demo.script import FlightScript, Progress
from sitl.errors import FlightError, SimulationError
from sitl.geodesy import Location
from sitl.ground.pilot import Pilot
from sitl.vehicles.launch import (
    GIMBAL,
    SPEEDS,
    VehicleSetup,
    gps_input_parameters,
    open_vehicle,
    vision_parameters,
)

FIXED_POINTS = 3
_PATH_STEP = 100  # samples of 20 ms between candidates
_PATCH_M = 0.8  # around a point the surface must be one plane: an edge is no target to aim at
_FLATNESS_M = 0.1


def observed_targets(
    assets: FlightAssets, scenario: Scenario, movers: tuple[Mover, ...]
) -> tuple[Observed, ...]:
    """Named fixed points on flat surfaces along the path, and all cars; map ENU."""
    cars = tuple(m for m in movers if m.name.startswith("car"))
    return (*_fixed_points(assets, scenario), *cars)


def _fixed_points(assets: FlightAssets, scenario: Scenario) -> tuple[FixedPoint, ...]:
    """The flattest point on the camera's axis in each third of the path."""
    cache, live = TileCache.open(assets.map_cache), TileCache.open(assets.live_cache)
    live_from_map = live.frame.ecef_from_enu.inverse @ cache.frame.ecef_from_enu
    ground_m = float(assets.world.ground_height(0.0, 0.0))
    map_from_world = cache.frame.ecef_from_enu.inverse @ assets.world.frame.ecef_from_enu
    path = [map_from_world @ pose for _, pose in camera_path(scenario, ground_m)][::_PATH_STEP]
    camera = scenario.camera.camera().without_distortion()
    streamer = TileStreamer(live)
    try:
        points = []
        for number, part in enumerate(np.array_split(np.arange(len(path)), FIXED_POINTS)):
            poses = [live_from_map @ path[i] for i in part]
            found = [_flat_point(streamer, pose, camera) for pose in poses]
            flat = [f for f in found if f is not None]
            if not flat:
                continue  # trees all the way, say
            _, point = min(flat, key=lambda f: f[0])
            name = f"point {'ABC'[number]}"
            points.append(FixedPoint(name, live_from_map.inverse.apply(point)))
        return tuple(points)
    finally:
        streamer.close()


def _flat_point(streamer: TileStreamer, pose: Pose, camera: Camera) -> tuple[float, Array] | None:
    """Where the camera's axis meets the world: (roughness in m, point (3,)); None if it misses the
    world or the surface there is not flat.
    """
    meshes = streamer.select(pose, camera, wait=True)
    centre = _hit(meshes, pose, np.array([0.0, 0.0, 1.0]))
    if centre is None:
        return None
    spread = _PATCH_M / float(np.linalg.norm(centre - pose.translation))
    around = [
        _hit(meshes, pose, np.array([spread * np.cos(a), spread * np.sin(a), 1.0]))
        for a in np.linspace(0, 2 * np.pi, 8, endpoint=False)
    ]
    if any(p is None for p in around):
        return None
    patch = np.array([centre, *around])
    roughness = float(np.linalg.svd(patch - patch.mean(axis=0))[1][2])
    return (roughness, centre) if roughness < _FLATNESS_M else None


def _hit(meshes: list[TileMesh], pose: Pose, ray: Array) -> Array | None:
    direction = pose.rotation @ ray
    distance = float(cast_rays(meshes, pose.translation, direction)[0])
    return pose.translation + direction * distance if np.isfinite(distance) else None


@dataclass(frozen=True)
class DemoRecord:
    """Records of a flight. denied_ns: span from GNSS off to the end of the mission, or to the
    abort. home_error_m: true distance from home at the end. errors: the drawn calibration and map
    errors. gimbal_alignment_deg: roll, pitch, yaw that the gimbal does not report. broken: why the
    flight was aborted; None otherwise. load: mean load of the computer in the last minute.
    """

    folder: Path
    vehicle: str
    denied_ns: tuple[int, int]
    camera: CameraStatistics
    home_error_m: float
    targets: tuple[Observed, ...]
    texts: tuple[str, ...]
    errors: FlightErrors
    gimbal_alignment_deg: tuple[float, float, float]
    broken: str | None = None
    load: float = 0.0


@dataclass(frozen=True)
class FlightObservers:
    """Callbacks that report a flight's progress. progress: gets (phase, share done).
    on_connectable: gets the address for a ground station ("tcp:HOST:PORT"). console: port of the
    console; None: no console. on_console: gets the console's address when the console accepts
    connections.
    """

    progress: Progress = lambda _phase, _share: None
    on_connectable: Callable[[str], None] = lambda _endpoint: None
    console: int | None = None
    on_console: Callable[[str], None] = lambda _address: None


def fly(
    assets: FlightAssets,
    scenario: Scenario,
    kind: VehicleChoice,
    seed: int,
    folder: Path,
    observers: FlightObservers | None = None,
    program: Sequence[str] = THIS_PROGRAM,
) -> DemoRecord:
    """Fly a scenario, which may switch GNSS off. `folder` receives all records, also those of an
    aborted flight, whose cause is in `DemoRecord.broken`. `SimulationError` if the vehicle, camera
    or companion cannot be started, or the camera leaves no statistics.

    program: command line that starts the companion. observers: None: nothing is reported.
    """
    observers = observers or FlightObservers()
    progress = observers.progress
    folder.mkdir(parents=True, exist_ok=True)
    cache = TileCache.open(assets.map_cache)
    home = home_of(assets)
    ports = Ports(free_udp_port(), free_udp_port(), observers.console)
    with ExitStack() as stack:
        progress("starting the vehicle", 0.0)
        setup = VehicleSetup(
            parameters=vehicle_parameters(scenario), seed=seed, log=folder / "vehicle.log"
        )
        vehicle = stack.enter_context(open_vehicle(kind, home, setup))
        observers.on_connectable(vehicle.spare_endpoint)
        pilot = stack.enter_context(Pilot(vehicle.gcs_endpoint, alive=vehicle.check))
        progress("waiting for GNSS and the EKF", 0.0)
        with pilot.fast_forward():
            pilot.wait_ready()
        movers = traffic(
            assets.world, cache.frame, cars=scenario.cars, people=scenario.people, seed=seed,
            epoch_ns=time.monotonic_ns(),
        )  # fmt: skip
        targets = observed_targets(assets, scenario, movers)
        config = write_deployment(folder, assets, scenario, vehicle, ports)
        progress("starting the world camera", 0.0)
        errors, gimbal_error = draw_errors(scenario, seed), GimbalError(seed)
        filmed = camera_config(assets, scenario, ports, seed, folder, movers, targets)
        camera = WorldCameraProcess(filmed)
        stack.enter_context(camera)
        stack.enter_context(truth_feed(pilot, camera, cache, gimbal_error, errors.map_shift_m))
        progress("starting the companion", 0.0)
        begun_ns, broken = time.monotonic_ns(), None
        companion = FlightCompanion(config, folder, stack, program=program)
        companion.start()
        if ports.console is not None and companion.serves(ports.console):
            observers.on_console(f"http://127.0.0.1:{ports.console}/")
        run = FlightScript(pilot, scenario, home, companion, progress)
        try:
            denied_ns = run.fly()
        except SimulationError as error:
            broken = str(error)
            denied_ns = run.denied_ns or begun_ns, time.monotonic_ns()
            progress("the flight broke off", 1.0)
        load = os.getloadavg()[0]
        home_error_m = run.distance_from_home()
        camera.stop()
        texts = tuple(t.text for t in pilot.record.texts)
        write_vehicle_csv(folder / "vehicle.csv", pilot, cache)
    if camera.statistics is None:
        raise FlightError("the world camera left no statistics")
    return DemoRecord(
        folder,
        vehicle.kind,
        denied_ns,
        camera.statistics,
        home_error_m,
        targets,
        texts,
        errors,
        gimbal_error.alignment_deg,
        broken,
        load,
    )


def home_of(assets: FlightAssets) -> Location:
    """Home position: the centre of the world on the ground, altitude AMSL."""
    world = assets.world
    position = world.frame.position([0.0, 0.0, float(world.ground_height(0.0, 0.0))])
    altitude = position.height_m - world.geoid_separation_m
    return Location(position.latitude_deg, position.longitude_deg, altitude)


def vehicle_parameters(scenario: Scenario) -> dict[str, float]:
    """Autopilot parameters for the injection message of the scenario."""
    delay_ms = scenario.injection_delay_ms
    if scenario.injection == "gps_input":
        injection = gps_input_parameters(delay_ms=delay_ms)
    else:
        injection = vision_parameters(delay_ms=delay_ms)
    return injection | GIMBAL | SPEEDS | {"WPNAV_SPEED": 100 * scenario.speed_m_s}


def camera_config(
    assets: FlightAssets, scenario: Scenario, ports: Ports, seed: int, folder: Path,
    movers: tuple[Mover, ...] = (), targets: tuple[Observed, ...] = (),
) -> WorldCameraConfig:  # fmt: skip
    """Configuration of a flight's world camera; true poses go to ``frames.csv`` in `folder`.
    targets: the objects that the simulated detector reports.
    """
    look, errors = np.random.default_rng([seed, 11]), draw_errors(scenario, seed)
    return WorldCameraConfig(
        cache=assets.live_cache,
        origin=TileCache.open(assets.map_cache).manifest.origin,
        camera=errors.camera,
        url=f"udp://127.0.0.1:{ports.video}",
        log=folder / "frames.csv",
        rate_hz=scenario.camera.rate_hz,
        appearance=sample_appearance(look, scenario.condition),
        movers=movers,
        mount=Mount.from_degrees(lever_arm_m=errors.lever_arm_m),
        seed=seed,
        bit_rate=1000 * scenario.camera.bit_rate_kbps,
        realism=errors.realism,
        detector_errors=errors.detector,
        targets=targets,
        detections=f"127.0.0.1:{ports.detections}",
    )


def write_vehicle_csv(path: Path, pilot: Pilot, cache: TileCache) -> None:
    """Write true and EKF positions in the map's ENU (m) at the EKF's times, CLOCK_MONOTONIC (ns).
    Truth and EKF are matched by the vehicle's own boot time.
    """
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        names = ("east_m", "north_m", "up_m")
        writer.writerow(("time_ns", *names, *(f"ekf_{n}" for n in names)))
        for sample, true in pilot.record.ekf_pairs():
            if sample.location is not None:
                values = (*map_enu(true, cache), *map_enu(sample.location, cache))
                writer.writerow((sample.time_ns, *(f"{v:.4f}" for v in values)))
