"""Whether the parts of an image agree on a pose, each by itself (registration.md, section 8a).

At the right pose nearly every part of the image matches best where it lies. A wrong pose is the
best compromise of parts that each would rather lie elsewhere: its cost may be low, because land of
one kind is alike, but few parts of it vote for no shift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from localizer.geometry.pose import Array
from localizer.registration.backend import LevelProblem, sample_bilinear
from localizer.registration.cpu.algebra import JIT
from localizer.registration.cpu.reference import in_view, project
from localizer.types import Float32

_PART_PX = 16.0  # least side of a part, level px
_ANCHORS_A_PART = 8.0  # wanted: with few anchors the parts are larger
_REACH = 6  # of the shifts compared, level px
_NEAR = 1.5  # shift that is none, level px: 9 of 169 by chance
_LEAST_ANCHORS = 4  # of a part, to have a vote


@dataclass(frozen=True)
class PatchAgreement:
    """parts: of the image that could vote; votes: of those that match best where they lie; peak:
    the whole image's match there over its matches under other shifts, in their standard deviations.
    """

    patches: int
    votes: int
    peak: float

    @property
    def share(self) -> float:
        """Of the parts that agree, 0 to 1."""
        return self.votes / max(self.patches, 1)


def agreement(problem: LevelProblem, rotation: Array, translation: Array) -> PatchAgreement:
    """How the parts vote on a pose camera_from_local; problem: a level and some of its anchors."""
    sums, anchors = _shifted_sums(problem, rotation, translation)
    offset = np.arange(-_REACH, _REACH + 1)
    distance = np.hypot(offset[:, None], offset[None])
    near = (distance <= _NEAR).ravel()
    able = sums[anchors >= _LEAST_ANCHORS].reshape(-1, near.size)
    votes = int(near[able.argmax(axis=1)].sum()) if len(able) else 0
    total = sums.sum(axis=0).ravel()
    others = total[(distance > 2 * _NEAR).ravel()]
    peak = (float(total[near].max()) - float(others.mean())) / max(float(others.std()), 1e-9)
    return PatchAgreement(len(able), votes, peak if len(sums) else 0.0)


def _shifted_sums(
    problem: LevelProblem, rotation: Array, translation: Array
) -> tuple[Float32, NDArray[np.int64]]:
    """Correlation (parts, 2 r + 1, 2 r + 1) of each part's anchors with the query under shifts
    (rows, then columns) of up to r = `_REACH` level px, and how many anchors it has (parts,).
    """
    x, uv = project(problem, rotation, translation)
    u, v = uv.T
    h, w = problem.confidence.shape
    # The window of every anchor lies in the image, or the image's edge would vote.
    whole = in_view(problem, x, uv) & (u >= _REACH) & (u < w - 1 - _REACH)
    whole &= (v >= _REACH) & (v < h - 1 - _REACH)
    whole[whole] = sample_bilinear(problem.confidence, u[whole], v[whole]) > 0.0  # a picture there
    u, v = u[whole], v[whole]
    part_px = max(_PART_PX, (h * w * _ANCHORS_A_PART / problem.points.shape[1]) ** 0.5)
    across = int(w // part_px) + 1
    key = (v // part_px).astype(np.int64) * across + (u // part_px).astype(np.int64)
    names, part = np.unique(key, return_inverse=True)
    side = 2 * _REACH + 1
    sums = np.zeros((len(names), side, side), np.float32)
    weights = problem.anchor_confidence[whole] * sample_bilinear(problem.confidence, u, v)
    _add(
        problem.features,
        np.ascontiguousarray(problem.anchor_features[whole]),
        u,
        v,
        weights.astype(np.float32),
        part.astype(np.int64),
        sums,
    )
    return sums, np.bincount(part, minlength=len(names))


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
            for q in range(side + 1):
                dot = np.float32(0)
                for c in range(channels):
                    dot += features[j - reach + p, i - reach + q, c] * anchors[k, c]
                raw[p, q] = dot
        for p in range(side):
            for q in range(side):
                top = raw[p, q] + a * (raw[p, q + 1] - raw[p, q])
                low = raw[p + 1, q] + a * (raw[p + 1, q + 1] - raw[p + 1, q])
                sums[part[k], p, q] += weights[k] * (top + b * (low - top))
