"""Targets of the demo flight: three fixed points on its path, and every moving car."""

from __future__ import annotations

import numpy as np

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.map.cache.cache import TileCache
from localizer.map.cache.pick import cast_rays
from localizer.map.cache.stream import TileStreamer
from localizer.map.cache.tile import TileMesh
from sitl.camera.detector import FixedPoint, Observed
from sitl.camera.movers import Mover
from sitl.demo.assets import FlightAssets
from sitl.demo.kinematic import camera_path
from sitl.demo.scenario import Scenario

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
