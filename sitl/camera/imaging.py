"""`synth.appearance.model` at video rate: the same image model in two passes over the image.

The general function is as slow as rendering, and the world camera shares two cores with the
companion under test. Lamps, rain and snow are left to the general function.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numba import njit

from localizer.synth.appearance.model import Appearance, apply_appearance
from localizer.types import Float32, Image

_SKY_M = 4000.0  # haze distance of pixels without a surface, as in the general function
_CURVE_MAX, _CURVE_SIZE = 2.0, 8192  # tone curve: input range and number of entries
_NOISE_SIZE = 1 << 20
_GRAY = (0.299, 0.587, 0.114)


_BRIGHTNESS = 0.42  # of full scale: what automatic exposure aims at
_FOLLOWS = 0.25  # of the way there that the gain goes from one picture to the next
_GAIN = (0.5, 3.0)


class Sensor:
    """Applies exposure, noise, blur and weather to rendered frames, one after another. With
    auto_exposure, the gain follows the last frame's brightness, and the noise grows with it.
    """

    def __init__(self, appearance: Appearance, seed: int = 0, auto_exposure: bool = False) -> None:
        self._appearance = appearance
        self._auto, self._gain = auto_exposure, 1.0
        self._rng = np.random.default_rng(seed)
        a = appearance
        self._is_simple = not (a.lamps or a.rain_streaks or a.snow_flakes or a.snow_cover)
        x = np.linspace(0.0, _CURVE_MAX, _CURVE_SIZE)
        self._curve = (x**a.gamma).astype(np.float32)
        self._noise = self._rng.standard_normal(_NOISE_SIZE, dtype=np.float32)

    def apply(self, rgb: Image, depth: Float32, blur_px: float, blur_deg: float) -> Image:
        """The camera's image (H, W, 3) of a rendered one. depth: (H, W) m, 0 for sky. blur_px,
        blur_deg: length and direction of the image motion.
        """
        a = replace(self._appearance, motion_blur_px=blur_px, motion_blur_deg=blur_deg)
        if not self._auto:
            return self._developed(rgb, depth, a)
        gain = self._gain
        gained = replace(
            a, exposure=a.exposure * gain, shot_noise=a.shot_noise * float(np.sqrt(gain)),
            read_noise=a.read_noise * gain,
        )  # fmt: skip
        image = self._developed(rgb, depth, gained)
        level = max(float(image[::8, ::8].mean()) / 255.0, 1e-3)
        wanted = gain * (_BRIGHTNESS / level) ** _FOLLOWS
        self._gain = min(max(wanted, _GAIN[0]), _GAIN[1])
        return image

    def _developed(self, rgb: Image, depth: Float32, a: Appearance) -> Image:
        if not self._is_simple:
            return apply_appearance(rgb, depth, a, self._rng)
        gain, offset = _linear_tone(rgb, a)
        haze = np.array(a.haze_color) * min(a.exposure, 1.0)
        image = np.empty(rgb.shape, np.float32)
        _develop(
            rgb, depth, gain, offset, self._curve, _f32(a.extinction_per_m), _f32(haze),
            _f32(0.5 * a.vignetting), image,
        )  # fmt: skip
        # The general function's thresholds for when a blur is drawn.
        if a.defocus_px > 0.3:
            image = cv2.GaussianBlur(image, (0, 0), a.defocus_px)
        if a.motion_blur_px > 1.0:
            image = cv2.filter2D(image, -1, line_kernel(a.motion_blur_px, a.motion_blur_deg))
        out = np.empty(rgb.shape, np.uint8)
        start = int(self._rng.integers(_NOISE_SIZE))
        shot, read = _f32(a.shot_noise**2), _f32(a.read_noise**2)
        _expose(image.reshape(-1), self._noise, start, shot, read, out.reshape(-1))
        return out if a.jpeg_quality == 100 else _compressed(out, a.jpeg_quality)


def line_kernel(length_px: float, angle_deg: float) -> Float32:
    """Blur kernel (K, K) of a straight motion, anti-aliased, centred, with sum 1."""
    half = int(np.ceil(length_px / 2)) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    t = np.linspace(-0.5, 0.5, 65) * length_px
    angle = np.radians(angle_deg)
    x, y = half + t * np.cos(angle), half + t * np.sin(angle)
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    for dx, wx in ((0, 1 - (x - x0)), (1, x - x0)):
        for dy, wy in ((0, 1 - (y - y0)), (1, y - y0)):
            np.add.at(kernel, (y0 + dy, x0 + dx), wx * wy)
    normalised: Float32 = kernel / kernel.sum()
    return normalised


def _linear_tone(rgb: Image, a: Appearance) -> tuple[Float32, Float32]:
    """Saturation, balance, exposure and contrast as one affine map of colour: (3, 3) and (3,)."""
    gray = np.array(_GRAY)
    saturate = a.saturation * np.eye(3) + (1 - a.saturation) * gray[None, :]
    matrix = np.diag(np.array(a.balance) * a.exposure) @ saturate
    # Contrast turns about the mean of the image as it is by then; all before it is linear.
    mean = float((matrix @ (np.array(cv2.mean(rgb)[:3]) / 255)).mean())
    return _f32(a.contrast * matrix / 255), _f32(np.full(3, (1 - a.contrast) * mean))


def _compressed(image: Image, quality: int) -> Image:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED))


def _f32(value: Any) -> Any:
    return np.asarray(value, np.float32) if np.ndim(value) else np.float32(value)


@njit(cache=True, nogil=True, fastmath=True)
def _develop(rgb, depth, gain, offset, curve, extinction, haze, falloff, out):  # type: ignore[no-untyped-def]
    """Tone, haze by distance, vignetting: (H, W, 3) uint8 to float32."""
    h, w = depth.shape
    scale = np.float32((curve.shape[0] - 1) / _CURVE_MAX)
    top = np.float32(curve.shape[0] - 1)
    step_x, step_y = np.float32(2.0 / (w - 1)), np.float32(2.0 / (h - 1))
    one = np.float32(1)
    for v in range(h):
        y = v * step_y - one
        for u in range(w):
            x = u * step_x - one
            r, g, b = np.float32(rgb[v, u, 0]), np.float32(rgb[v, u, 1]), np.float32(rgb[v, u, 2])
            d = depth[v, u]
            clear = one
            if extinction > 0:
                clear = np.exp(-extinction * (d if d > 0 else np.float32(_SKY_M)))
            light = one - falloff * (x * x + y * y)
            for c in range(3):
                value = gain[c, 0] * r + gain[c, 1] * g + gain[c, 2] * b + offset[c]
                index = min(max(value * scale, np.float32(0)), top)
                value = curve[int(index + np.float32(0.5))]
                out[v, u, c] = (value * clear + haze[c] * (one - clear)) * light


@njit(cache=True, nogil=True, fastmath=True)
def _expose(image, noise, start, shot, read, out):  # type: ignore[no-untyped-def]
    """Shot and read noise, and 8 bits; flat arrays."""
    mask = noise.shape[0] - 1
    for i in range(image.shape[0]):
        value = image[i]
        level = min(max(value, np.float32(0)), np.float32(1))
        value += noise[(start + i) & mask] * np.sqrt(shot * level + read)
        value = min(max(value, np.float32(0)), np.float32(1))
        out[i] = np.uint8(value * np.float32(255) + np.float32(0.5))
