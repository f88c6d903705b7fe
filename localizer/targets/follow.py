"""Tracks a target's appearance in the image, on ground rectified by the pose.

Each frame is resampled to a chart: a square of the horizontal plane through the target, with
constant metres per cell. Charts remove the camera's motion: static objects stay in their cells, and
a car keeps its size; the chart turns with its course. Normalised cross-correlation with two
templates (the first and a recent one) finds the target.

Whether a static target still looks as before is judged by its middle, because a whole template
would match the surroundings with the target gone. The middle is compared with its image a second
ago: a changing view changes it slowly, a departure or an obstacle suddenly.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array
from localizer.targets.foreground import (
    AppearanceCoverage,
    TargetAppearance,
    find_object,
    is_detectable,
    is_ground,
    peak_offset,
    second_best,
    squared_share,
)
from localizer.targets.track import pixel_of
from localizer.types import PoseEstimate

Gray = NDArray[np.uint8]
Grey = NDArray[np.float32]  # of a chart

_SMALLEST_M, _LARGEST_M = 1.5, 15.0  # half the side of what is followed
_POINT_M = 3.0  # half the side around a point of which no extent is known
_CELLS = (9, 41)  # of a template's half side: what tells it from others, and what costs little
_LARGEST_REACH = 80  # cells that are searched to each side
_SEEN = 0.65  # correlation from which on it is the target where it is expected,
_FOUND = 0.72  # and where much ground is searched: somewhere some of it looks a little like it
_EXPECTED_M = 5.0
_WORSE = 0.1  # what correlates so much less than lately is half hidden, or another
_LATELY = 0.2  # weight of the newest in what is usual
# rad, by which it may have turned since it was last found: a moment ago, or some seconds.
_TURNS, _FAR_TURNS = (0.0, 0.2, -0.2), (0.0, 0.25, -0.25, 0.5, -0.5, 0.75, -0.75)
_LONG_AGO_M = 3.0  # of reach
_PREFERRED = 0.05  # by how much another look must be better
_SURE = 0.8  # from which on its present look is learned
_CLEAR = 1.15  # by how much the best place leads the second
# By how much a look must be better at the end of the reach than where the target is expected: what
# hid it for two seconds has edges that look like it, and they are metres from where it must be.
_ASIDE = 0.15
_RENEWED_NS = 2_000_000_000
_OTHER, _NOISES = 10.0, 3.0  # grey levels, and medians of the chart: what differs by more has moved
_SHARES = (0.03, 0.7)  # of a chart that may be the target
_PART = 5  # cells: a smaller part of it is noise
_ABOUT = 0.6  # of a chart's half side: parts of one thing reach so near to its middle
_GROUNDS = 3  # pictures at least that show the ground without what passes over it
_WHOLE = 0.9  # of a look that is seen before the ground, from which on it is learned
_INSIDE = 20  # cells at least that are its own: of fewer, some of the ground look the same
_FLAT = 4.0  # grey levels: a template of less contrast tells nothing


@dataclass(frozen=True)
class FollowedPosition:
    """Position (3,) of the target in a frame, world metres on the chart's plane."""

    position: Array
    pixel: tuple[float, float]
    score: float


class ImageFollower:
    """Tracks one target from a frame with a known position. Not thread-safe.

    position: (3,) world metres; half_m: half the side of the target, None for a point. Check
    `ready` first: plain ground cannot be tracked.

    Above 200 lines: both methods, by appearance alone and against known ground, share the learned
    appearance.
    """

    def __init__(
        self, gray: Gray, estimate: PoseEstimate, position: Array, half_m: float | None
    ) -> None:
        self._half_m = float(np.clip(half_m or _POINT_M, _SMALLEST_M, _LARGEST_M))
        camera = estimate.camera
        distance = float(np.linalg.norm(position - estimate.world_from_camera.translation))
        cell = distance / camera.fx
        half = int(np.clip(round(self._half_m / cell), *_CELLS))
        self._cell, self._half = self._half_m / half, half
        self._course = 0.0
        self._usual = 0.0
        self._origin = position
        first = self._chart(gray, estimate, position, half)
        self._first, self._late = first, first
        self._mask: Grey | None = None
        self._outline: NDArray[np.uint8] | None = None
        self._ground: Grey | None = None
        self._isolated_look: TargetAppearance | None = None  # as it was on that ground
        self._learns_m = 0.5 * self._half_m  # from where it was clicked, once it is so far away
        self._renewed_ns = estimate.exposure_time_ns
        self._stands = StaticAppearance()
        self.ready = first is not None and float(first.std()) >= _FLAT

    def find(
        self,
        gray: Gray,
        estimate: PoseEstimate,
        expected: Array,
        reach_m: float,
        *,
        was_hidden: bool = False,
    ) -> FollowedPosition | None:
        """Find the target within `reach_m` of the expected position (3,), at most 80 cells from it;
        None if it is not seen or two positions match equally well. A match changes the follower: it
        learns the target's usual score, its course and its present appearance.

        gray, estimate: the frame (H, W) and its pose. was_hidden: after an occlusion; positions
        near the expected one are then more likely.
        """
        reach = min(int(np.ceil(reach_m / self._cell)) + 1, _LARGEST_REACH)
        chart = self._chart(gray, estimate, expected, self._half + reach)
        if chart is None:
            return None
        best, turn = (-1.0, np.zeros(2)), 0.0
        for angle in _TURNS if reach_m <= _LONG_AGO_M else _FAR_TURNS:
            for template in (self._first, self._late):
                turned, mask = self._turned(template, -angle), self._turned(self._mask, -angle)
                if best[0] >= _SURE or turned is None:
                    break
                one = _match(chart, turned, mask, reach, _ASIDE if was_hidden else 0.0)
                if one[0] > best[0] + _PREFERRED:
                    best, turn = one, angle
        least = _SEEN if reach_m <= _EXPECTED_M else _FOUND
        if best[0] < max(least, self._usual - _WORSE):
            return None
        self._usual += _LATELY * (best[0] - self._usual)
        position = expected + self._on_ground(best[1] * self._cell)
        pixel = pixel_of(estimate, position)
        if pixel is None:
            return None
        self._course += turn
        is_due = estimate.exposure_time_ns - self._renewed_ns >= _RENEWED_NS
        if is_due and best[0] >= _SURE:
            self._renew(gray, estimate, position)
        return FollowedPosition(position, pixel, best[0])

    def find_on_ground(
        self,
        gray: Gray,
        estimate: PoseEstimate,
        expected: Array,
        reach_m: float,
        pictures: Sequence[tuple[PoseEstimate, Gray]],
        *,
        was_hidden: bool = False,
    ) -> tuple[bool, FollowedPosition | None]:
        """As `find`, for an isolated target: compares the frame with `pictures` of the same ground
        without the target, so that road markings and shadows are not mistaken for it.

        Returns whether the images can decide, and the target. They cannot decide before `isolate`,
        with fewer than 3 images that show the place, or if the target looks like the ground or is
        in most images.
        """
        reach = min(int(np.ceil(reach_m / self._cell)) + 1, _LARGEST_REACH)
        chart = self._chart(gray, estimate, expected, self._half + reach)
        grounds = [self._chart(g, e, expected, self._half + reach) for e, g in pictures]
        known = [ground for ground in grounds if ground is not None]
        if self._outline is None or chart is None or len(known) < _GROUNDS:
            return False, None
        ground = np.median(known, axis=0).astype(np.float32)
        ground += np.float32(np.median(chart - ground))  # the camera may expose otherwise by now
        best, turn, can_tell = None, 0.0, False
        for angle in _TURNS if reach_m <= _LONG_AGO_M else _FAR_TURNS:
            for template in (self._first, self._late):
                look = self._look(template, -angle)
                if (best is not None and best.share >= _SURE) or look is None:
                    break
                can_tell = can_tell or is_detectable(ground, look)
                one = find_object(chart, ground, look, _ASIDE if was_hidden else 0.0)
                if one is not None and _is_better(one, best):
                    best, turn = one, angle
        if best is None:
            return can_tell, None
        position = expected + self._on_ground(best.offset * self._cell)
        pixel = pixel_of(estimate, position)
        if pixel is None:
            return can_tell, None
        self._course += turn
        self._learn(gray, estimate, position, best.share)
        return True, FollowedPosition(position, pixel, best.share)

    def _look(self, grey: Grey | None, angle: float) -> TargetAppearance | None:
        """An isolated target's appearance, rotated by `angle`; None if it leaves the chart."""
        if grey is None or self._outline is None:
            return None
        turned = self._turned(self._outline.astype(np.float32), angle)
        grey = self._turned(grey, angle)
        if turned is None or grey is None:
            return None
        return TargetAppearance.of(grey, (turned > 0.5).astype(np.uint8))

    def _learn(self, gray: Gray, estimate: PoseEstimate, position: Array, share: float) -> None:
        """Learn the present appearance: once when the target leaves the ground where it was clicked
        (which is part of the first appearance), then from time to time. share: visible part.
        """
        gone_m = float(np.linalg.norm(position - self._origin))
        is_due = estimate.exposure_time_ns - self._renewed_ns >= _RENEWED_NS
        leaves = share >= _SURE and gone_m >= self._learns_m
        if not leaves and not (share >= _WHOLE and is_due):
            return
        fresh = self._chart(gray, estimate, position, self._half)
        if fresh is None:
            return
        self._late, self._renewed_ns = fresh, estimate.exposure_time_ns
        if leaves:
            self._first, self._usual = fresh, 0.0
            is_off = gone_m >= 2.0 * self._half_m
            self._learns_m = np.inf if is_off else gone_m + 0.5 * self._half_m

    def isolate(self, pictures: Sequence[tuple[PoseEstimate, Gray]]) -> bool:
        """Separate the target from the ground, by images of its first position without it; False if
        that is impossible because it does not move or the images do not show it.

        In rectified images the ground is fixed, so a difference from their median is a moving
        object. A grey car on a grey road differs in several parts; all parts about its middle count
        as the car.
        """
        charts = [
            self._chart(gray, estimate, self._origin, self._half, course=0.0)
            for estimate, gray in pictures
        ]
        known = [chart for chart in charts if chart is not None]
        if not known or self._first is None:
            return False
        ground = np.median(known, axis=0).astype(np.float32)
        off = self._first - ground
        off = np.abs(off - np.median(off))  # the camera may expose otherwise by now
        off = cv2.GaussianBlur(off.astype(np.float32), (0, 0), 1.0)
        least = max(_OTHER, _NOISES * float(np.median(off)))
        mask = _outline((off > least).astype(np.uint8), self._half)
        share = 0.0 if mask is None else float(mask.mean())
        if mask is None or not _SHARES[0] <= share <= _SHARES[1]:
            return False
        self._mask = cv2.dilate(mask, np.ones((3, 3))).astype(np.float32)
        look = TargetAppearance.of(self._first, mask)
        if float(look.inside.sum()) >= _INSIDE:
            self._outline, self._ground, self._isolated_look = mask, ground, look
        return True

    def watch(self, gray: Gray, estimate: PoseEstimate, position: Array) -> bool:
        """Process a frame of a static target at position (3,); returns whether it `is_changed`."""
        chart = self._chart(gray, estimate, position, self._half, course=0.0)
        if chart is not None:
            self._stands.update(estimate.exposure_time_ns, chart)
        return self._stands.is_changed

    @property
    def is_changed(self) -> bool:
        """Whether, by the frames of `watch`, a static target's image changed suddenly and stayed
        so: it left or is covered.
        """
        return self._stands.is_changed

    def shows_ground(self, gray: Gray, estimate: PoseEstimate) -> bool:
        """Whether an isolated target's first position shows the ground: the target left. False if
        it was never isolated, or the position is not in view.
        """
        chart = self._chart(gray, estimate, self._origin, self._half, course=0.0)
        if chart is None or self._isolated_look is None or self._ground is None:
            return False
        return is_ground(chart, self._ground, self._isolated_look)

    def forget_shape(self) -> None:
        """Undo `isolate` for the search; `shows_ground` still knows the ground and the target."""
        self._mask = self._outline = None

    @property
    def is_isolated(self) -> bool:
        """Whether target and ground cells are separated (`isolate`)."""
        return self._mask is not None

    def _turned(self, chart: Grey | None, angle: float) -> Grey | None:
        """A chart rotated by `angle`."""
        if chart is None or angle == 0.0:
            return chart
        c, s, h = np.cos(angle), np.sin(angle), float(self._half)
        back = np.array([[c, -s, h - c * h + s * h], [s, c, h - s * h - c * h]])
        turned: NDArray[np.float32] = cv2.warpAffine(
            chart, back, chart.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        return turned

    def _renew(self, gray: Gray, estimate: PoseEstimate, position: Array) -> None:
        fresh = self._chart(gray, estimate, position, self._half)
        if fresh is None or self._first is None:
            return
        # What has come before it, or what it passes, must not become its look.
        if _match(fresh, self._first, self._mask, 0)[0] >= _SEEN:
            self._late, self._renewed_ns = fresh, estimate.exposure_time_ns

    def _on_ground(self, along: Array) -> Array:
        """A vector (2,) along the chart's rows and columns as a world vector (3,), metres."""
        c, s = np.cos(self._course), np.sin(self._course)
        return np.array([c * along[0] - s * along[1], s * along[0] + c * along[1], 0.0])

    def _chart(
        self,
        gray: Gray,
        estimate: PoseEstimate,
        middle: Array,
        half: int,
        course: float | None = None,
    ) -> Grey | None:
        """(2 half + 1, 2 half + 1) grey levels about `middle`; None if some are not in view."""
        steps = np.arange(-half, half + 1) * self._cell
        turned = self._course if course is None else course
        c, s = np.cos(turned), np.sin(turned)
        x, y = np.meshgrid(steps, steps)
        points = np.stack([middle[0] + c * x - s * y, middle[1] + s * x + c * y,
                           np.full_like(x, middle[2])], axis=-1)  # fmt: skip
        pose = estimate.world_from_camera
        pixels, inside = estimate.camera.project((points - pose.translation) @ pose.rotation)
        if not inside[half, half] or float(np.mean(inside)) < 0.6:
            return None
        at = np.nan_to_num(pixels - 0.5, nan=-1e3).astype(np.float32)
        chart = cv2.remap(gray, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(chart, dtype=np.float32)


def _is_better(one: AppearanceCoverage, best: AppearanceCoverage | None) -> bool:
    return best is None or one.evidence > (1.0 + _PREFERRED) * best.evidence


def _outline(differs: NDArray[np.uint8], half: int) -> NDArray[np.uint8] | None:
    """Mask (1 inside) of the convex outline of what differs about a chart's centre; None if that
    does not contain the centre, so it is another object.
    """
    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        cv2.morphologyEx(differs, cv2.MORPH_CLOSE, np.ones((3, 3)))
    )
    reach = max(1, round(_ABOUT * half))
    about = labels[half - reach : half + reach + 1, half - reach : half + reach + 1]
    parts = [k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] >= _PART and k in about]
    if not parts:
        return None
    rows, columns = np.nonzero(np.isin(labels, parts))
    outline = cv2.convexHull(np.column_stack([columns, rows]).astype(np.int32))
    mask = np.zeros_like(differs)
    cv2.fillConvexPoly(mask, outline, 1)
    return mask if mask[half - 1 : half + 2, half - 1 : half + 2].any() else None


def _match(
    chart: NDArray[np.float32],
    template: NDArray[np.float32],
    mask: Grey | None,
    reach: int,
    aside: float = 0.0,
) -> tuple[float, Array]:
    """(correlation, offset in cells (2,), x then y) of the best position; 0 if a second one is as
    good.

    aside: by how much a match at the end of the search range counts less.
    """
    scores = cv2.matchTemplate(chart, template, cv2.TM_CCOEFF_NORMED, mask=mask)
    scores = np.nan_to_num(scores, nan=-1.0, posinf=-1.0, neginf=-1.0)
    scores -= aside * squared_share(reach)
    _, best, _, (x, y) = cv2.minMaxLoc(scores)
    second = second_best(scores, x, y, len(template), least=-1.0)
    offset = peak_offset(scores, x, y, reach)
    return (float(best) if best >= _CLEAR * second else 0.0), offset


_MIDDLE = 0.45  # of a chart's half side
_SHIFT = 2  # cells by which the pose may err
_BEFORE_NS = 1_000_000_000
_DIFFERS = 9.0  # grey levels, root mean square: noise and compression stay below
_CELLS_OFF = 0.35  # what edges make of the rest of the pose's error, below a cell
_TIMES = 3.0  # what is usual at this place: edges differ by more as the view changes
_LEARNS_NS = 1_000_000_000  # what is usual, before anything is not


class StaticAppearance:
    """Appearance of one target over time. Not thread-safe. is_changed: whether it changed suddenly
    and has stayed so.
    """

    def __init__(self) -> None:
        self._kept: deque[tuple[int, Grey]] = deque()
        self._before: Grey | None = None
        self._usual = 0.0
        self._begun_ns = 0
        self.is_changed = False

    def update(self, time_ns: int, chart: Grey) -> None:
        """Process the target's chart (square, of one size and course) in the next frame."""
        while len(self._kept) > 1 and time_ns - self._kept[1][0] >= _BEFORE_NS:
            self._kept.popleft()
        before = self._before
        if before is None and self._kept and time_ns - self._kept[0][0] >= 0.5 * _BEFORE_NS:
            before = self._kept[0][1]
        if before is not None:
            off, edges = _difference(before, chart)
            self._begun_ns = self._begun_ns or time_ns
            is_known = time_ns - self._begun_ns >= _LEARNS_NS
            least = max(_DIFFERS, _CELLS_OFF * edges, _TIMES * self._usual)
            self.is_changed = is_known and off > least
            if self.is_changed:
                self._before = before
                return
            if self._before is not None:
                self._before = None
                self._kept.clear()
            self._usual += (_LATELY if self._usual else 1.0) * (off - self._usual)
        self._kept.append((time_ns, chart))


def _difference(before: Grey, chart: Grey) -> tuple[float, float]:
    """Root mean squares over the chart's middle: its grey level difference where it fits best, and
    its change from cell to cell.
    """
    half = len(before) // 2
    k = max(2, round(_MIDDLE * half))
    middle = before[half - k : half + k + 1, half - k : half + k + 1]
    reach = min(_SHIFT, half - k)
    around = chart[half - k - reach : half + k + reach + 1, half - k - reach : half + k + reach + 1]
    level = np.float32(np.median(chart - before))  # the camera may expose otherwise by now
    least = float(cv2.matchTemplate(around, middle + level, cv2.TM_SQDIFF).min())
    down, right = np.gradient(middle)
    edges = float(np.sqrt(np.mean(down**2 + right**2)))
    return float(np.sqrt(max(least, 0.0) / middle.size)), edges
