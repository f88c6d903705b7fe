"""The `s0` network: the paper's own (Sec. A.1, Table 5), for machines with a GPU.

The first three stages of MobileOne-S0 as encoder (Vasu et al. 2023, Table 2: one block of 48
channels at stride 2, two of 48 at stride 4, eight of 128 at stride 8, four branches each), a U-Net
decoder of 128, 64 and 32 channels with two skips, and heads at strides 4, 2 and 1: a 3 x 3
projection to C channels, made unit length, and a 1 x 1 uncertainty through a sigmoid. As everywhere
here, the second output is the confidence, the uncertainty's complement.
"""

from __future__ import annotations

from typing import ClassVar, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from localizer.training.models.tiny import affine, fused_convolution

STRIDES = (4, 2, 1)
_WIDTHS, _BLOCKS = (48, 48, 128), (1, 2, 8)
_DECODER = (128, 64, 32)


class S0Config(BaseModel):
    """Shape of the network. channels: C of each level; branches: of each encoder block."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    network: Literal["s0"] = "s0"
    channels: int = Field(default=32, gt=0, le=4096)
    branches: int = Field(default=4, gt=0, le=64)


class BranchedBlock(nn.Module):
    """MobileOne's block (its Fig. 3): parallel branches in training, one convolution afterwards.

    Branches: `branches` k x k convolutions, one 1 x 1 for k > 1, and a batch normalisation of the
    input where shapes allow.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        size: int,
        branches: int,
        *,
        stride: int = 1,
        groups: int = 1,
    ) -> None:
        super().__init__()
        self.shape = (inputs, outputs, size, stride, groups, 1)

        def branch(k: int) -> nn.Sequential:
            conv = nn.Conv2d(inputs, outputs, k, stride, k // 2, groups=groups, bias=False)
            return nn.Sequential(conv, nn.BatchNorm2d(outputs))

        self.convolutions = nn.ModuleList(branch(size) for _ in range(branches))
        self.point = branch(1) if size > 1 else None
        self.skip = nn.BatchNorm2d(inputs) if inputs == outputs and stride == 1 else None

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) to (B, outputs, H/stride, W/stride)."""
        total: Tensor = sum(branch(x) for branch in self.convolutions)
        if self.point is not None:
            total = total + self.point(x)
        if self.skip is not None:
            total = total + self.skip(x)
        return F.relu(total)

    def fused(self) -> nn.Sequential:
        """The same function, with the evaluation's statistics, as one convolution and a ReLU."""
        branches = [*self.convolutions, *([self.point] if self.point is not None else [])]
        gain, shift = (None, 0.0) if self.skip is None else affine(self.skip)
        return fused_convolution(self.shape, branches, gain, shift)


class S0Net(nn.Module):
    """Image (B, 3, H, W) in 0..1, H and W divisible by 8, to three (features, confidence) levels.

    Level k is at stride `STRIDES[k]`: features (B, C, h, w) of unit length, confidence (B, h, w).
    """

    strides: ClassVar[tuple[int, ...]] = STRIDES

    def __init__(self, config: S0Config) -> None:
        super().__init__()
        stages, inputs = [], 3
        for stage, (width, count) in enumerate(zip(_WIDTHS, _BLOCKS, strict=True)):
            blocks: list[nn.Module] = []
            for k in range(count):
                stride = 2 if k == 0 else 1
                if stage == 0:
                    blocks.append(BranchedBlock(inputs, width, 3, config.branches, stride=stride))
                else:
                    blocks += _unit(inputs, width, config.branches, stride)
                inputs = width
            stages.append(nn.Sequential(*blocks))
        self.encoder = nn.ModuleList(stages)
        e1, e2, e3 = _WIDTHS
        d1, d2, d3 = _DECODER
        self.decoder = nn.ModuleList(
            [_convolution(e3 + e2, d1), _convolution(d1 + e1, d2), _convolution(d2, d3)]
        )
        self.projections = nn.ModuleList(
            nn.Conv2d(width, config.channels, 3, padding=1) for width in _DECODER
        )
        self.uncertainties = nn.ModuleList(nn.Conv2d(width, 1, 1) for width in _DECODER)

    def forward(self, image: Tensor) -> list[tuple[Tensor, Tensor]]:
        """See the class."""
        skips, x = [], (image - 0.45) / 0.25
        for stage in self.encoder:
            x = stage(x)
            skips.append(x)
        levels = []
        for k, (block, project, doubt) in enumerate(
            zip(self.decoder, self.projections, self.uncertainties, strict=True)
        ):
            x = F.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)
            if k < 2:
                x = torch.cat([x, skips[1 - k]], 1)
            x = block(x)
            # The sum of squares overflows nothing and loses little in float32.
            f = project(x).float()
            unit = f * torch.rsqrt((f * f).sum(1, keepdim=True) + 1e-8)
            levels.append((unit, 1.0 - torch.sigmoid(doubt(x).float())[:, 0]))
        return levels


def _unit(inputs: int, outputs: int, branches: int, stride: int) -> list[nn.Module]:
    """Depthwise 3 x 3, then pointwise."""
    return [
        BranchedBlock(inputs, inputs, 3, branches, stride=stride, groups=inputs),
        BranchedBlock(inputs, outputs, 1, branches),
    ]


def _convolution(inputs: int, outputs: int) -> nn.Sequential:
    conv = nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)
    return nn.Sequential(conv, nn.BatchNorm2d(outputs), nn.ReLU())
