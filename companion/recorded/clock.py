"""Estimates the offset between the clocks of images and log, by exposure messages or by motion.

By motion: features move between two images as the log's attitudes and positions predict, over flat
ground. The offset with the smallest residual is the result.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone

import cv2
import numpy as np
from scipy.stats import binom

from companion.recorded.flight import Datum, RecordedFrame, Telemetry, Track
from companion.sources.folder_source import read_image
from localizer.geometry.camera import Camera
from localizer.geometry.geo import NED_FROM_ENU, Geodetic, LocalFrame
from localizer.geometry.pose import Array

_WIDTH_PX = 640
_FEATURES, _LEAST_MATCHES, _MOST_PAIRS = 1500, 25, 30
_LONGEST_S = 3.0  # between two images of a pair: further apart they share too little ground
_COARSE_S, _FINE_S = 0.2, 0.02
# Of a real flight's and made-up ones: a right offset leaves 0.1 to 0.7 degrees and is found by 4
# pairs; in another flight's log these bounds let none of 1,029 searches by 4 to 15 pairs through.
_LEAST_PAIRS, _MOST_LEFT_DEG = 4, 1.5
_ALONE = 0.6  # of the second minimum: where the flight looks alike twice, both are as low
_MOST_CHANCE = 0.003  # that a log of another flight fits so well somewhere in the reach
_LEAST_HEIGHT_M = 5.0
_LEAST_IMAGES = 4  # whose intervals are compared with those of exposures
_ALIGNED = 8  # of the images, each in turn with every exposure
_TAG_NS = 600_000_000  # EXIF's times may be whole seconds


@dataclass(frozen=True)
class ClockOffset:
    """Offset of an autopilot log's clock from the images'. offset_s: to add to the images' times.
    residual_deg: median of the features at this offset; second_deg: at the next best offset,
    infinite without one; pairs: number of image pairs used; chance: probability that another
    flight's log reaches so low a residual.
    """

    offset_s: float
    residual_deg: float
    second_deg: float
    pairs: int
    chance: float

    @property
    def is_decisive(self) -> bool:
        """Whether only one offset fits, and not by chance."""
        fits = self.pairs >= _LEAST_PAIRS and self.residual_deg < _MOST_LEFT_DEG
        is_alone = self.residual_deg < _ALONE * self.second_deg
        return fits and is_alone and self.chance < _MOST_CHANCE

    @property
    def text(self) -> str:
        """The values as text for the user."""
        offset = f"{self.offset_s:+.2f} s"
        if abs(self.offset_s) > 86_400.0:  # a video's clock begins at 0
            begin = datetime.fromtimestamp(self.offset_s, timezone.utc)
            offset = f"the video begins at {begin:%Y-%m-%d %H:%M:%S} UTC"
        return (
            f"{offset} by motion ({self.pairs} pairs of images, "
            f"{self.residual_deg:.2f} degrees left, {self.second_deg:.2f} at the next best offset; "
            f"by chance: {self.chance:.1g})"
        )


@dataclass(frozen=True)
class _Pair:
    """Rays (N, 3) of the same features in two images, with the images' times."""

    begin_ns: int
    end_ns: int
    first: Array
    second: Array


def find_offset(
    frames: Sequence[RecordedFrame], camera: Camera, track: Track, reach_s: tuple[float, float]
) -> ClockOffset | None:
    """Estimate the offset within reach_s (least, greatest), s, from pairs of the frames' images;
    takes seconds. None with too few images of features, or if the track does not cover them. Only a
    result that `is_decisive` is to be used.
    """
    pairs = _pairs(frames, camera)
    if len(pairs) < 2:
        return None
    origin = next((s.position for s in (track.at(int(t)) for t in track.times_ns) if s), None)
    if origin is None:
        return None
    frame = LocalFrame(Geodetic(origin.latitude_deg, origin.longitude_deg, 0.0))
    coarse = np.arange(reach_s[0], reach_s[1] + _COARSE_S / 2, _COARSE_S)
    residuals = np.array([_residuals(pairs, track, frame, float(o)) for o in coarse])
    scores = np.array([_score(row) for row in residuals])
    if not np.isfinite(scores).any():
        return None
    best = int(np.nanargmin(scores))
    fine = coarse[best] + np.arange(-_COARSE_S, _COARSE_S + _FINE_S / 2, _FINE_S)
    close = np.array([_score(_residuals(pairs, track, frame, float(o))) for o in fine])
    k = int(np.nanargmin(close))
    outside = _outside_valley(scores, best)
    second = float(np.nanmin(scores[outside], initial=np.inf))
    found = float(fine[k]), float(np.degrees(close[k])), float(np.degrees(second))
    return ClockOffset(*found, len(pairs), _chance(residuals, outside, float(close[k])))


def _outside_valley(scores: Array, best: int) -> np.ndarray:
    """Mask of the offsets outside the best one's valley, which ends where the score has come
    halfway up to the typical one.
    """
    rim = 0.5 * (float(scores[best]) + float(np.nanmedian(scores)))
    above = np.flatnonzero(scores > rim)
    begin = int(max(above[above < best], default=-1))
    end = int(min(above[above > best], default=len(scores)))
    outside = np.isfinite(scores)
    outside[begin + 1 : end] = False
    return outside


def _chance(residuals: Array, outside: np.ndarray, best: float) -> float:
    """Probability that another log gives a median residual as low as the best, from this many
    pairs. Each pair's residual is so low at some share of the other offsets. As many valleys were
    tried as fit into the range of offsets. Half of the pairs count, because neighbours share an
    image.
    """
    elsewhere = residuals[outside]
    known = np.isfinite(elsewhere)
    if not known.any():
        return 1.0
    share = float((elsewhere[known] <= best).mean())
    count = (residuals.shape[1] + 1) // 2
    width = max(int((~outside).sum()), 1)
    tail = float(binom.sf(count // 2, count, max(share, 1.0 / known.sum())))
    return min(1.0, tail * len(residuals) / width)


def _pairs(frames: Sequence[RecordedFrame], camera: Camera) -> list[_Pair]:
    detector = cv2.ORB.create(_FEATURES)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    dated = [f for f in frames if f.time_ns is not None]
    couples = [
        (a, b)
        for a, b in itertools.pairwise(dated)
        if 0 < (b.time_ns or 0) - (a.time_ns or 0) <= 1e9 * _LONGEST_S
    ]
    chosen = np.unique(np.linspace(0, len(couples) - 1, min(len(couples), _MOST_PAIRS)).astype(int))
    seen: dict[str, tuple[Array, np.ndarray] | None] = {}

    def features(frame: RecordedFrame) -> tuple[Array, np.ndarray] | None:
        if frame.name not in seen:
            seen[frame.name] = _features(frame, camera, detector)
        return seen[frame.name]

    pairs = []
    for k in chosen if couples else ():
        a, b = couples[int(k)]
        first, second = features(a), features(b)
        if first is None or second is None:
            continue
        matches = matcher.match(first[1], second[1])
        if len(matches) < _LEAST_MATCHES:
            continue
        x = first[0][[m.queryIdx for m in matches]]
        y = second[0][[m.trainIdx for m in matches]]
        _, inside = cv2.findHomography(x[:, :2], y[:, :2], cv2.RANSAC, 3.0 / camera.fx)
        if inside is None:
            continue
        good = np.flatnonzero(inside.ravel())
        if len(good) >= _LEAST_MATCHES:
            pairs.append(_Pair(a.time_ns or 0, b.time_ns or 0, x[good], y[good]))
    return pairs


def _features(
    frame: RecordedFrame, camera: Camera, detector: cv2.ORB
) -> tuple[Array, np.ndarray] | None:
    """Rays (N, 3) and descriptors of an image's features."""
    image = cv2.cvtColor(read_image(frame.path), cv2.COLOR_RGB2GRAY)
    height = round(image.shape[0] * _WIDTH_PX / image.shape[1])
    small = cv2.resize(image, (_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    small = cv2.createCLAHE(2.0, (8, 8)).apply(small)  # exposures change from image to image
    points, descriptors = detector.detectAndCompute(small, None)
    if descriptors is None:
        return None
    scaled = camera.resized(_WIDTH_PX, height)
    return scaled.rays(np.array([p.pt for p in points]) + 0.5), descriptors


def _residuals(pairs: Sequence[_Pair], track: Track, frame: LocalFrame, offset_s: float) -> Array:
    """(P,) for each pair the median angle (rad) between its features and where the log predicts
    them; NaN outside the log.
    """
    shift = round(1e9 * offset_s)
    found = np.full(len(pairs), np.nan)
    for k, pair in enumerate(pairs):
        a, b = track.at(pair.begin_ns + shift), track.at(pair.end_ns + shift)
        first, second = _camera(a, frame), _camera(b, frame)
        if first is None or second is None:
            continue
        (R, p, height), (S, q, _) = first, second
        rays = pair.first @ R.T
        down = rays[:, 2] > 0.1
        if not down.any():
            continue
        points = p + rays[down] * (height / rays[down, 2])[:, None]
        away = (points - q) @ S
        off = away[:, :2] / np.maximum(away[:, 2:], 1e-3) - pair.second[down, :2]
        found[k] = np.median(np.hypot(off[:, 0], off[:, 1]))
    return found


def _score(residuals: Array) -> float:
    """Score of one offset; NaN if less than half of the pairs lie in the log."""
    known = residuals[np.isfinite(residuals)]
    is_enough = len(known) >= max(2, len(residuals) // 2)
    return float(np.median(known)) if is_enough else float("nan")


def _camera(sample: Telemetry | None, frame: LocalFrame) -> tuple[Array, Array, float] | None:
    """Attitude (3, 3) to NED, position (3,) in NED and height above the take-off, m; or None."""
    if sample is None or sample.position is None or sample.view is None:
        return None
    height = sample.position.height_m(Datum.TAKEOFF)
    if height is None or height < _LEAST_HEIGHT_M:
        return None
    enu = frame.enu_from_geodetic(sample.position.latitude_deg, sample.position.longitude_deg, 0.0)
    place = np.asarray(NED_FROM_ENU @ np.asarray(enu))
    return sample.view.ned_from_camera, np.array([place[0], place[1], -height]), height


def exposures_of(
    times_ns: Sequence[int | None], exposures: Sequence[Telemetry]
) -> tuple[Telemetry, ...] | None:
    """Assign one of the log's exposures to each image: by their intervals, if exactly one clock
    offset fits all images; for images without times by their order, if the numbers are equal.
    Otherwise None.
    """
    if all(t is None for t in times_ns):
        return tuple(exposures) if len(times_ns) == len(exposures) else None
    times = np.array([t for t in times_ns if t is not None], dtype=np.int64)
    at = np.array([e.time_ns for e in exposures], dtype=np.int64)
    if not _LEAST_IMAGES <= len(times) == len(times_ns) <= len(at):
        return None
    aligned = np.linspace(0, len(times) - 1, _ALIGNED).round().astype(int)  # stamps are rough
    fits = {
        fit
        for image in {int(k) for k in aligned}
        for exposure in at
        if (fit := _fit(times - times[image], at - exposure)) is not None
    }
    return tuple(exposures[k] for k in fits.pop()) if len(fits) == 1 else None


def _fit(times: np.ndarray, at: np.ndarray) -> tuple[int, ...] | None:
    """Index of the exposure next to each image; None unless each image has one of its own."""
    after = np.clip(np.searchsorted(at, times), 1, max(len(at) - 1, 1))
    near = np.where(times - at[after - 1] < at[after] - times, after - 1, after)
    off = (at[near] - times).astype(np.float64)
    is_close = np.abs(off - np.median(off)).max() <= _TAG_NS
    return tuple(map(int, near)) if is_close and (np.diff(near) > 0).all() else None
