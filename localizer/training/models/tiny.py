"""The `tiny` network: MobileOne blocks in the encoder, an additive U-Net decoder, three levels.

Each level gives unit-length features and a confidence in (0, 1), the complement of the paper's
uncertainty (Sec. 3.3.1, A.1). Eight channels are fixed orientation energy (`OrientationFeatures`),
the rest is learned; what share each has in the squared distance is learned too, pixel by pixel,
because orientation does not last on grass, leaves and water. The confidence is the orientation's
clarity: one that was learned with the features gathered the anchors in a few places and cost
accuracy each time it was tried (model-card.md). The finest level is at stride 2: half the paper's,
a quarter of the work. The coarsest stage is dilated, because at stride 8 a wide field of view costs
next to nothing.

The orientation features (`orientation_level` in torch) give the network a sound basin from the
first step on, so that what is learned is what they lack: what survives a change of season and
light, and what to trust.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Annotated, ClassVar, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from localizer.features.orientation import CHANNELS, ORIENTATIONS


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


STRIDES = (8, 4, 2)

_Width = Annotated[int, Field(gt=0, le=4096)]  # channels
_Dilation = Annotated[int, Field(gt=0, le=64)]


class ModelConfig(BaseModel):
    """Shape of the network. widths: encoder channels at strides 2, 4, 8; decoder: at 4 and 2;
    dilations: one block of the coarsest stage each.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    network: Literal["tiny"] = "tiny"
    channels: int = Field(default=32, gt=CHANNELS, le=4096)
    widths: tuple[_Width, _Width, _Width] = (24, 48, 96)
    decoder: tuple[_Width, _Width] = (48, 32)
    dilations: tuple[_Dilation, ...] = Field(default=(1, 1, 2, 1, 4, 2), min_length=1)


class MobileOneBlock(nn.Module):
    """Convolution that trains as parallel branches and runs as one (MobileOne, Fig. 3).

    Branches: the k x k convolution with batch normalisation, and the identity where shapes allow;
    MobileOne's 1 x 1 branch is left out, because its memory traffic costs a third of a CPU step.
    `fuse` folds the branches into a single convolution.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        size: int,
        *,
        stride: int = 1,
        groups: int = 1,
        dilation: int = 1,
    ) -> None:
        super().__init__()
        self.shape = (inputs, outputs, size, stride, groups, dilation)
        padding = dilation * (size // 2)
        self.main = _conv_bn(inputs, outputs, size, stride, groups, dilation, padding)
        self.residual = inputs == outputs and stride == 1

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) to (B, outputs, H/stride, W/stride)."""
        y = self.main(x)
        return F.relu(y + x if self.residual else y)

    def fused(self) -> nn.Sequential:
        """The same function as one convolution and a ReLU (evaluation statistics)."""
        gain = torch.ones(self.shape[1]) if self.residual else None
        return fused_convolution(self.shape, [self.main], gain, 0.0)


class TinyNet(nn.Module):
    """Image (B, 3, H, W) in 0..1, H and W divisible by 8, to three (features, confidence) levels.

    Level k is at stride `STRIDES[k]`: features (B, C, h, w) of unit length, confidence (B, h, w).
    """

    strides: ClassVar[tuple[int, ...]] = STRIDES

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        w0, w1, w2 = config.widths
        d1, d2 = config.decoder
        self.stem = MobileOneBlock(3, w0, 3, stride=2)
        self.stage2 = nn.Sequential(*_pair(w0, w1, stride=2), *_pair(w1, w1))
        deep: list[nn.Module] = []
        for k, dilation in enumerate(config.dilations):
            first = k == 0
            deep += _pair(w1 if first else w2, w2, stride=2 if first else 1, dilation=dilation)
        self.stage3 = nn.Sequential(*deep)
        self.lateral1, self.lateral2 = nn.Conv2d(w1, d1, 1), nn.Conv2d(w0, d2, 1)
        self.down1, self.down2 = nn.Conv2d(w2, d1, 1), nn.Conv2d(d1, d2, 1)
        self.merge1 = nn.Sequential(MobileOneBlock(d1, d1, 3), MobileOneBlock(d1, d1, 3))
        self.merge2 = nn.Sequential(MobileOneBlock(d2, d2, 3), MobileOneBlock(d2, d2, 3))
        learned = config.channels - CHANNELS
        self.orientation = nn.ModuleList(OrientationFeatures(s) for s in STRIDES)
        self.share = nn.ModuleList(_half(c) for c in (w2, d1, d2))
        self.features = nn.ModuleList(nn.Conv2d(c, learned, 1) for c in (w2, d1, d2))

    def forward(self, image: Tensor) -> list[tuple[Tensor, Tensor]]:
        """See the class."""
        levels = []
        for k, x in enumerate(self.learned(image)):
            oriented, clear = self.orientation[k](image)
            f = x[:, 1:]
            unit = f * torch.rsqrt((f * f).sum(1, keepdim=True) + 1e-8)
            share = torch.sigmoid(x[:, :1])
            both = torch.cat([torch.sqrt(share) * oriented, torch.sqrt(1 - share) * unit], 1)
            levels.append((both, clear))
        return levels

    def learned(self, image: Tensor) -> list[Tensor]:
        """The levels (B, 1 + n, h, w) of `orientation_level`: the logit of the orientation's share
        and the learned features, of any length.
        """
        a = self.stem((image - 0.45) / 0.25)
        b = self.stage2(a)
        c = self.stage3(b)
        d = self.merge1(F.relu(self.lateral1(b) + _double(self.down1(c))))
        e = self.merge2(F.relu(self.lateral2(a) + _double(self.down2(d))))
        heads = zip(self.share, self.features, (c, d, e), strict=True)
        return [_joined(share, features, x).float() for share, features, x in heads]


def _joined(first: nn.Module, second: nn.Module, x: Tensor) -> Tensor:
    """The outputs of two convolutions 1 x 1, of one: it reads the input once."""
    weight = torch.cat([first.weight, second.weight])
    return F.conv2d(x, weight, torch.cat([first.bias, second.bias]))


def fused_convolution(
    shape: tuple[int, ...],
    branches: Iterable[nn.Module],
    skip: Tensor | None,
    shift: Tensor | float,
) -> nn.Sequential:
    """One convolution and a ReLU that give the ReLU of a sum: of `branches`, each a convolution and
    a batch normalisation in evaluation, and of the input times `skip` (outputs,) plus `shift`.
    shape: inputs, outputs, size, stride, groups, dilation.
    """
    inputs, outputs, size, stride, groups, dilation = shape
    conv = nn.Conv2d(
        inputs, outputs, size, stride, dilation * (size // 2), groups=groups, dilation=dilation
    )
    weight, bias = torch.zeros_like(conv.weight), torch.zeros(outputs) + shift
    for branch in branches:
        assert isinstance(branch, nn.Sequential)
        folded, moved = folded_branch(branch)
        margin = (size - folded.shape[-1]) // 2
        weight, bias = weight + F.pad(folded, (margin,) * 4), bias + moved
    if skip is not None:
        index = torch.arange(outputs)
        weight[index, index % (inputs // groups), size // 2, size // 2] += skip
    conv.weight = nn.Parameter(weight.detach().clone())
    conv.bias = nn.Parameter(bias.detach().clone())
    return nn.Sequential(conv, nn.ReLU())


def _pair(inputs: int, outputs: int, *, stride: int = 1, dilation: int = 1) -> list[nn.Module]:
    """Depthwise 3 x 3, then pointwise: the MobileOne unit."""
    return [
        MobileOneBlock(inputs, inputs, 3, stride=stride, groups=inputs, dilation=dilation),
        MobileOneBlock(inputs, outputs, 1),
    ]


def _conv_bn(
    inputs: int, outputs: int, size: int, stride: int, groups: int, dilation: int, padding: int
) -> nn.Sequential:
    conv = nn.Conv2d(
        inputs, outputs, size, stride, padding, dilation=dilation, groups=groups, bias=False
    )
    return nn.Sequential(conv, nn.BatchNorm2d(outputs))


def affine(bn: nn.BatchNorm2d) -> tuple[Tensor, Tensor]:
    """Gain and shift (C,) that a batch normalisation applies in evaluation."""
    assert bn.running_var is not None
    assert bn.running_mean is not None
    gain = bn.weight / torch.sqrt(bn.running_var + bn.eps)
    return gain, bn.bias - bn.running_mean * gain


def folded_branch(branch: nn.Sequential) -> tuple[Tensor, Tensor]:
    """Weight and bias of a convolution that its batch normalisation follows, in evaluation."""
    gain, shift = affine(branch[1])
    return branch[0].weight * gain[:, None, None, None], shift


def _half(channels: int) -> nn.Conv2d:
    """The logit of the orientation's share at a pixel: half everywhere at first."""
    conv = nn.Conv2d(channels, 1, 1)
    nn.init.zeros_(conv.weight)
    nn.init.zeros_(conv.bias)
    return conv


def _double(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2.0, mode="nearest")
