"""Detects identical, frozen and repeated frames.

A localizer registers a frozen frame as well as a fresh one, and the clock of a hung encoder runs
on. But a flying camera always moves: the aircraft's sway moves the image by more than the hundredth
of a pixel to which two images can be compared. The comparison is a least-squares fit of shift,
rotation, scale, gain and offset between two thumbnails. Encoder errors, noise and another exposure
do not move edges, so they do not count as motion.
"""

from __future__ import annotations

import heapq
import zlib
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from localizer.pictures import shrink
from localizer.types import Image

Thumbnail = NDArray[np.float32]
WIDTH, HEIGHT = 64, 48  # of a thumbnail
STILL_SHARE = 3e-4  # motion below which a frame is frozen, as a share of its width
REPEAT_S = 2.0  # length of a repetition that is reported
LOW_DETAIL = 2.0  # `FrameVerdict.detail` that is too low; refusals begin below it (real.md)
_REPEAT_MEMORY_S = 60.0  # time over which repetition is searched
_BLOCK = 4
_HALVED_FROM = 8  # times the thumbnail's size: with 4, `detail` falls by 3 %
_CRC_ROWS = 8  # every eighth row is enough to tell two pictures of a sensor apart
_UNLIKE_GRAY = 2.0  # root mean square difference beyond which a fit need not be tried
_MOST_GAIN = 3.0  # ratio of contrasts that another exposure makes; of a covered lens it is 10
_SURE = 2e-4  # a fit with a larger sigma says nothing: the picture has no content
_MEDIAN_OF = 5
_CANDIDATES = 3  # for a loop, of a minute's pictures
_FILLED = 0.7  # of the memory's pictures within a loop's time must match
_MOVES = 10.0  # a path that repeats must be so many times longer than what counts as equal
_LAG_SLACK_NS = 150_000_000
_MEMORY_STEP_NS = 180_000_000


@dataclass(frozen=True)
class FrameVerdict:
    """Result of the video checks. still_s: how long the image has not moved; identical_s: how long
    the frames have been bit-identical.

    repeat_lag_s: age of the frames that are repeated; 0 for new frames. contrast: standard
    deviation of the thumbnail, gray levels of 255; detail: standard deviation of a block of 4 by 4
    pixels of it, median over all blocks.
    """

    still_s: float
    identical_s: float
    repeat_lag_s: float
    contrast: float
    detail: float


@dataclass(frozen=True)
class ImageShift:
    """Displacement of the image's edge between two images, as a share of the width; sigma."""

    share: float
    sigma: float


@dataclass(frozen=True)
class _SeenFrame:
    time_ns: int
    crc: int
    thumbnail: Thumbnail
    contrast: float
    plain: Thumbnail
    """The thumbnail at a contrast of 1: another exposure changes nothing."""


def _seen_frame(time_ns: int, image: Image) -> _SeenFrame:
    small = thumbnail(image)
    contrast = float(small.std())
    crc = zlib.crc32(image[::_CRC_ROWS].tobytes())
    return _SeenFrame(time_ns, crc, small, contrast, small / np.float32(max(contrast, 1e-3)))


class FrozenVideoDetector:
    """Detects frozen and repeated video. Takes as many frames as possible; one thread."""

    def __init__(self) -> None:
        self._reference: _SeenFrame | None = None
        self._newest: _SeenFrame | None = None
        self._identical_since_ns = 0
        self._last_shares: deque[float] = deque(maxlen=_MEDIAN_OF)
        self._loop = RepeatedVideoDetector()

    def add(self, time_ns: int, image: Image) -> FrameVerdict:
        """Add a frame (H, W, 3) uint8 RGB at its exposure time; returns the result."""
        seen = _seen_frame(time_ns, image)
        last, self._newest = self._newest, seen
        if last is None or last.crc != seen.crc:
            self._identical_since_ns = time_ns
        self._keep_reference(seen)
        reference_ns = self._reference.time_ns if self._reference is not None else time_ns
        identical_s = (time_ns - self._identical_since_ns) * 1e-9
        return FrameVerdict(
            max((time_ns - reference_ns) * 1e-9, identical_s),
            identical_s,
            self._loop.add(seen),
            seen.contrast,
            detail(seen.thumbnail),
        )

    def _keep_reference(self, seen: _SeenFrame) -> None:
        """Replace the reference frame if the image has moved since. The median of five frames
        excludes an encoder's key frames.
        """
        if self._reference is None:
            self._reference = seen
            return
        self._last_shares.append(shift_between(self._reference, seen))
        shares = sorted(self._last_shares)
        if shares[len(shares) // 2] > STILL_SHARE:
            self._reference = seen
            self._last_shares.clear()


class RepeatedVideoDetector:
    """Detects frames that repeat earlier ones at a constant lag, while the image moves."""

    def __init__(self) -> None:
        self._hold_ns = int(REPEAT_S * 1e9)
        self._memory: deque[_SeenFrame] = deque()
        self._matches: deque[tuple[int, int]] = deque()  # time and lag

    def add(self, seen: _SeenFrame) -> float:
        """Add a frame, in order of its time. Returns the lag (s) at which the newest frames repeat
        earlier ones, or 0 if they are new.
        """
        before = [old for old in self._memory if seen.time_ns - old.time_ns >= self._hold_ns]
        for old in heapq.nsmallest(_CANDIDATES, before, key=lambda old: difference_gray(old, seen)):
            if shift_between(old, seen) < STILL_SHARE:
                self._matches.append((seen.time_ns, seen.time_ns - old.time_ns))
        while self._matches and seen.time_ns - self._matches[0][0] > self._hold_ns:
            self._matches.popleft()
        self._remember(seen)
        return self._lag_s(seen.time_ns)

    def _lag_s(self, now_ns: int) -> float:
        """The newest lag, s, if matches of this lag last and the image moved; otherwise 0."""
        if not self._matches:
            return 0.0
        lag_ns = self._matches[-1][1]
        times = [t for t, lag in self._matches if abs(lag - lag_ns) <= _LAG_SLACK_NS]
        steps = self._hold_ns / _MEMORY_STEP_NS
        if now_ns - times[0] < 0.8 * self._hold_ns or len(times) < _FILLED * steps:
            return 0.0
        path = [old for old in self._memory if old.time_ns >= times[0]]
        far = max(shift_between(path[0], other) for other in path)
        return lag_ns * 1e-9 if far > _MOVES * STILL_SHARE else 0.0

    def _remember(self, seen: _SeenFrame) -> None:
        if self._memory and seen.time_ns - self._memory[-1].time_ns < _MEMORY_STEP_NS:
            return
        self._memory.append(seen)
        oldest_ns = seen.time_ns - int(_REPEAT_MEMORY_S * 1e9)
        while self._memory[0].time_ns < oldest_ns:
            self._memory.popleft()


def shift_between(a: _SeenFrame, b: _SeenFrame) -> float:
    """Displacement between two frames, as a share of the width; 1 if it cannot be measured."""
    if a.crc == b.crc:
        return 0.0
    low, high = sorted((a.contrast, b.contrast))
    if difference_gray(a, b) > _UNLIKE_GRAY or high > _MOST_GAIN * low:
        return 1.0
    moved = measure_motion(a.thumbnail, b.thumbnail)
    return moved.share if moved.sigma < _SURE else 1.0


def difference_gray(a: _SeenFrame, b: _SeenFrame) -> float:
    """Root mean square difference of two frames scaled to one contrast, gray levels of 255."""
    return float(np.sqrt(np.mean(np.square(a.plain - b.plain)))) * min(a.contrast, b.contrast)


def detail(small: Thumbnail) -> float:
    """Local contrast of a thumbnail (48, 64), gray levels of 255; see `FrameVerdict`."""
    blocks = small.reshape(HEIGHT // _BLOCK, _BLOCK, WIDTH // _BLOCK, _BLOCK)
    return float(np.median(blocks.std(axis=(1, 3))))


def thumbnail(image: Image) -> Thumbnail:
    """Luminance (48, 64) of a frame (H, W, 3), gray levels of 255, minus their mean."""
    small = shrink(image, (WIDTH, HEIGHT), _HALVED_FROM).astype(np.float32)
    gray = small @ np.array([0.299, 0.587, 0.114], np.float32)
    return np.asarray(gray - gray.mean(), np.float32)


_V, _U = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
_X, _Y = (_U - (WIDTH - 1) / 2) / WIDTH, (_V - (HEIGHT - 1) / 2) / WIDTH  # shares of the width


def measure_motion(a: Thumbnail, b: Thumbnail) -> ImageShift:
    """Least-squares motion from a to b (48, 64): displacement at the image's edge by shift,
    rotation and scale.

    It is linear, so it is exact for motions up to a pixel of the thumbnail; larger motions give a
    value that is wrong but not zero, which is sufficient.
    """
    mean = 0.5 * (a + b)
    gv, gu = np.gradient(mean)
    gu, gv = gu * WIDTH, gv * WIDTH  # per share of the width
    columns = (gu, gv, gv * _X - gu * _Y, gu * _X + gv * _Y, mean, np.ones_like(mean))
    J = np.stack([c.ravel() for c in columns], axis=1).astype(np.float64)
    difference = (a - b).ravel().astype(np.float64)
    N = J.T @ J
    N[np.diag_indices(6)] += 1e-6 * np.trace(N) / 6 + 1e-9
    inverse = np.linalg.inv(N)
    x = inverse @ (J.T @ difference)
    variance = float(np.mean(np.square(difference - J @ x)))
    arms = np.array([1.0, 1.0, 0.5, 0.5])  # a rotation or scale moves the edge by half the width
    moved = np.abs(x[:4]) * arms
    sigma = np.sqrt(variance * inverse.diagonal()[:4]) * arms
    return ImageShift(float(np.hypot(moved[0], moved[1]) + moved[2] + moved[3]), float(sigma.max()))
