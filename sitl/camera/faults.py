"""Video faults of the simulation: covered or blinded lens, dusk, frozen video, wrong stamps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from localizer.types import Image

PictureFaultKind = Literal[
    "covered", "blinded", "darkens", "frozen", "stamped_late", "late", "silent"
]

_COVERED_LEVEL, _COVERED_NOISE = 9.0, 4.0  # of 255: a lens cap, and the sensor's read noise
_BLINDED_LEVEL, _BLINDED_NOISE = 205.0, 3.0  # inside a cloud: bright, even, next to no contrast
_WHITE, _READ, _NATIVE_PX = 6000.0, 2.5, 1280  # electrons; a sensor of 1.5 um pixels
_GAMMA, _QUALITY = 2.2, 70
_MOST_GAIN = 16.0


def darken(rgb: Image, light: float, most_gain: float, rng: np.random.Generator) -> Image:
    """An image (H, W, 3) as the camera takes it with the share `light` of the light: amplified by
    at most most_gain, with noise, coded as JPEG. An image below the native width counts as binned.
    """
    binned = (_NATIVE_PX / rgb.shape[1]) ** 2
    white, read = _WHITE * binned, _READ * np.sqrt(binned)
    electrons = (rgb.astype(np.float32) / 255.0) ** _GAMMA * (white * light)
    noise = rng.standard_normal(electrons.shape, dtype=np.float32)
    electrons += noise * np.sqrt(electrons + read**2)
    shown = np.clip(electrons * min(1.0 / light, most_gain) / white, 0.0, 1.0) ** (1.0 / _GAMMA)
    dark = (shown * 255.0 + 0.5).astype(np.uint8)
    _, data = cv2.imencode(".jpg", dark[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    decoded = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)
    return np.ascontiguousarray(decoded[..., ::-1])


@dataclass(frozen=True)
class PictureFault:
    """A video fault that lasts until the next one.

    covered: a lens cap. blinded: cloud or fog. darkens: the light halves every `seconds`, with a
    gain of up to 16. frozen: the last frame is sent again and again with new timestamps.
    stamped_late: the timestamp is `seconds` after the exposure. late: the frame is sent `seconds`
    late with the time of sending as its timestamp, as by a camera that ignores its latency. silent:
    no frame is sent.
    """

    kind: PictureFaultKind
    seconds: float = 0.0


class VideoFaultInjector:
    """Applies the current video fault, if any, to each frame."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng([seed, 23])
        self._fault: PictureFault | None = None
        self._last: Image | None = None
        self._began_ns: int | None = None

    @property
    def is_silent(self) -> bool:
        """Whether no frame is sent at all."""
        return self._fault is not None and self._fault.kind == "silent"

    def set(self, fault: PictureFault | None) -> None:
        """Set the fault from the next frame on; None ends it."""
        self._fault, self._began_ns = fault, None

    def apply(self, image: Image, time_ns: int) -> Image:
        """The frame that is sent instead of `image` (H, W, 3) uint8, exposed at time_ns."""
        kind = self._fault.kind if self._fault is not None else None
        if self._began_ns is None:
            self._began_ns = time_ns
        if kind == "frozen" and self._last is not None:
            return self._last
        self._last = image
        if kind == "covered":
            return self._even(image, _COVERED_LEVEL, _COVERED_NOISE)
        if kind == "blinded":
            return self._even(image, _BLINDED_LEVEL, _BLINDED_NOISE)
        if self._fault is not None and kind == "darkens":
            halvings = (time_ns - self._began_ns) * 1e-9 / self._fault.seconds
            return darken(image, 0.5**halvings, _MOST_GAIN, self._rng)
        return image

    def stamp(self, exposure_ns: int) -> int:
        """The time stamp to send for a frame that was exposed at `exposure_ns`."""
        return exposure_ns + self._ns_of("stamped_late", "late")

    @property
    def delay_ns(self) -> int:
        """Time for which a frame is delayed before it is sent."""
        return self._ns_of("late")

    def _ns_of(self, *kinds: PictureFaultKind) -> int:
        fault = self._fault
        return round(fault.seconds * 1e9) if fault is not None and fault.kind in kinds else 0

    def _even(self, image: Image, level: float, noise: float) -> Image:
        values = self._rng.normal(level, noise, image.shape)
        return np.clip(values, 0, 255).astype(np.uint8)
