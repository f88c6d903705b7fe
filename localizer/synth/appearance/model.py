"""Applies light, weather and camera effects to a rendered image, by its depth.

Colours change, geometry does not, so pose and depth stay true. Sun direction, cast shadows and
seasons belong to the rendered world.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.types import Float32, Image

CONDITIONS = ("day", "dusk", "night", "fog", "rain", "snow")
_SKY_DEPTH_M = 4000.0  # haze distance given to pixels without a surface


@dataclass(frozen=True)
class Appearance:
    """Parameters of light, weather and sensor. The defaults change nothing.

    Colours are RGB factors about 1. Extinction is per metre (Koschmieder's law, visual range
    3.9 / extinction). Noise sigmas are in units of full scale, lengths in pixels.
    """

    condition: str = "day"
    exposure: float = 1.0
    contrast: float = 1.0
    gamma: float = 1.0
    saturation: float = 1.0
    balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    extinction_per_m: float = 0.0
    haze_color: tuple[float, float, float] = (0.8, 0.82, 0.85)
    lamps: int = 0
    rain_streaks: int = 0
    snow_flakes: int = 0
    snow_cover: float = 0.0
    vignetting: float = 0.0
    shot_noise: float = 0.0
    read_noise: float = 0.0
    defocus_px: float = 0.0
    motion_blur_px: float = 0.0
    motion_blur_deg: float = 0.0
    jpeg_quality: int = 100


def sample_appearance(rng: np.random.Generator, condition: str | None = None) -> Appearance:
    """Draw random parameters. condition: one of `CONDITIONS`; None: drawn, too. `ValueError` for
    another.
    """
    if condition is None:
        condition = str(rng.choice(CONDITIONS, p=(0.4, 0.15, 0.15, 0.12, 0.1, 0.08)))
    if condition not in CONDITIONS:
        raise ValueError(f"condition {condition!r} is not one of {', '.join(CONDITIONS)}")
    tint = rng.uniform(0.88, 1.14, 3)
    exposure = float(np.exp(rng.normal(0.0, 0.22)))
    haze, extinction = (0.8, 0.82, 0.85), float(rng.uniform(0.0, 4e-4))
    saturation, contrast = rng.uniform(0.6, 1.3), rng.uniform(0.75, 1.2)
    shot, read = rng.uniform(0.0, 0.03), rng.uniform(0.0, 0.012)
    lamps = streaks = flakes = 0
    cover = 0.0
    if condition == "dusk":
        warm = rng.uniform(0.0, 1.0)
        tint = tint * (1 + 0.2 * warm, 0.92, 1.12 - 0.4 * warm)
        exposure *= rng.uniform(0.3, 0.65)
        haze, extinction = (0.7, 0.5, 0.4), float(rng.uniform(0.0, 1e-3))
        shot += 0.015
    elif condition == "night":
        tint = tint * (0.75, 0.88, 1.25)
        exposure *= rng.uniform(0.2, 0.5)
        saturation *= rng.uniform(0.2, 0.7)
        haze, extinction = (0.05, 0.06, 0.1), float(rng.uniform(0.0, 1e-3))
        lamps = int(rng.integers(0, 25))
        shot, read = rng.uniform(0.01, 0.06), rng.uniform(0.005, 0.03)
    elif condition == "fog":
        extinction = float(np.exp(rng.uniform(np.log(1.2e-3), np.log(1.0e-2))))
        level = rng.uniform(0.55, 0.9)
        haze, saturation = (level, level * 1.01, level * 1.03), saturation * 0.75
    elif condition == "rain":
        extinction = float(np.exp(rng.uniform(np.log(4e-4), np.log(3e-3))))
        haze, saturation = (0.55, 0.57, 0.6), saturation * 0.8
        exposure *= rng.uniform(0.45, 0.9)
        streaks = int(rng.integers(40, 400))
    elif condition == "snow":
        extinction = float(np.exp(rng.uniform(np.log(4e-4), np.log(4e-3))))
        haze, flakes = (0.85, 0.86, 0.88), int(rng.integers(0, 250))
        cover = float(rng.uniform(0.2, 0.85))
    blurred = rng.random() < 0.35
    return Appearance(
        condition=condition,
        exposure=float(exposure),
        contrast=float(contrast),
        gamma=float(np.exp(rng.normal(0.0, 0.2))),
        saturation=float(saturation),
        balance=(float(tint[0]), float(tint[1]), float(tint[2])),
        extinction_per_m=extinction,
        haze_color=haze,
        lamps=lamps,
        rain_streaks=streaks,
        snow_flakes=flakes,
        snow_cover=cover,
        vignetting=float(rng.uniform(0.0, 0.35)),
        shot_noise=float(shot),
        read_noise=float(read),
        defocus_px=float(rng.uniform(0.0, 0.9)) if rng.random() < 0.5 else 0.0,
        motion_blur_px=float(rng.uniform(1.0, 5.0)) if blurred else 0.0,
        motion_blur_deg=float(rng.uniform(0.0, 180.0)),
        jpeg_quality=int(rng.integers(25, 96)),
    )


def apply_appearance(
    rgb: Image, depth: Float32, appearance: Appearance, rng: np.random.Generator
) -> Image:
    """Apply the effects to rgb (H, W, 3) uint8 with depth (H, W) m, 0 for sky."""
    a = appearance
    image: Float32 = rgb.astype(np.float32) / 255.0
    if a.snow_cover > 0.0:
        image = _snow_cover(image, depth, a.snow_cover)
    image = _tone(image, a)
    if a.lamps:
        image = _lamps(image, a.lamps, rng)
    if a.extinction_per_m > 0.0:
        distance = np.where(depth > 0, depth, np.float32(_SKY_DEPTH_M))
        clear = np.exp(-np.float32(a.extinction_per_m) * distance)[..., None]
        haze = np.asarray(a.haze_color, np.float32) * np.float32(min(a.exposure, 1.0))
        image = image * clear + haze * (1 - clear)
    if a.rain_streaks:
        image = _streaks(image, a.rain_streaks, 0.12, 9.0, rng)
    if a.snow_flakes:
        image = _streaks(image, a.snow_flakes, 0.5, 1.5, rng)
    image = _optics(image, a)
    if a.shot_noise > 0.0 or a.read_noise > 0.0:
        noise = rng.standard_normal(image.shape, dtype=np.float32)
        image = image + noise * np.sqrt(
            np.float32(a.shot_noise**2) * np.clip(image, 0, 1) + np.float32(a.read_noise**2)
        )
    out: Image = (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    if a.jpeg_quality < 100:
        options = [cv2.IMWRITE_JPEG_QUALITY, a.jpeg_quality]
        # OpenCV takes its images for BGR, so the chroma of red and blue is coded with the other's
        # weights. It stays until the next training: the published pairs were made so.
        coded = cv2.imencode(".jpg", out, options)[1]
        return np.asarray(cv2.imdecode(coded, cv2.IMREAD_UNCHANGED), np.uint8)
    return out


def _tone(image: Float32, a: Appearance) -> Float32:
    """Colour response and exposure. Contrast scales differences from the image's mean."""
    if a.saturation != 1.0:
        gray = image @ np.array([0.299, 0.587, 0.114], np.float32)
        image = gray[..., None] + np.float32(a.saturation) * (image - gray[..., None])
    image = image * (np.asarray(a.balance, np.float32) * np.float32(a.exposure))
    if a.contrast != 1.0:
        mean = np.float32(image.mean())
        image = mean + np.float32(a.contrast) * (image - mean)
    if a.gamma != 1.0:
        image = np.clip(image, 0.0, None) ** np.float32(a.gamma)
    return image


def _snow_cover(image: Float32, depth: Float32, cover: float) -> Float32:
    """Whiten surfaces, more where they face up: there depth varies slowly between pixels."""
    step = np.abs(cv2.Laplacian(depth, cv2.CV_32F)) / np.maximum(depth, 1.0)
    level = cv2.GaussianBlur(np.exp(-200.0 * step), (0, 0), 1.0) * np.float32(cover)
    level = np.where(depth > 0, level, 0)[..., None].astype(np.float32)
    white = np.array([0.88, 0.9, 0.94], np.float32)
    snowy: Float32 = image * (1 - level) + white * level
    return snowy


def _lamps(image: Float32, count: int, rng: np.random.Generator) -> Float32:
    """Pools of lamp light on the ground, each with a bright core."""
    h, w = image.shape[:2]
    light = np.zeros((h, w, 3), np.float32)
    for _ in range(count):
        radius = float(rng.uniform(0.01, 0.06)) * w
        cx, cy = float(rng.uniform(0, w)), float(rng.uniform(0, h))
        color = (1.0, float(rng.uniform(0.65, 0.95)), float(rng.uniform(0.3, 0.8)))
        power = float(rng.uniform(0.3, 1.5))
        x0, x1 = int(max(cx - 3 * radius, 0)), int(min(cx + 3 * radius + 1, w))
        y0, y1 = int(max(cy - 3 * radius, 0)), int(min(cy + 3 * radius + 1, h))
        dx = (np.arange(x0, x1, dtype=np.float32) - cx) / radius
        dy = (np.arange(y0, y1, dtype=np.float32) - cy) / radius
        pool = np.exp(-(dx[None] ** 2) - dy[:, None] ** 2)[..., None]
        light[y0:y1, x0:x1] += pool * np.array(color, np.float32) * np.float32(power)
    lit: Float32 = image * (1.0 + 3.0 * light) + 0.12 * light**2
    return lit


def _streaks(
    image: Float32, count: int, alpha: float, length: float, rng: np.random.Generator
) -> Float32:
    """Falling drops or flakes: short lines of one direction. alpha: opacity of one line; length:
    mean, px of an image 256 px wide.
    """
    h, w = image.shape[:2]
    layer: NDArray[np.uint8] = np.zeros((h, w), np.uint8)
    tilt = rng.normal(0.0, 0.3)
    starts = rng.uniform((0, 0), (w, h), (count, 2))
    lengths = length * rng.uniform(0.4, 1.6, count) * w / 256.0
    ends = starts + lengths[:, None] * (np.sin(tilt), np.cos(tilt))
    for start, end in zip(starts, ends, strict=True):
        p, q = np.int32(start * 16), np.int32(end * 16)
        cv2.line(layer, p.tolist(), q.tolist(), 255, 1, cv2.LINE_AA, 4)
    cover = (layer.astype(np.float32) * np.float32(alpha / 255.0))[..., None]
    streaked: Float32 = image * (1 - cover) + 0.85 * cover
    return streaked


def _optics(image: Float32, a: Appearance) -> Float32:
    h, w = image.shape[:2]
    if a.vignetting > 0.0:
        x = np.linspace(-1, 1, w, dtype=np.float32)
        y = np.linspace(-1, 1, h, dtype=np.float32)
        falloff = 1.0 - np.float32(0.5 * a.vignetting) * (x[None] ** 2 + y[:, None] ** 2)
        image = image * falloff[..., None]
    if a.defocus_px > 0.3:
        image = cv2.GaussianBlur(image, (0, 0), a.defocus_px)
    if a.motion_blur_px > 1.0:
        image = cv2.filter2D(image, -1, _motion_kernel(a.motion_blur_px, a.motion_blur_deg))
    return image


def _motion_kernel(length: float, angle_deg: float) -> Float32:
    """Blur kernel of a straight motion of `length` pixels, with sum 1."""
    half = int(np.ceil(length / 2))
    size = 2 * half + 1
    t = np.linspace(-0.5, 0.5, 33) * length
    angle = np.radians(angle_deg)
    kernel = np.zeros((size, size), np.float32)
    x, y = half + t * np.cos(angle), half + t * np.sin(angle)
    np.add.at(kernel, (np.rint(y).astype(int), np.rint(x).astype(int)), 1.0)
    normalised: Float32 = kernel / kernel.sum()
    return normalised
