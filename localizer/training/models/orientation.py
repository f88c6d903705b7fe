"""The gradient fallback's features as a fixed part of the network: `orientation_level` in torch.

They give the network a sound basin from the first step on, so that what is learned is what they
lack: what survives a change of season and light, and what to trust.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from localizer.features.orientation import ORIENTATIONS


class OrientationFeatures(nn.Module):
    """Orientation energy of one level: image (B, 3, H, W) in 0..1 to unit features (B, 8, h, w) and
    confidence (B, h, w). Borders are replicated. Nothing in it is learned.
    """

    reduce: Tensor
    blur: Tensor
    surround: Tensor
    directions: Tensor
    sobel: Tensor
    gray: Tensor

    def __init__(self, stride: int) -> None:
        super().__init__()
        self.stride = stride
        smooth = _gaussian(0.6 * stride)
        area = torch.full((stride,), 1.0 / stride)
        self.register_buffer("reduce", _rows(_convolved(smooth, area), 1), persistent=False)
        self.register_buffer("blur", _rows(_gaussian(1.0), ORIENTATIONS), persistent=False)
        self.register_buffer("surround", _rows(_gaussian(6.0), 1), persistent=False)
        angles = 2.0 * math.pi * torch.arange(ORIENTATIONS) / ORIENTATIONS
        directions = torch.stack([torch.cos(angles), torch.sin(angles)], 1)
        self.register_buffer("directions", directions[:, :, None, None], persistent=False)
        sobel = torch.tensor([[-1.0, 0.0, 1.0], [-2.0, 0.0, 2.0], [-1.0, 0.0, 1.0]])
        self.register_buffer("sobel", torch.stack([sobel, sobel.T])[:, None], persistent=False)
        self.register_buffer("gray", torch.tensor([0.299, 0.587, 0.114])[None, :, None, None],
                             persistent=False)  # fmt: skip

    @torch.no_grad()
    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """See the class. Half precision would lose it the weak edges of night and fog."""
        with torch.autocast(image.device.type, enabled=False):
            return self._features(image)

    def _features(self, image: Tensor) -> tuple[Tensor, Tensor]:
        gray = (image * self.gray).sum(1, keepdim=True)
        small = _separable(gray, self.reduce, self.stride)
        gradient = F.conv2d(F.pad(small, [1, 1, 1, 1], mode="replicate"), self.sobel)
        gx, gy = gradient[:, :1], gradient[:, 1:]
        magnitude = torch.sqrt(gx * gx + gy * gy + 1e-12)
        double = torch.cat([gx * gx - gy * gy, 2 * gx * gy], 1) / (magnitude * magnitude)
        response = F.relu(F.conv2d(double, self.directions)) ** 2 * magnitude
        bins = _separable(response, self.blur, 1)
        energy2 = (bins * bins).sum(1, keepdim=True)
        around = _separable(energy2, self.surround, 1)
        flat = 0.3 * torch.sqrt(around) + 0.01
        energy = torch.sqrt(energy2)
        features = torch.cat([bins, flat], 1) / torch.sqrt(energy2 + flat * flat)
        return features, (energy / (energy + flat))[:, 0]


def _gaussian(sigma: float) -> Tensor:
    """Normalised samples out to four sigma, as OpenCV's for float images."""
    radius = (round(8 * sigma + 1) | 1) // 2
    x = torch.arange(-radius, radius + 1, dtype=torch.float32)
    kernel = torch.exp(-(x**2) / (2 * sigma**2))
    return kernel / kernel.sum()


def _convolved(a: Tensor, b: Tensor) -> Tensor:
    """Full convolution of two short kernels."""
    padded = F.pad(a[None, None], [len(b) - 1, len(b) - 1])
    return F.conv1d(padded, b.flip(0)[None, None])[0, 0]


def _rows(kernel: Tensor, channels: int) -> Tensor:
    """Depthwise weights (channels, 1, 1, n): constants, because ONNX wants known shapes."""
    return kernel.repeat(channels, 1, 1, 1)


def _separable(x: Tensor, rows: Tensor, stride: int) -> Tensor:
    """Each channel filtered along both axes, sampled every `stride` pixels."""
    channels, size = rows.shape[0], rows.shape[3]
    pad = (size - stride) // 2
    x = F.pad(x, [pad, pad, 0, 0], mode="replicate")
    x = F.conv2d(x, rows, stride=(1, stride), groups=channels)
    x = F.pad(x, [0, 0, pad, pad], mode="replicate")
    return F.conv2d(x, rows.transpose(2, 3).contiguous(), stride=(stride, 1), groups=channels)
