"""Where what an operator pointed at truly is: his pixel's ray, cast into today's world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from companion.offline.tables import poses, read_columns
from localizer.geometry.camera import Camera
from localizer.geometry.geo import LocalFrame
from localizer.geometry.pose import Array, Pose
from localizer.map.cache.cache import TileCache
from localizer.map.cache.surface import MapSurface
from sitl.camera.true_motion import PoseTrack
from sitl.demo.assets import FlightAssets
from sitl.operator.operator import SentWish

_NEAR_MOVER_M = 4.0  # half a car's length, and what its box casts over the ground


@dataclass(frozen=True)
class Pointed:
    """What a click pointed at. place: (3,) map ENU, None where the ray meets nothing; pose: the
    camera's, while that row was exposed; pixel: in it; on_mover: something drove or walked there.
    """

    asked: SentWish
    place: Array | None
    pose: Pose
    pixel: tuple[float, float]
    on_mover: bool


class GroundTruth:
    """Knows the true camera, its true way and the world as it is today."""

    def __init__(self, assets: FlightAssets, camera: Camera, frames: Path) -> None:
        self.camera = camera
        columns = read_columns(frames)
        self._track = PoseTrack(keep=None)
        for time_ns, pose in zip(columns["true_time_ns"], poses(columns), strict=True):
            self._track.add(int(time_ns), pose)
        live, known = TileCache.open(assets.live_cache), TileCache.open(assets.map_cache)
        self.frame: LocalFrame = known.frame
        self.geoid_m = known.manifest.geoid_separation_m
        self._live_from_map = live.frame.ecef_from_enu.inverse @ known.frame.ecef_from_enu
        self._surface = MapSurface(live)

    def pointed(self, asked: SentWish) -> Pointed:
        """What one click pointed at."""
        u, v = np.array(asked.wish.middle) * (self.camera.width, self.camera.height)
        pose = self.pose_of_row(asked.frame_ns, float(v))
        place = self._hit(pose, (float(u), float(v)))
        movers = np.array(asked.movers).reshape(-1, 3)
        near = place is not None and len(movers) > 0
        on_mover = near and float(np.linalg.norm(movers - place, axis=1).min()) < _NEAR_MOVER_M
        return Pointed(asked, place, pose, (float(u), float(v)), on_mover)

    def pose_of_row(self, frame_ns: int, v: float) -> Pose:
        """The true pose while a row of a frame was exposed (`frame_ns`: the middle row)."""
        away_ms = (v / self.camera.height - 0.5) * self.camera.readout_ms
        pose = self._track.at(frame_ns + round(away_ms * 1e6)) or self._track.at(frame_ns)
        if pose is None:
            raise ValueError(f"no picture was taken at {frame_ns}")
        return pose

    def place_of(self, latitude_deg: float, longitude_deg: float, altitude_m: float) -> Array:
        """(3,) map ENU of what was told above mean sea level."""
        return self.frame.enu_from_geodetic(latitude_deg, longitude_deg, altitude_m + self.geoid_m)

    def _hit(self, pose: Pose, pixel: tuple[float, float]) -> Array | None:
        ray = pose.rotation @ self.camera.rays(np.array(pixel))
        ray = ray / np.linalg.norm(ray)
        eye = self._live_from_map.apply(pose.translation)
        distance = float(self._surface.cast(eye, (self._live_from_map.rotation @ ray)[None])
                         .distances[0])  # fmt: skip
        return pose.translation + distance * ray if np.isfinite(distance) else None


def all_pointed(witness: GroundTruth, asked: Sequence[SentWish]) -> dict[int, Pointed]:
    """What every accepted click pointed at, by the number that it was given."""
    return {a.number: witness.pointed(a) for a in asked if a.wish.kind != "stop" and a.result == 0}
