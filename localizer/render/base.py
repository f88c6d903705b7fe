"""The renderer protocol and what its backends share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from localizer.camera import Camera
from localizer.errors import CameraError
from localizer.map.tile import TileMesh
from localizer.pose import Array, Pose
from localizer.types import RenderedView

NEAR_M = 0.5  # nearer surfaces are cut off: no aircraft's camera is that close to its map
FAR_M = 200_000.0  # OpenGL needs an end; nothing is seen that far
SKY = (176, 196, 216)


class TileProvider(Protocol):
    """Where a renderer gets its tiles: a `TileStreamer`, or `StaticTiles`."""

    def select(
        self, world_from_camera: Pose, camera: Camera, *, wait: bool = False
    ) -> Sequence[TileMesh]:
        """Meshes to draw for a view."""
        ...


@dataclass(frozen=True)
class StaticTiles:
    """Always the same meshes, for scenes that fit into memory."""

    meshes: Sequence[TileMesh]

    def select(
        self, world_from_camera: Pose, camera: Camera, *, wait: bool = False
    ) -> Sequence[TileMesh]:
        """See `TileProvider.select`."""
        del wait  # everything is there
        return [m for m in self.meshes if is_visible(m, world_from_camera, camera)]


class MapRenderer(Protocol):
    """Renders a map's RGB and depth. One thread renders at a time."""

    name: str

    def render(
        self,
        world_from_camera: Pose,
        camera: Camera,
        extra: Sequence[TileMesh] = (),
        *,
        wait: bool = False,
    ) -> RenderedView:
        """The view of an ideal pinhole `camera`.

        extra: meshes to draw besides the map (moving objects). wait: block until all wanted detail
        is in memory. The returned arrays belong to the caller.
        """
        ...

    def close(self) -> None:
        """Release threads and devices."""
        ...


def require_pinhole(camera: Camera) -> None:
    """Renderers draw straight lines straight: distortion is the caller's (`undistortion_maps`)."""
    if camera.is_distorted:
        raise CameraError(
            "the renderer takes an ideal pinhole camera; use camera.without_distortion() and "
            "undistort the image instead"
        )


def is_visible(mesh: TileMesh, world_from_camera: Pose, camera: Camera) -> bool:
    """Whether the mesh's bounding sphere meets the view."""
    low, high = mesh.bounds
    radius = 0.5 * float(np.linalg.norm(high - low))
    centre = mesh.world_from_tile.apply(0.5 * (low + high))
    x, y, z = world_from_camera.inverse.apply(centre)
    if z < NEAR_M - radius:
        return False
    for offset, focal, near_edge, far_edge in (
        (x, camera.fx, -camera.cx, camera.width - camera.cx),
        (y, camera.fy, -camera.cy, camera.height - camera.cy),
    ):
        for edge, sign in ((near_edge, 1.0), (far_edge, -1.0)):
            slope = edge / focal
            if sign * (offset - slope * z) < -radius * np.hypot(1.0, slope):
                return False
    return True


def clip_from_camera(camera: Camera) -> Array:
    """OpenGL clip coordinates (4, 4) of OpenCV camera axes.

    Image row 0 becomes the framebuffer's row 0, which is read first: nothing is flipped afterwards.
    """
    w, h = camera.width, camera.height
    depth = FAR_M - NEAR_M
    return np.array(
        [
            [2 * camera.fx / w, 0, 2 * camera.cx / w - 1, 0],
            [0, 2 * camera.fy / h, 2 * camera.cy / h - 1, 0],
            [0, 0, (FAR_M + NEAR_M) / depth, -2 * FAR_M * NEAR_M / depth],
            [0, 0, 1, 0],
        ]
    )
