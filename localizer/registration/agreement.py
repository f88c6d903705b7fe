"""Checks whether the patches of an image agree on a pose (registration.md, section 8a).

At the right pose nearly every patch matches best without a shift. A wrong pose is a compromise
between patches that would match better elsewhere: its cost may be low over uniform land, but few
patches agree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from localizer.geometry.pose import Array
from localizer.registration.backend import LevelProblem
from localizer.registration.cpu.algebra import JIT
from localizer.registration.cpu.reference import pose_tangent_map
from localizer.registration.sampling import numbered, projection_jacobians, seen_anchors
from localizer.types import Float32

_PART_PX = 16.0  # least side of a part, level px
_ANCHORS_A_PART = 8.0  # wanted: with few anchors the parts are larger
_REACH = 6  # of the shifts compared, level px
_NEAR = 1.5  # shift that is none, level px: 9 of 169 by chance
_LEAST_ANCHORS = 4  # of a part, to have a vote
_BEST = 4  # one part in so many has the best peaks: others have changed, or show nothing
_MEASURED = 5.5  # largest displacement that is one: beyond, the peak lies at the search's edge


_RAYLEIGH = 1.1774  # median length of a vector of two independent errors, in their sigmas


@dataclass(frozen=True)
class PatchDisplacements:
    """Shifts under which the P patches of an image match best at a registered pose.

    shift: (P, 2) of the query against the map, level px. motion: (P, 2, 6) derivative of the shift
    by the pose (position and left rotation vector, world axes, as `PosePrior`), level px. rise: (P,
    2) derivative of the shift by the height of the patch's ground above the map, level px per
    metre. ground: (P, 2) east and north of the patch, m. matched: share of them that show the map;
    the others match best anywhere in the search, by chance. At most 0 if all do.
    """

    shift: Array
    motion: Array
    rise: Array
    ground: Array
    matched: float = 1.0

    @property
    def scatter_px(self) -> float:
        """Sigma of the shifts per axis, level px, by their median; inf without patches. Patches
        that have changed since the survey have shifts of their own, and the optimizer's loss
        ignores them.
        """
        if len(self.shift) == 0:
            return np.inf
        return float(np.median(np.hypot(self.shift[:, 0], self.shift[:, 1]))) / _RAYLEIGH


@dataclass(frozen=True)
class PatchAgreement:
    """How the image's patches agree with a registration. patches: number of patches that can be
    compared; votes: number of those that match best at their own position; peak: match of the whole
    image at its position, minus the mean of its matches at other shifts, in their standard
    deviations; patch_peak: match of a patch at its position, minus the mean of its matches, in
    their standard deviations, mean of the best quarter. displacements: shifts of the best matches;
    patches without a peak are left out.
    """

    patches: int
    votes: int
    peak: float
    patch_peak: float
    displacements: PatchDisplacements | None = None

    @property
    def share(self) -> float:
        """Share of the patches that agree, 0 to 1."""
        return self.votes / max(self.patches, 1)


def agreement(problem: LevelProblem, rotation: Array, translation: Array) -> PatchAgreement:
    """Test how many patches of the image agree on a pose camera_from_local. problem: a level with
    all or some of its anchors.
    """
    grid = _patch_grid(problem, rotation, translation)
    able = grid.anchors >= _LEAST_ANCHORS
    offset = np.arange(-_REACH, _REACH + 1)
    distance = np.hypot(offset[:, None], offset[None])
    near = (distance <= _NEAR).ravel()
    matches = grid.sums[able].reshape(-1, near.size)
    votes = int(near[matches.argmax(axis=1)].sum())
    total = grid.sums.sum(axis=0).ravel()
    others = total[(distance > 2 * _NEAR).ravel()]
    peak = (float(total[near].max()) - float(others.mean())) / max(float(others.std()), 1e-9)
    return PatchAgreement(
        len(matches), votes, peak if len(able) else 0.0, _patch_peak(matches, near),
        _displacements(grid, able),
    )  # fmt: skip


def _patch_peak(matches: Float32, near: NDArray[np.bool_]) -> float:
    """`PatchAgreement`'s, of (P, n) matches at n shifts; near: (n,) shifts that are none."""
    if len(matches) == 0:
        return 0.0
    height = matches[:, near].max(axis=1) - matches.mean(axis=1)
    peaks = np.sort(height / np.maximum(matches.std(axis=1), 1e-9))
    return float(peaks[-max(len(peaks) // _BEST, 3) :].mean())


@dataclass(frozen=True)
class _PatchGrid:
    """Patches of the image with the anchors in each. sums: (P, 2 r + 1, 2 r + 1) correlation of a
    patch's anchors with the query under shifts (rows, then columns) of up to r = `_REACH` level px;
    anchors: (P,) number of anchors; motion: (P, 2, 6) derivative of the position by the pose
    (position and left rotation vector, world axes), level px, mean of its anchors; rise: (P, 2)
    derivative by the ground height, level px per metre; ground: (P, 2) east and north of the
    ground, m.
    """

    sums: Float32
    anchors: NDArray[np.int64]
    motion: Array
    rise: Array
    ground: Array


def _displacements(grid: _PatchGrid, able: NDArray[np.bool_]) -> PatchDisplacements:
    """Each patch's best shift, to a fraction of a pixel."""
    shift = _peaks(grid.sums[able])
    measured = np.hypot(shift[:, 0], shift[:, 1]) < _MEASURED
    offset = np.arange(-_REACH, _REACH + 1)
    beyond_by_chance = float((np.hypot(offset[:, None], offset) >= _MEASURED).mean())
    beyond = float((~measured).mean()) if len(measured) else 1.0
    return PatchDisplacements(
        shift[measured], grid.motion[able][measured], grid.rise[able][measured],
        grid.ground[able][measured], 1.0 - beyond / beyond_by_chance,
    )  # fmt: skip


def _peaks(sums: Float32) -> Array:
    """(P, 2) shifts (x, y), level px, of the highest of (P, n, n) correlations: a parabola through
    the peak and its neighbours.
    """
    n = sums.shape[1]
    best = sums.reshape(len(sums), n * n).argmax(axis=1)
    row, column = best // n, best % n
    k = np.arange(len(sums))

    def fraction(before: Array, at: Array, after: Array) -> Array:
        bend = before - 2.0 * at + after
        offset = 0.5 * (before - after) / np.where(bend < 0, bend, -1.0)
        return np.where(bend < 0, offset.clip(-0.5, 0.5), 0.0)

    at = sums[k, row, column].astype(np.float64)
    left, right = (sums[k, row, (column + d).clip(0, n - 1)] for d in (-1, 1))
    above, below = (sums[k, (row + d).clip(0, n - 1), column] for d in (-1, 1))
    inner_x, inner_y = (column > 0) & (column < n - 1), (row > 0) & (row < n - 1)
    x = column - n // 2 + np.where(inner_x, fraction(left, at, right), 0.0)
    y = row - n // 2 + np.where(inner_y, fraction(above, at, below), 0.0)
    return np.stack([x, y], axis=1)


def _patch_grid(problem: LevelProblem, rotation: Array, translation: Array) -> _PatchGrid:
    h, w = problem.confidence.shape
    # The window of every anchor lies in the image, or the image's edge would vote.
    seen = seen_anchors(problem, rotation, translation, border=_REACH)
    shown = seen.confidence > 0.0  # a picture there
    anchor = seen.anchor[shown]
    x, u, v, confidence = (values[shown] for values in seen[1:])
    part_px = max(_PART_PX, (h * w * _ANCHORS_A_PART / problem.points.shape[1]) ** 0.5)
    across = int(w // part_px) + 1
    key = (v // part_px).astype(np.int64) * across + (u // part_px).astype(np.int64)
    part, count = numbered(key)
    side = 2 * _REACH + 1
    sums = np.zeros((count, side, side), np.float32)
    weights = problem.anchor_confidence[anchor] * confidence
    features = problem.anchor_features[anchor]
    _add(problem.features, features, u, v, weights.astype(np.float32), part, sums)
    anchors = np.bincount(part, minlength=count)
    tangent = projection_jacobians(problem, x, translation)
    inverse = np.linalg.inv(pose_tangent_map(rotation, translation))
    motion = (tangent.reshape(-1, 6) @ inverse).reshape(-1, 2, 6)
    # Ground that lies higher moves in the image as if the camera were lower.
    values = np.concatenate(
        [motion.reshape(-1, 12), -motion[:, :, 2], problem.points.T[anchor, :2]], axis=1
    )
    mean = np.zeros((count, 16))
    _add_rows(values, part, mean)
    mean /= np.maximum(anchors, 1)[:, None]
    return _PatchGrid(sums, anchors, mean[:, :12].reshape(-1, 2, 6), mean[:, 12:14], mean[:, 14:])


@njit(**JIT)
def _add(features, anchors, u, v, weights, part, sums):  # type: ignore[no-untyped-def]
    channels = features.shape[2]
    side = sums.shape[1]
    reach = (side - 1) // 2
    raw = np.empty((side + 1, side + 1), np.float32)
    for k in range(len(u)):
        i, j = int(u[k]), int(v[k])
        a, b = np.float32(u[k] - i), np.float32(v[k] - j)
        for p in range(side + 1):
            row = features[j - reach + p, i - reach : i + reach + 2]
            for q in range(0, side + 1, 2):  # in pairs: a third less time
                first = second = np.float32(0)
                for c in range(channels):
                    first += row[q, c] * anchors[k, c]
                    second += row[q + 1, c] * anchors[k, c]
                raw[p, q], raw[p, q + 1] = first, second
        for p in range(side):
            for q in range(side):
                top = raw[p, q] + a * (raw[p, q + 1] - raw[p, q])
                low = raw[p + 1, q] + a * (raw[p + 1, q + 1] - raw[p + 1, q])
                sums[part[k], p, q] += weights[k] * (top + b * (low - top))


@njit(**JIT)
def _add_rows(values, part, sums):  # type: ignore[no-untyped-def]
    for k in range(len(part)):
        for q in range(values.shape[1]):
            sums[part[k], q] += values[k, q]
