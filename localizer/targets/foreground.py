"""Detects an object before known ground by a likelihood ratio test.

Correlation alone would follow ground texture, such as zebra stripes. With the ground known, each
cell is tested: does it show the object or the ground? Cells that are alike in both do not count.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array

Grey = NDArray[np.float32]  # of a chart

_OPAQUE = 0.7  # of the look's difference from the ground that is seen, from which on it is there;
_DOUBLED = 1.5  # more than all of it is something else
_NOTHING = 0.2  # of it: the ground is seen, if it differs from how it was by no more than
_AS_GROUND = 0.3  # of the squared difference of look and ground
_END = 0.5  # the same of each end: what is half hidden is found aside
_MATTERS = 0.15  # of all evidence: an end that could show less tells nothing
_DIFFERS = 6.0  # grey levels, root mean square: a look that differs less cannot be told from ground
_CLEAR = 1.3  # by how much the best place's evidence exceeds the second's
_AHEAD = 3  # an end is a third of the length


@dataclass(frozen=True)
class TargetAppearance:
    """A target's appearance in a chart; squares of 2 half + 1 cells. grey: grey levels; inside: 1
    in the target; about: 1 on the ground close by.
    """

    grey: Grey
    inside: Grey
    about: Grey

    @classmethod
    def of(cls, grey: Grey, outline: NDArray[np.uint8]) -> TargetAppearance:
        """From a mask that is 1 within the outline."""
        inside = cv2.erode(outline, np.ones((3, 3)))
        about = cv2.dilate(outline, np.ones((7, 7))) - cv2.dilate(outline, np.ones((3, 3)))
        return cls(grey, inside.astype(np.float32), about.astype(np.float32))

    def ends(self) -> tuple[Grey, Grey]:
        """The parts of `inside` ahead of and behind the middle third of its longer axis."""
        rows, columns = np.nonzero(self.inside)
        places = np.column_stack([columns, rows]).astype(np.float64)
        off = places - places.mean(axis=0)
        along = off @ np.linalg.eigh(off.T @ off)[1][:, -1]
        reach = float(np.abs(along).max()) / _AHEAD
        front, back = np.zeros_like(self.inside), np.zeros_like(self.inside)
        front[rows[along > reach], columns[along > reach]] = 1.0
        back[rows[along < -reach], columns[along < -reach]] = 1.0
        return front, back


@dataclass(frozen=True)
class AppearanceCoverage:
    """Position of the target over the ground. share: visible part, 1 is all of it; offset: (2,)
    cells, x then y; evidence: log-likelihood ratio against the ground, times twice the noise's
    variance.
    """

    share: float
    offset: Array
    evidence: float


def is_detectable(ground: Grey, look: TargetAppearance) -> bool:
    """Whether the target differs enough from the middle of the ground's chart to be detected. Both
    charts are square; the ground's may be larger.
    """
    side, size = len(look.grey), len(ground)
    k = (size - side) // 2
    off = (ground[k : k + side, k : k + side] - look.grey) ** 2
    return float((off * look.inside).sum()) >= _DIFFERS**2 * float(look.inside.sum())


def is_ground(chart: Grey, ground: Grey, look: TargetAppearance) -> bool:
    """Whether a chart shows the ground and nothing of the target. False if both look the same. All
    are of one size.
    """
    if not is_detectable(ground, look):
        return False
    level = np.float32(np.median(chart - ground))
    share, _, whole = _evidence(chart, ground + level, look.grey, look.inside)
    off = float((((chart - ground - level) ** 2) * look.inside).sum())
    return float(share[0, 0]) <= _NOTHING and off <= _AS_GROUND * float(whole[0, 0])


def find_object(
    chart: Grey, ground: Grey, look: TargetAppearance, aside: float = 0.0
) -> AppearanceCoverage | None:
    """Position at which the target covers the ground; None without one, if it is half hidden, or if
    a second position is as likely. chart, ground: squares of the same size. aside: share by which
    evidence in the corners of the search range counts less; 0: all counts alike.

    With Gaussian noise the log-likelihood ratio of target against ground is proportional to ``sum
    (I - G)² - (I - L)²``. An image ``G + a (L - G)`` gives ``(2 a - 1)`` times the ratio of the
    whole target, ``sum (L - G)²``.
    """
    reach = (len(chart) - len(look.grey)) // 2
    share, evidence, whole = _evidence(chart, ground, look.grey, look.inside)
    least = _DIFFERS**2 * float(look.inside.sum())
    allowed = (share >= _OPAQUE) & (share <= _DOUBLED) & (whole >= least)
    if not allowed.any():
        return None
    told = np.where(allowed, evidence, 0.0) * (1.0 - aside * 0.5 * squared_share(reach))
    # A plain car fits anywhere within itself: where it reaches beyond its outline, it is not.
    beyond = cv2.matchTemplate((chart - ground) ** 2, look.about, cv2.TM_CCORR)
    evidence = evidence - beyond
    _, _, _, (x, y) = cv2.minMaxLoc(np.where(allowed, told - beyond, -np.inf).astype(np.float32))
    side, best = len(look.grey), float(told[y, x])
    if best < _CLEAR * second_best(told, x, y, side, least=0.0):
        return None
    here, below = chart[y : y + side, x : x + side], ground[y : y + side, x : x + side]
    for end in look.ends():
        seen, _, differs = _evidence(here, below, look.grey, end)
        if differs[0, 0] >= _MATTERS * whole[y, x] and seen[0, 0] < _END:
            return None
    offset = peak_offset(evidence, x, y, reach)
    return AppearanceCoverage(float(share[y, x]), offset, best)


def squared_share(reach: int) -> Grey:
    """(2 reach + 1, 2 reach + 1): squared distance from the middle, as a share of the reach's."""
    line = (np.arange(-reach, reach + 1, dtype=np.float32) / max(reach, 1)) ** 2
    return np.asarray(line[:, None] + line[None], dtype=np.float32)


def second_best(scores: Grey, x: int, y: int, side: int, least: float) -> float:
    """The highest score away from the best at column x and row y, by a third of a template's side;
    `least` without another.
    """
    near = max(3, (side - 1) // 3)
    rivals = scores.copy()
    rivals[max(y - near, 0) : y + near + 1, max(x - near, 0) : x + near + 1] = least
    return float(rivals.max())


def peak_offset(scores: Grey, x: int, y: int, reach: int) -> Array:
    """(2,) cells from the middle, (reach, reach), to the peak at column x and row y, by parabolas
    through its neighbours.
    """
    offset = np.array([x - reach, y - reach], dtype=np.float64)
    for axis, line, k in ((0, scores[y], x), (1, scores[:, x], y)):
        if 0 < k < len(line) - 1:
            a, b, c = (float(v) for v in line[k - 1 : k + 2])
            bend = a - 2 * b + c
            offset[axis] += 0.5 * (a - c) / bend if bend < 0 else 0.0
    return offset


def _evidence(chart: Grey, ground: Grey, look: Grey, inside: Grey) -> tuple[Grey, Grey, Grey]:
    """(visible share, evidence, evidence of the whole target) at every position of the search."""
    as_ground = cv2.matchTemplate((chart - ground) ** 2, inside, cv2.TM_CCORR)
    as_look = cv2.matchTemplate(chart, look, cv2.TM_SQDIFF, mask=inside)
    whole = cv2.matchTemplate(ground, look, cv2.TM_SQDIFF, mask=inside)
    evidence = as_ground - as_look
    share = 0.5 + 0.5 * evidence / np.maximum(whole, 1.0)
    return share, evidence, np.asarray(whole, dtype=np.float32)
