"""Selection of the geo-anchors of a reference view (paper, Eq. 1; registration.md)."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.geometry.shutter import Sweep
from localizer.registration.sampling import sample_features
from localizer.types import Anchors, FeatureLevel, FeaturePyramid, Float32, RenderedView

_CANDIDATES = 19_200  # enough for 4,000 anchors, in blocks of 2 x 2 pixels or larger
_BORDER_SHARE = 0.02  # of the image's shorter side, where features see the padding
_MAX_CURVATURE = 0.01  # second difference of 1/depth relative to 1/depth; 0 on any plane
_EDGE_RADIUS = 2  # px around a depth edge or hole


def select_anchors(
    view: RenderedView, features: FeaturePyramid, count: int = 500, seed: int = 0
) -> Anchors:
    """At most `count` anchors: spread evenly over the image, off depth edges and holes.

    They are drawn at random within equal cells, so that every part of the view is represented. They
    are in Morton order, so that neighbours in the list are neighbours in every feature map. The
    same seed gives the same anchors. A view without usable depth gives fewer or none; `JNGO` then
    returns TOO_FEW_ANCHORS.
    """
    rng = np.random.default_rng(seed)
    rows, columns = _candidates(view.depth, rng)
    side = np.sqrt(view.depth.size / max(count, 1))
    row, column = ((np.arange(n) // side).astype(np.int64) for n in view.depth.shape)
    cell = row[rows] * view.depth.shape[1] + column[columns]
    picked = _stratified(cell, count, rng)
    rows, columns = rows[picked], columns[picked]
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=1)
    points = view.world_from_camera.apply(
        view.camera.rays(pixels) * view.depth[rows, columns, None].astype(np.float64)
    )
    return anchors_at(points, pixels, features)


def anchors_at(points_world: Array, pixels: Array, features: FeaturePyramid) -> Anchors:
    """Anchors of known surface points (N, 3), world metres, that the image shows at pixels (N, 2),
    with the features sampled there.

    They come in Morton order, see `select_anchors`.
    """
    columns, rows = np.maximum(pixels, 0).astype(np.int64).T
    order = np.argsort(morton_code(columns, rows), kind="stable")
    pixels = pixels[order]
    return Anchors(
        np.ascontiguousarray(points_world[order]),
        pixels.astype(np.float32),
        tuple(_sample(level, level.features, pixels) for level in features.levels),
        tuple(
            _sample(level, level.confidence[..., None], pixels)[:, 0] for level in features.levels
        ),
    )


def _candidates(
    depth: Float32, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of one pixel per block, where the surface is smooth and present.

    The pixel of a block is random. A fixed pixel would put every anchor at the same fraction of a
    feature cell. The phase error of bilinear interpolation, which is odd about the cell's middle,
    would then shift the pose (measured: 0.02 px of the finest level).
    """
    hole = ~(np.isfinite(depth) & (depth > 0))
    # 0 in holes, whatever stands there: no arithmetic touches it.
    inverse = (1.0 / np.maximum(np.where(hole, np.inf, depth), 1e-3)).astype(np.float32)
    edge = np.zeros(depth.shape, dtype=bool)
    # On a plane, 1/depth is linear in the pixel whatever the slant, so a grazing road is no edge.
    limit = _MAX_CURVATURE * inverse
    edge[:, 1:-1] |= (
        np.abs(inverse[:, 2:] - 2 * inverse[:, 1:-1] + inverse[:, :-2]) > limit[:, 1:-1]
    )
    edge[1:-1] |= np.abs(inverse[2:] - 2 * inverse[1:-1] + inverse[:-2]) > limit[1:-1]
    size = 2 * _EDGE_RADIUS + 1
    bad = cv2.dilate((edge | hole).astype(np.uint8), np.ones((size, size), np.uint8)) > 0
    border = max(2, round(_BORDER_SHARE * min(depth.shape)))
    bad[:border], bad[-border:], bad[:, :border], bad[:, -border:] = True, True, True, True
    step = max(2, int((depth.size / _CANDIDATES) ** 0.5))
    height, width = (n // step for n in depth.shape)
    blocks = np.mgrid[0:height, 0:width] * step + rng.integers(0, step, (2, height, width))
    rows, columns = blocks.reshape(2, -1)
    good = ~bad[rows, columns]
    return rows[good], columns[good]


def _stratified(cell: NDArray[np.int64], count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Indices of `count` candidates: one of every cell, then a second of every cell, and so on."""
    place = rng.random(len(cell))
    order = np.argsort(cell + place)
    cells = cell[order]
    first = np.r_[0, np.flatnonzero(np.diff(cells)) + 1] if len(cells) else np.zeros(0, np.int64)
    lengths = np.diff(np.r_[first, len(cells)])
    rank = np.arange(len(cells)) - np.repeat(first, lengths)
    if len(order) <= count:
        return order
    return order[np.argpartition(rank + place[order], count)[:count]]


def morton_code(x: NDArray[np.int64], y: NDArray[np.int64]) -> NDArray[np.int64]:
    """Z-order code: the bits of x and y interleaved."""
    code = y << 32 | x  # both of 16 bits
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        code = (code | code << shift) & (mask << 32 | mask)
    return code & 0xFFFFFFFF | code >> 31


def _sample(level: FeatureLevel, values: Float32, pixels: Array) -> Float32:
    """Values (h, w, C) of a level at pixels (N, 2), as (N, C)."""
    uv = pixels / level.stride - 0.5
    return sample_features(values, uv[:, 0], uv[:, 1])


def apply_sweep(anchors: Anchors, sweep: Sweep | None, pose: Pose, camera: Camera) -> Anchors:
    """The anchors, displaced as a rolling shutter shows them.

    pose: the camera's approximate pose in the middle of the readout. An error of some degrees
    changes the anchors by centimetres only. sweep None: all rows are exposed at once, so no anchor
    is displaced.
    """
    if sweep is None or len(anchors.points_world) == 0:
        return anchors
    depth_m = float(np.linalg.norm(anchors.points_world.mean(axis=0) - pose.translation))
    if not sweep.displaces_pixels(camera, depth_m):
        return anchors
    return replace(anchors, points_world=sweep.apparent_points(anchors.points_world, pose, camera))
