"""Flies a scenario's path without dynamics, and writes it as an evaluation sequence."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from localizer.geometry.camera import Camera
from localizer.geometry.geo import LocalFrame, level_camera
from localizer.geometry.pose import Pose
from localizer.geometry.trajectory import PoseRow, pose_row, write_poses
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.pictures import write_rgb
from localizer.render.numba_raster import NumbaRenderer
from localizer.synth.appearance.model import sample_appearance
from sitl.camera.movers import traffic
from sitl.camera.true_motion import PoseTrack
from sitl.camera.world_camera import CameraOptions, WorldCamera
from sitl.demo.assets import FlightAssets
from sitl.demo.scenario import Scenario, draw_errors

_JPEG_QUALITY = 92


def record_sequence(
    camera: WorldCamera,
    track: PoseTrack,
    times_ns: Iterable[int],
    frame: LocalFrame,
    out: Path,
    calibrated: Camera | None = None,
    stamped: Callable[[int], int] = lambda time_ns: time_ns,
) -> int:
    """Render frames at the given times and write them with their true poses; returns their number.

    Times outside the track are left out. calibrated: camera model to write, if it differs from the
    true one. frame: ENU frame of the track. stamped: gives the timestamp of a true time, which is
    written to ``images/timestamps.txt``.
    """
    images = out / "images"
    images.mkdir(parents=True, exist_ok=True)
    rows: list[PoseRow] = []
    stamps: list[str] = []
    for time_ns in times_ns:
        exposure = camera.expose(time_ns, track)
        if exposure is None:
            continue
        name = f"{len(rows):06d}.jpg"
        write_rgb(images / name, exposure.image, _JPEG_QUALITY)
        rows.append(pose_row(name, exposure.world_from_camera, frame))
        stamps.append(f"{name} {stamped(time_ns)}\n")
    write_poses(out / "poses.txt", rows)
    (images / "timestamps.txt").write_text("".join(stamps), encoding="utf-8")
    told = (calibrated or camera.camera).to_dict()
    (out / "camera.json").write_text(json.dumps(told, indent=2) + "\n")
    return len(rows)


_STEP_S = 0.02
_YAW_RATE = np.radians(45.0)  # per second, a multirotor's at a waypoint
_PITCH_RATE = np.radians(20.0)
_ACCELERATION = 2.5  # m/s²


def camera_path(scenario: Scenario, ground_m: float) -> Iterator[tuple[int, Pose]]:
    """Yield camera poses (time ns, world_from_camera in ENU) every 20 ms along the scenario's legs.
    The path stops and turns at each corner.

    ground_m: ENU height of the ground at home.
    """
    position = np.array([0.0, 0.0, ground_m + scenario.takeoff_height_m])
    first = scenario.legs[0]
    yaw = float(np.arctan2(first.east_m, first.north_m))
    pitch = np.radians(first.gimbal_pitch_deg)
    speed, time_s = 0.0, 1.0
    for leg in scenario.legs:
        goal = np.array([leg.east_m, leg.north_m, ground_m + leg.height_m])
        heading = float(np.arctan2(*(goal - position)[:2]))
        while np.linalg.norm(goal - position) > 0.05:
            yaw = _towards(yaw, heading, _YAW_RATE * _STEP_S)
            pitch = _towards(pitch, np.radians(leg.gimbal_pitch_deg), _PITCH_RATE * _STEP_S)
            away = float(np.linalg.norm(goal - position))
            limit = min(scenario.speed_m_s, np.sqrt(2 * _ACCELERATION * away))
            speed = min(speed + _ACCELERATION * _STEP_S, limit)
            position = position + (goal - position) / away * min(speed * _STEP_S, away)
            yield round(time_s * 1e9), level_camera(position, yaw, pitch)
            time_s += _STEP_S


def record_scenario(assets: FlightAssets, scenario: Scenario, seed: int, out: Path) -> int:
    """Render the scenario's path as an evaluation sequence; returns the number of frames."""
    cache, live = TileCache.open(assets.map_cache), TileCache.open(assets.live_cache)
    map_from_world = cache.frame.ecef_from_enu.inverse @ assets.world.frame.ecef_from_enu
    ground_m = float(assets.world.ground_height(0.0, 0.0))
    path = [(time_ns, map_from_world @ p) for time_ns, p in camera_path(scenario, ground_m)]
    track = PoseTrack(path, keep=None)
    movers = traffic(
        assets.world, cache.frame, cars=scenario.cars, people=scenario.people, seed=seed
    )
    errors = draw_errors(scenario, seed)
    streamer = TileStreamer(live)
    try:
        camera = WorldCamera(
            NumbaRenderer(streamer),
            errors.camera,
            sample_appearance(np.random.default_rng([seed, 11]), scenario.condition),
            CameraOptions(
                movers,
                live.frame.ecef_from_enu.inverse @ cache.frame.ecef_from_enu,
                seed=seed,
                realism=errors.realism,
            ),
        )
        period_ns = round(1e9 / scenario.camera.rate_hz)
        times = range(path[0][0] + period_ns, path[-1][0] - period_ns, period_ns)
        calibrated = scenario.camera.camera()
        return record_sequence(camera, track, times, cache.frame, out, calibrated)
    finally:
        streamer.close()


def _towards(value: float, goal: float, step: float) -> float:
    """`value` moved to `goal` by at most `step`, the short way round (rad)."""
    error = float(np.remainder(goal - value + np.pi, 2 * np.pi) - np.pi)
    return value + float(np.clip(error, -step, step))
