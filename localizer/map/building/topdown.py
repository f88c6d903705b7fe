"""Makes coarse levels for sources without any: height fields of their surface, seen from above."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.map.cache.tile import TileMesh
from localizer.map.importers.heightmesh import ERROR_PER_STEP, height_mesh
from localizer.map.source import SourceMesh
from localizer.render.base import StaticTiles
from localizer.render.numba_raster import NumbaRenderer
from localizer.types import Float32, Image

TEXELS = 512  # of a tile's side
CELLS = 128  # of a tile's side
# Cells by which a surface goes on beyond its border: one that the border crosses, and one that
# simplification may take away there. Else cracks are seen between neighbours.
_GROWN = 2
_EYE_M = 50_000.0  # height of the camera: rays all but parallel
_DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # camera axes: x east, y south

Textured = tuple[SourceMesh, tuple[Image, ...]]  # a mesh and its mips


def tile_error_m(size: float) -> float:
    """Geometric error (m) of a tile of `size` metres made by `render_height_field`."""
    return ERROR_PER_STEP * size / CELLS


def render_height_field(
    groups: Iterable[Sequence[Textured]], left: float, top: float, size: float
) -> list[SourceMesh]:
    """Render the meshes of a square (metres, z up) from above as one textured height field; empty
    without a surface there. groups: rendered one after the other to save memory. left, top: western
    and northern edge; size: side.
    """
    step = size / CELLS
    heights = np.full((CELLS + 1, CELLS + 1), -np.inf)
    image = np.zeros((TEXELS, TEXELS, 3), np.uint8)
    surface = np.full((TEXELS, TEXELS), -np.inf)
    for group in groups:
        if not group:
            continue
        # About the square's centre, and a height that keeps float32 small.
        base = float(group[0][0].positions[0, 2])
        centre = np.array([left + size / 2, top - size / 2, base])
        tiles = [t for mesh, mips in group if (t := _placed(mesh, mips, centre, size)) is not None]
        if not tiles:
            continue
        _, depth = _drawn(tiles, CELLS + 1, step)
        heights = np.maximum(heights, _height(depth, base))
        rgb, depth = _drawn(tiles, TEXELS, size / TEXELS)
        z = _height(depth, base)
        higher = z > surface
        image[higher], surface[higher] = rgb[higher], z[higher]
    if not np.isfinite(heights).any():
        return []
    for _ in range(_GROWN):
        heights = _grown(heights)
    image, shown = _grown_picture(image, np.isfinite(surface))
    known = np.isfinite(heights)
    lowest = heights[known].min()
    z = np.ma.masked_array(np.where(known, heights - lowest, 0.0), ~known)
    made = height_mesh(z, shown, (step, step), lossless=False)
    if made is None:
        return []
    local, faces = made
    uvs = (local[:, :2] * (1, -1) / size).astype(np.float32)
    return [SourceMesh(local + np.array([left, top, lowest]), uvs, faces, image)]


def _grown(heights: Array) -> Array:
    """The heights with unknown vertices beside known ones set to the mean of these."""
    known = np.isfinite(heights)
    share = cv2.blur(known.astype(np.float64), (3, 3), borderType=cv2.BORDER_CONSTANT)
    total = cv2.blur(np.where(known, heights, 0.0), (3, 3), borderType=cv2.BORDER_CONSTANT)
    near = ~known & (share > 1e-6)
    return np.where(near, total / np.maximum(share, 1e-6), heights)


def _grown_picture(image: Image, shown: NDArray[np.bool_]) -> tuple[Image, NDArray[np.bool_]]:
    """The image with its border colours extended by `_GROWN` cells and a half, and the new mask."""
    if shown.all():
        return image, shown
    away, label = cv2.distanceTransformWithLabels(
        (~shown).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    rows, columns = np.nonzero(shown)
    nearest = np.zeros((int(label.max()) + 1, 3), np.uint8)
    nearest[label[rows, columns]] = image[rows, columns]
    return nearest[label], np.asarray(away) <= (_GROWN + 0.5) * TEXELS / CELLS


def _height(depth: Float32, base: float) -> Array:
    """Heights (m) of the drawn pixels, -inf where nothing was drawn."""
    return np.where(depth > 0, base + _EYE_M - depth.astype(np.float64), -np.inf)


def _placed(
    mesh: SourceMesh, mips: tuple[Image, ...], centre: Array, size: float
) -> TileMesh | None:
    """The triangles that may overlap a square, relative to its centre; None without any."""
    corners = mesh.positions[mesh.faces, :2] - centre[:2]
    low, high = corners.min(axis=1), corners.max(axis=1)
    near = mesh.faces[((low <= 0.51 * size) & (high >= -0.51 * size)).all(axis=1)]
    if len(near) == 0:
        return None
    positions = (mesh.positions - centre).astype(np.float32)
    return TileMesh(positions, mesh.uvs, near, mips, Pose.identity(), mesh.repeat)


def _drawn(tiles: Sequence[TileMesh], n: int, step: float) -> tuple[Image, Float32]:
    """RGB and depth (n, n) of a grid of rays that go down, `step` metres apart."""
    renderer = NumbaRenderer(StaticTiles(tiles), threads=1)
    focal = _EYE_M / step
    camera = Camera(n, n, focal, focal, n / 2, n / 2)
    view = renderer.draw(tiles, Pose(_DOWN, np.array([0.0, 0.0, _EYE_M])), camera)
    return view.rgb, view.depth
