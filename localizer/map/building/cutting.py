"""Cuts squares out of textured meshes, with the part of the texture that they use."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from localizer.map.source import SourceMesh

_PADDING = 2  # texels around a packed chart


def crop_square(mesh: SourceMesh, left: float, top: float, size: float) -> SourceMesh | None:
    """The triangles with centroids in a square (x, y; metres) and their part of the texture; None
    without any. left, top: western and northern edge, m; size: side, m.
    """
    centroid = mesh.positions[mesh.faces, :2].mean(axis=1)
    here = (
        (centroid[:, 0] >= left)
        & (centroid[:, 0] < left + size)
        & (centroid[:, 1] <= top)
        & (centroid[:, 1] > top - size)
    )
    if not here.any():
        return None
    used, faces = np.unique(mesh.faces[here], return_inverse=True)
    part = replace(
        mesh,
        positions=mesh.positions[used],
        uvs=mesh.uvs[used],
        faces=faces.reshape(-1, 3).astype(np.int32),
        jpeg=None,
    )
    return part if mesh.repeat or mesh.palette else _repacked(part)


def _repacked(mesh: SourceMesh) -> SourceMesh:
    """The same mesh with the charts of its texture in a new, smaller image."""
    v = len(mesh.positions)
    edges = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    ones = np.ones(len(edges), bool)
    _, chart = connected_components(coo_matrix((ones, (edges[:, 0], edges[:, 1])), shape=(v, v)))
    size = np.array(mesh.image.shape[1::-1])
    texels = np.clip(mesh.uvs.astype(np.float64), 0, 1) * size
    count = int(chart.max()) + 1
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, chart, texels)
    np.maximum.at(high, chart, texels)
    low = np.clip(np.floor(low) - _PADDING, 0, size).astype(np.int64)
    high = np.clip(np.ceil(high) + _PADDING, 0, size).astype(np.int64)
    places, (width, height) = pack_in_rows(high - low)
    if width * height >= size.prod():
        return mesh
    image = np.zeros((height, width, 3), np.uint8)
    for (x, y), (x0, y0), (x1, y1) in zip(places, low, high, strict=True):
        image[y : y + y1 - y0, x : x + x1 - x0] = mesh.image[y0:y1, x0:x1]
    uvs = (texels - low[chart] + places[chart]) / (width, height)
    return replace(mesh, uvs=uvs.astype(np.float32), image=image)


def pack_in_rows(sizes: NDArray[np.int64]) -> tuple[NDArray[np.int64], tuple[int, int]]:
    """Pack rectangles (N, 2: width, height) in rows; positions (N, 2) and total size."""
    limit = max(int(np.sqrt(1.1 * sizes.prod(axis=1).sum())), int(sizes[:, 0].max()))
    places = np.zeros_like(sizes)
    x = y = row = widest = 0
    for i in np.argsort(-sizes[:, 1], kind="stable"):
        width, height = (int(n) for n in sizes[i])
        if x + width > limit:
            x, y, row = 0, y + row, 0
        places[i] = x, y
        x, row = x + width, max(row, height)
        widest = max(widest, x)
    return places, (widest, y + row)
