"""Selects the tiles of a view by screen-space error, frustum and horizon culling (numba kernel)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from localizer.geometry.camera import Camera
from localizer.geometry.geo import LocalFrame
from localizer.geometry.pose import Array, Pose
from localizer.map.cache.cache import REPLACE, TileIndex

_HORIZON_MARGIN_M = 30.0  # what a sphere misses of the ellipsoid over some tens of kilometres
_SEMI_MAJOR_M, _ECCENTRICITY_SQUARED = 6378137.0, 6.69437999014e-3  # WGS84

_RELAX = 1.4  # step by which detail is reduced when a view does not fit into the budget

_UNSEEN, _CULLED, _WANTED, _REFINED = 0, 1, 2, 3


@dataclass(frozen=True)
class DetailLimits:
    """Limits of detail. max_error_px: a node's geometric error in the image; max_texel_px: image
    pixels per texel.
    """

    max_error_px: float = 8.0
    max_texel_px: float = 1.5

    def relaxed(self, factor: float) -> DetailLimits:
        """The limits, coarser by `factor`."""
        return DetailLimits(self.max_error_px * factor, self.max_texel_px * factor)


@dataclass(frozen=True, eq=False)
class Selection:
    """Nodes of a view. wanted: at the required level of detail; shown: resident nodes to draw now;
    requests: nodes to load, most urgent first; hole: whether part of the view has nothing to show.
    """

    wanted: NDArray[np.int32]
    shown: NDArray[np.int32]
    requests: NDArray[np.int32]
    hole: bool


class TileSelector:
    """Selects nodes of a tile index; has no state."""

    def __init__(self, index: TileIndex, frame: LocalFrame) -> None:
        self._index = index
        radius = _curvature_radius(frame)
        lowest = _lowest_ground(index, radius) - _HORIZON_MARGIN_M
        self._globe = np.array([-radius, radius + lowest])
        # Compiled now: a first view in flight must not wait for it.
        nobody = np.zeros(len(index.refine), np.bool_)
        self.select(Pose.identity(), Camera.from_fov(8, 8, 60.0), nobody, DetailLimits())

    def select(
        self,
        world_from_camera: Pose,
        camera: Camera,
        resident: NDArray[np.bool_],
        limits: DetailLimits,
    ) -> Selection:
        """The nodes of a view. resident: (N,) bool, nodes whose tiles are all in memory."""
        i = self._index
        n = len(i.refine)
        nodes = np.empty((3, n), np.int32)
        priority = np.empty(n)
        wanted, shown, requests, hole = _select(
            i.box_min,
            i.box_max,
            i.geometric_error,
            i.gsd,
            i.refine,
            i.child_start,
            i.child_count,
            i.tile_count,
            resident,
            frustum_planes(world_from_camera, camera),
            np.ascontiguousarray(world_from_camera.translation, np.float64),
            self._globe,
            max(camera.fx, camera.fy),
            limits.max_error_px,
            limits.max_texel_px,
            nodes,
            priority,
        )
        order = np.argsort(priority[:requests], kind="stable")
        return Selection(nodes[0, :wanted], nodes[1, :shown], nodes[2, :requests][order], hole)

    def fitting_limits(
        self,
        world_from_camera: Pose,
        camera: Camera,
        finest: DetailLimits,
        sizes: NDArray[np.int64],
        budget: int,
    ) -> DetailLimits:
        """The finest limits at which a view's wanted nodes, `sizes` bytes (N,), fit the budget."""
        limits = finest
        everything = np.ones(len(sizes), np.bool_)
        for _ in range(16):
            choice = self.select(world_from_camera, camera, everything, limits)
            if sizes[choice.wanted].sum() <= budget:
                break
            limits = limits.relaxed(_RELAX)
        return limits


def frustum_planes(world_from_camera: Pose, camera: Camera) -> Array:
    """(5, 4): normals and offsets of the view's planes; inside where ``n @ x + d >= 0``."""
    left, right = -camera.cx / camera.fx, (camera.width - camera.cx) / camera.fx
    top, bottom = -camera.cy / camera.fy, (camera.height - camera.cy) / camera.fy
    normals = np.array(
        [[0, 0, 1.0], [1, 0, -left], [-1, 0, right], [0, 1, -top], [0, -1, bottom]]
    ) @ (world_from_camera.rotation.T)
    return np.column_stack([normals, -normals @ world_from_camera.translation])


def _curvature_radius(frame: LocalFrame) -> float:
    """Gaussian radius of curvature of the ellipsoid at the frame's origin, metres."""
    s = np.sin(np.radians(frame.origin.latitude_deg))
    w = 1 - _ECCENTRICITY_SQUARED * s * s
    return float(_SEMI_MAJOR_M * np.sqrt(1 - _ECCENTRICITY_SQUARED) / w)


def _lowest_ground(index: TileIndex, radius: float) -> float:
    """Height of the map's lowest point above a sphere that touches z = 0 at the origin, metres."""
    leaf = index.child_count == 0
    low, high = index.box_min[leaf], index.box_max[leaf]
    nearest = np.clip(0.0, low, high)
    nearest[:, 2] = low[:, 2] + radius
    return float(np.linalg.norm(nearest, axis=1).min() - radius)


@njit(cache=True)
def _outside(low, high, planes):  # type: ignore[no-untyped-def]
    """Whether a box lies wholly on the far side of one plane."""
    for k in range(planes.shape[0]):
        d = planes[k, 3]
        for a in range(3):
            d += planes[k, a] * (high[a] if planes[k, a] > 0 else low[a])
        if d < 0:
            return True
    return False


@njit(cache=True)
def _below_horizon(low, high, eye, globe):  # type: ignore[no-untyped-def]
    """Whether the globe (centre height and radius, on the z axis) hides every corner of a box.

    The hidden region (the cone of tangents behind their circle) is convex.
    """
    cx, cy, cz = -eye[0], -eye[1], globe[0] - eye[2]
    tangent2 = cx * cx + cy * cy + cz * cz - globe[1] * globe[1]
    if tangent2 <= 0:
        return False  # the camera is below the surface: hide nothing
    for corner in range(8):
        x = (high[0] if corner & 1 else low[0]) - eye[0]
        y = (high[1] if corner & 2 else low[1]) - eye[1]
        z = (high[2] if corner & 4 else low[2]) - eye[2]
        along = x * cx + y * cy + z * cz
        if along <= tangent2 or along * along <= tangent2 * (x * x + y * y + z * z):
            return False
    return True


@njit(cache=True)
def _distance(low, high, eye):  # type: ignore[no-untyped-def]
    """Metres from a point to a box, 0 inside."""
    d2 = 0.0
    for a in range(3):
        d = max(low[a] - eye[a], eye[a] - high[a], 0.0)
        d2 += d * d
    return np.sqrt(d2)


@njit(cache=True)
def _select(  # type: ignore[no-untyped-def]
    box_min,
    box_max,
    geometric_error,
    gsd,
    refine,
    child_start,
    child_count,
    tile_count,
    resident,
    planes,
    eye,
    globe,
    focal,
    max_error_px,
    max_texel_px,
    nodes,
    priority,
):
    """Fills nodes with (wanted, shown, requests); returns their counts and whether a hole is left.

    Nodes are in breadth-first order, so passes over the arrays replace recursion. The GIL is not
    released: the function takes a fraction of a millisecond, and acquiring the GIL again may take
    five.
    """
    n = len(refine)
    state = np.zeros(n, np.uint8)
    distance = np.empty(n)
    state[0] = _WANTED
    for i in range(n):
        if state[i] == _UNSEEN:
            continue
        low, high = box_min[i], box_max[i]
        if _outside(low, high, planes) or _below_horizon(low, high, eye, globe):
            state[i] = _CULLED
            continue
        distance[i] = _distance(low, high, eye)
        scale = focal / max(distance[i], 0.1)
        coarse = geometric_error[i] * scale > max_error_px or gsd[i] * scale > max_texel_px
        if child_count[i] > 0 and (coarse or tile_count[i] == 0):
            state[i] = _REFINED
            for c in range(child_start[i], child_start[i] + child_count[i]):
                state[c] = _WANTED
    tree = (refine, child_start, child_count, tile_count)
    covered, stands_in = _coverage(state, resident, tree)
    wanted, shown, requests = _listed(
        state, resident, tree, covered, stands_in, distance, nodes, priority
    )
    return wanted, shown, requests, not covered[0]


@njit(cache=True)
def _coverage(state, resident, tree):  # type: ignore[no-untyped-def]
    """Bottom up: whether everything visible below a node can be shown, and whether the node is
    shown in place of children that are not all resident.
    """
    refine, child_start, child_count, tile_count = tree
    n = len(refine)
    covered = np.ones(n, np.bool_)
    stands_in = np.zeros(n, np.bool_)
    for i in range(n - 1, -1, -1):
        if state[i] == _WANTED:
            covered[i] = tile_count[i] == 0 or resident[i]
        elif state[i] == _REFINED:
            for c in range(child_start[i], child_start[i] + child_count[i]):
                covered[i] &= covered[c]
            if tile_count[i] > 0:
                if refine[i] != REPLACE:
                    covered[i] &= resident[i]
                elif not covered[i] and resident[i]:
                    stands_in[i] = covered[i] = True
    return covered, stands_in


@njit(cache=True)
def _listed(  # type: ignore[no-untyped-def]
    state, resident, tree, covered, stands_in, distance, nodes, priority
):
    """Top down: fills nodes and the requests' priority; returns the three counts."""
    refine, child_start, child_count, tile_count = tree
    n = len(refine)
    backed = np.zeros(n, np.bool_)  # an ancestor is resident and can be shown instead
    hidden = np.zeros(n, np.bool_)  # an ancestor stands in
    wanted = shown = requests = 0
    for i in range(n):
        if state[i] == _UNSEEN or state[i] == _CULLED:
            continue
        if state[i] == _REFINED:
            for c in range(child_start[i], child_start[i] + child_count[i]):
                backed[c] = backed[i] or (resident[i] and tile_count[i] > 0)
                hidden[c] = hidden[i] or stands_in[i]
        if tile_count[i] == 0:
            continue
        needed = state[i] == _WANTED or refine[i] != REPLACE
        fallback = not needed and not covered[i] and not backed[i]
        if needed:
            nodes[0, wanted] = i
            wanted += 1
        if resident[i]:
            if not hidden[i] and (needed or stands_in[i]):
                nodes[1, shown] = i
                shown += 1
        elif needed or fallback:
            nodes[2, requests] = i
            priority[requests] = i - 1e9 if fallback else distance[i]
            requests += 1
    return wanted, shown, requests
