"""`appearance.model.apply_appearance` on any torch device, with the same model in the same order.

Sensor noise comes from torch's generator; JPEG is its quantisation without entropy coding.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from localizer.synth.appearance.model import (
    SKY_DEPTH_M,
    Appearance,
    draw_lamps,
    motion_kernel,
    streak_cover,
)

# Annex K of ITU-T T.81: quantisation of luminance and chrominance at quality 50.
_LUMINANCE = (
    16, 11, 10, 16, 24, 40, 51, 61, 12, 12, 14, 19, 26, 58, 60, 55,
    14, 13, 16, 24, 40, 57, 69, 56, 14, 17, 22, 29, 51, 87, 80, 62,
    18, 22, 37, 56, 68, 109, 103, 77, 24, 35, 55, 64, 81, 104, 113, 92,
    49, 64, 78, 87, 103, 121, 120, 101, 72, 92, 95, 98, 112, 100, 103, 99,
)  # fmt: skip
_CHROMINANCE = (
    17, 18, 24, 47, 99, 99, 99, 99, 18, 21, 26, 66, 99, 99, 99, 99,
    24, 26, 56, 99, 99, 99, 99, 99, 47, 66, 99, 99, 99, 99, 99, 99,
    *([99] * 32),
)  # fmt: skip
_YCBCR = ((0.299, 0.587, 0.114), (-0.168736, -0.331264, 0.5), (0.5, -0.418688, -0.081312))


def apply_appearance(
    rgb: Tensor,
    depth: Tensor,
    appearance: Appearance,
    rng: np.random.Generator,
    generator: torch.Generator,
) -> Tensor:
    """Apply the effects to rgb (H, W, 3) uint8 with depth (H, W) m, 0 for sky.

    rng draws lamps and drops, as on the CPU; generator, of the tensors' device, the noise.
    """
    a = appearance
    image = rgb.permute(2, 0, 1).float() / 255.0
    if a.snow_cover > 0.0:
        image = _snow_cover(image, depth, a.snow_cover)
    image = _tone(image, a)
    if a.lamps:
        image = _lamps(image, a.lamps, rng)
    if a.extinction_per_m > 0.0:
        distance = torch.where(depth > 0, depth, SKY_DEPTH_M)
        clear = torch.exp(-a.extinction_per_m * distance)
        haze = image.new_tensor(a.haze_color)[:, None, None] * min(a.exposure, 1.0)
        image = image * clear + haze * (1 - clear)
    for count, alpha, length in ((a.rain_streaks, 0.12, 9.0), (a.snow_flakes, 0.5, 1.5)):
        if count:
            height, width = depth.shape
            cover = torch.from_numpy(streak_cover((height, width), count, alpha, length, rng))
            cover = cover.to(image.device)
            image = image * (1 - cover) + 0.85 * cover
    image = _optics(image, a)
    if a.shot_noise > 0.0 or a.read_noise > 0.0:
        noise = torch.randn(image.shape, generator=generator, device=image.device)
        image = image + noise * torch.sqrt(a.shot_noise**2 * image.clamp(0, 1) + a.read_noise**2)
    out = torch.floor(image.clamp(0, 1) * 255.0 + 0.5)
    if a.jpeg_quality < 100:
        out = jpeg(out, a.jpeg_quality)
    return out.to(torch.uint8).permute(1, 2, 0).contiguous()


def jpeg(image: Tensor, quality: int) -> Tensor:
    """Simulate baseline JPEG (4:2:0) compression of an image (3, H, W) with values 0..255."""
    height, width = image.shape[1:]
    padded = F.pad(image[None], [0, -width % 16, 0, -height % 16], mode="replicate")
    matrix = image.new_tensor(_YCBCR)
    ycc = torch.einsum("ij,bjhw->bihw", matrix, padded).round()
    luma = _quantised(ycc[:, :1] - 128.0, _LUMINANCE, quality) + 128.0
    small = F.avg_pool2d(ycc[:, 1:], 2).round()
    chroma = F.interpolate(
        _quantised(small, _CHROMINANCE, quality),
        scale_factor=2.0,
        mode="bilinear",
        align_corners=False,
    )
    back = torch.einsum("ij,bjhw->bihw", torch.linalg.inv(matrix), torch.cat([luma, chroma], 1))
    return back[0, :, :height, :width].round().clamp(0, 255)


def _quantised(plane: Tensor, table: tuple[int, ...], quality: int) -> Tensor:
    """(1, C, H, W), sides divisible by 8, through the quantised cosine transform of its blocks."""
    scale = 5000.0 / quality if quality < 50 else 200.0 - 2.0 * quality
    steps = ((plane.new_tensor(table) * scale + 50.0) / 100.0).floor().clamp(1, 255).view(8, 8)
    k = torch.arange(8, device=plane.device, dtype=plane.dtype)
    cosine = torch.cos((2 * k[None] + 1) * k[:, None] * math.pi / 16) * 0.5
    cosine = torch.cat([cosine[:1] * math.sqrt(0.5), cosine[1:]])
    batch, channels, height, width = plane.shape
    blocks = plane.view(batch, channels, height // 8, 8, width // 8, 8).transpose(3, 4)
    kept = torch.round(cosine @ blocks @ cosine.T / steps) * steps
    out = (cosine.T @ kept @ cosine).round()
    return out.transpose(3, 4).reshape(plane.shape)


def _tone(image: Tensor, a: Appearance) -> Tensor:
    if a.saturation != 1.0:
        gray = (image * image.new_tensor([0.299, 0.587, 0.114])[:, None, None]).sum(0)
        image = gray + a.saturation * (image - gray)
    image = image * (image.new_tensor(a.balance) * a.exposure)[:, None, None]
    if a.contrast != 1.0:
        mean = image.mean()
        image = mean + a.contrast * (image - mean)
    return image.clamp(min=0.0) ** a.gamma if a.gamma != 1.0 else image


def _snow_cover(image: Tensor, depth: Tensor, cover: float) -> Tensor:
    cross = depth.new_tensor([[0.0, 1.0, 0.0], [1.0, -4.0, 1.0], [0.0, 1.0, 0.0]])
    step = _filtered(depth[None], cross)[0].abs() / depth.clamp(min=1.0)
    level = _blurred(torch.exp(-200.0 * step)[None], 1.0)[0] * cover
    level = torch.where(depth > 0, level, 0.0)
    white = image.new_tensor([0.88, 0.9, 0.94])[:, None, None]
    return image * (1 - level) + white * level


def _lamps(image: Tensor, count: int, rng: np.random.Generator) -> Tensor:
    height, width = image.shape[1:]
    x = torch.arange(width, device=image.device, dtype=image.dtype)
    y = torch.arange(height, device=image.device, dtype=image.dtype)
    light = torch.zeros_like(image)
    for lamp in draw_lamps(count, width, height, rng):
        dx, dy = (x - lamp.x) / lamp.radius, (y - lamp.y) / lamp.radius
        # Beyond three radii the CPU draws nothing; there is nothing to see there.
        pool = torch.exp(-(dx[None] ** 2) - dy[:, None] ** 2)
        light = light + pool * (image.new_tensor(lamp.color) * lamp.power)[:, None, None]
    return image * (1.0 + 3.0 * light) + 0.12 * light**2


def _optics(image: Tensor, a: Appearance) -> Tensor:
    if a.vignetting > 0.0:
        height, width = image.shape[1:]
        x = torch.linspace(-1, 1, width, device=image.device)
        y = torch.linspace(-1, 1, height, device=image.device)
        image = image * (1.0 - 0.5 * a.vignetting * (x[None] ** 2 + y[:, None] ** 2))
    if a.defocus_px > 0.3:
        image = _blurred(image, a.defocus_px)
    if a.motion_blur_px > 1.0:
        kernel = torch.from_numpy(motion_kernel(a.motion_blur_px, a.motion_blur_deg))
        image = _filtered(image, kernel.to(image.device))
    return image


def _blurred(image: Tensor, sigma: float) -> Tensor:
    """Gaussian blur (C, H, W) with OpenCV's size and border for float images."""
    radius = (round(sigma * 8 + 1) | 1) // 2
    x = torch.arange(-radius, radius + 1, device=image.device, dtype=image.dtype)
    weights = torch.exp(-(x**2) / (2 * sigma**2))
    weights = weights / weights.sum()
    return _filtered(_filtered(image, weights[None]), weights[:, None])


def _filtered(image: Tensor, kernel: Tensor) -> Tensor:
    """Correlation of every channel (C, H, W) with `kernel` (odd sides), the border mirrored."""
    rows, cols = kernel.shape
    pad = [cols // 2, cols // 2, rows // 2, rows // 2]
    padded = F.pad(image[:, None], pad, mode="reflect")
    return F.conv2d(padded, kernel[None, None])[:, 0]
