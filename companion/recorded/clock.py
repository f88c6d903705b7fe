"""The offset between the clock of images and that of a log, found by motion.

Between two images, features move as the log's attitudes and positions say, over flat ground below
the take-off height. The offset under which they do so best is the clocks'.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from companion.recorded.flight import Datum, RecordedFrame, Telemetry, Track
from companion.sources.folder_source import read_image
from localizer.geometry.camera import Camera
from localizer.geometry.geo import NED_FROM_ENU, Geodetic, LocalFrame
from localizer.geometry.pose import Array

_WIDTH_PX = 640
_FEATURES, _LEAST_MATCHES, _MOST_PAIRS = 1500, 25, 30
_LONGEST_S = 3.0  # between two images of a pair: further apart they share too little ground
_COARSE_S, _FINE_S = 0.2, 0.02
_DECISIVE = 0.7  # of the typical residual: a clear minimum lies below it
_LEAST_HEIGHT_M = 5.0


@dataclass(frozen=True)
class ClockOffset:
    """offset_s: to be added to the images' times to be the log's. residual: of the features, as an
    angle in degrees, at the offset and typically elsewhere. pairs: of images that told it.
    """

    offset_s: float
    residual_deg: float
    elsewhere_deg: float
    pairs: int

    @property
    def is_decisive(self) -> bool:
        """Whether one offset fits clearly better than others."""
        return self.pairs >= 2 and self.residual_deg < _DECISIVE * self.elsewhere_deg


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
    """The offset within `reach_s` (least, greatest); None where too few images can be compared."""
    pairs = _pairs(frames, camera)
    if len(pairs) < 2:
        return None
    origin = next((s.position for s in (track.at(int(t)) for t in track.times_ns) if s), None)
    if origin is None:
        return None
    frame = LocalFrame(Geodetic(origin.latitude_deg, origin.longitude_deg, 0.0))
    coarse = np.arange(reach_s[0], reach_s[1] + _COARSE_S / 2, _COARSE_S)
    scores = np.array([_residual(pairs, track, frame, float(o)) for o in coarse])
    if not np.isfinite(scores).any():
        return None
    best = float(coarse[int(np.nanargmin(scores))])
    fine = np.arange(best - _COARSE_S, best + _COARSE_S + _FINE_S / 2, _FINE_S)
    close = np.array([_residual(pairs, track, frame, float(o)) for o in fine])
    k = int(np.nanargmin(close))
    typical = float(np.nanmedian(scores))
    return ClockOffset(
        float(fine[k]), float(np.degrees(close[k])), float(np.degrees(typical)), len(pairs)
    )


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


def _residual(pairs: Sequence[_Pair], track: Track, frame: LocalFrame, offset_s: float) -> float:
    """Median angle (rad) between features and where the log has them; NaN outside the log."""
    shift = round(1e9 * offset_s)
    found = []
    for pair in pairs:
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
        seen = pair.second[down]
        off = away[:, :2] / np.maximum(away[:, 2:], 1e-3) - seen[:, :2]
        found.append(float(np.median(np.hypot(off[:, 0], off[:, 1]))))
    return float(np.median(found)) if len(found) >= max(2, len(pairs) // 2) else float("nan")


def _camera(sample: Telemetry | None, frame: LocalFrame) -> tuple[Array, Array, float] | None:
    """Attitude (3, 3), place (3,) in NED and height above the take-off, m."""
    if sample is None or sample.position is None or sample.view is None:
        return None
    height = next((h.value_m for h in sample.position.heights if h.datum is Datum.TAKEOFF), None)
    if height is None or height < _LEAST_HEIGHT_M:
        return None
    enu = frame.enu_from_geodetic(sample.position.latitude_deg, sample.position.longitude_deg, 0.0)
    place = np.asarray(NED_FROM_ENU @ np.asarray(enu))
    return sample.view.ned_from_camera, np.array([place[0], place[1], -height]), height
