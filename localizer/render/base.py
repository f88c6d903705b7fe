"""The renderer, as far as its backends have it in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from localizer.errors import CameraError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.map.cache.tile import TileMesh
from localizer.types import RenderedView

NEAR_M = 0.5  # nearer surfaces are cut off: no aircraft's camera is that close to its map
FAR_M = 200_000.0  # OpenGL needs an end; nothing is seen that far
SKY = (176, 196, 216)


class TileProvider(Protocol):
    """Source of a renderer's tiles: a `TileStreamer`, or `StaticTiles`."""

    def select(
        self, world_from_camera: Pose, camera: Camera, *, wait: bool = False
    ) -> Sequence[TileMesh]:
        """Meshes to draw for a view. wait: block until all tiles in view are in memory."""
        ...

    def prefetch(self, views: Sequence[Pose], camera: Camera) -> None:
        """Load the tiles of future views (world_from_camera), in order."""
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
        seen = are_visible(*self._spheres, world_from_camera, camera)
        return [mesh for mesh, is_seen in zip(self.meshes, seen, strict=True) if is_seen]

    def prefetch(self, views: Sequence[Pose], camera: Camera) -> None:
        """See `TileProvider.prefetch`: nothing to do."""

    @cached_property
    def _spheres(self) -> tuple[Array, Array]:
        return bounding_spheres(self.meshes)


class MapRenderer(ABC):
    """Renders a map's RGB and depth: gets a view's tiles from a provider and draws them. One thread
    renders at a time.
    """

    name: str

    def __init__(self, streamer: TileProvider) -> None:
        self.streamer = streamer

    def render(
        self,
        world_from_camera: Pose,
        camera: Camera,
        extra: Sequence[TileMesh] = (),
        *,
        wait: bool = False,
    ) -> RenderedView:
        """The view of an ideal pinhole `camera`; `CameraError` for a distorted one.

        extra: meshes to draw besides the map (moving objects). wait: block until all wanted detail
        is in memory; otherwise what is in memory is drawn, and missing tiles are loaded for later
        views. The returned arrays belong to the caller.
        """
        require_pinhole(camera)
        meshes = list(self.streamer.select(world_from_camera, camera, wait=wait))
        if extra:
            seen = are_visible(*bounding_spheres(extra), world_from_camera, camera)
            meshes += [mesh for mesh, is_seen in zip(extra, seen, strict=True) if is_seen]
        return self.draw(meshes, world_from_camera, camera)

    @abstractmethod
    def draw(
        self, meshes: Sequence[TileMesh], world_from_camera: Pose, camera: Camera
    ) -> RenderedView:
        """Draw exactly these meshes, also those out of view. camera: an ideal pinhole; only
        `render` checks that.
        """

    def prefetch(self, views: Sequence[Pose], camera: Camera) -> None:
        """Load the tiles of future views (world_from_camera); returns at once."""
        self.streamer.prefetch(views, camera)

    def warm_up(self) -> None:
        """Compile what rendering needs, so that the first view is not delayed. numba: seconds the
        first time, then cached on disk.
        """
        corners = np.array([[-1, -1, 2], [1, -1, 2], [0, 1, 0.1]], np.float32)
        white = np.full((8, 8, 3), 255, np.uint8)
        faces = np.array([[0, 1, 2]], np.int32)
        uvs = np.zeros((3, 2), np.float32)
        mesh = TileMesh(corners, uvs, faces, (white,), Pose.identity())
        self.draw([mesh], Pose.identity(), Camera.from_fov(16, 16, 90.0))

    @abstractmethod
    def close(self) -> None:
        """Release threads and devices, but not the streamer."""


def require_pinhole(camera: Camera) -> None:
    """`CameraError` if the camera has distortion, which renderers do not support."""
    if camera.is_distorted:
        raise CameraError(
            "the renderer takes an ideal pinhole camera; use camera.without_distortion() and "
            "undistort the image instead"
        )


def bounding_spheres(meshes: Sequence[TileMesh]) -> tuple[Array, Array]:
    """World centres (N, 3) and radii (N,) of spheres around meshes."""
    centres, radii = np.empty((len(meshes), 3)), np.empty(len(meshes))
    for i, mesh in enumerate(meshes):
        low, high = mesh.bounds
        centres[i] = mesh.world_from_tile.apply(0.5 * (low + high))
        radii[i] = 0.5 * np.linalg.norm(high - low)
    return centres, radii


def are_visible(
    centres: Array, radii: Array, world_from_camera: Pose, camera: Camera
) -> NDArray[np.bool_]:
    """Mask (N,) of the spheres (see `bounding_spheres`) that are in view. centres: (N, 3) world,
    radii: (N,), both m.
    """
    x, y, z = world_from_camera.inverse.apply(centres).T
    seen = z >= NEAR_M - radii
    for offset, focal, near_edge, far_edge in (
        (x, camera.fx, -camera.cx, camera.width - camera.cx),
        (y, camera.fy, -camera.cy, camera.height - camera.cy),
    ):
        for edge, sign in ((near_edge, 1.0), (far_edge, -1.0)):
            slope = edge / focal
            seen &= sign * (offset - slope * z) >= -radii * np.hypot(1.0, slope)
    return np.asarray(seen)


def clip_from_camera(camera: Camera) -> Array:
    """Projection (4, 4) from OpenCV camera axes to OpenGL clip coordinates.

    Image row 0 is the framebuffer's row 0, which is read first, so that the image need not be
    flipped.
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
