"""What a large network teaches a small one: which places of the query an anchor resembles.

The networks' features have no common basis and may differ in width, so that not the features are
compared but what they are for: the teacher's distribution over the neighbourhood of an anchor's
true place, and its confidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from localizer.errors import ModelError
from localizer.training.checkpoint import read_checkpoint
from localizer.training.export.export import load_network
from localizer.training.losses import sample, window_similarity


class Teacher:
    """The averaged network of a run's checkpoint, read at the strides of its student."""

    def __init__(self, checkpoint: Path, strides: Sequence[int], device: torch.device) -> None:
        network, _, _ = load_network(checkpoint)
        self._network = network.to(device).requires_grad_(False)
        self._log_scale = read_checkpoint(checkpoint, device)["log_scale"]
        self._sources = []
        for stride in strides:
            usable = [k for k, s in enumerate(network.strides) if stride % s == 0]
            if not usable:
                raise ModelError(
                    f"{checkpoint}: has no level of stride {stride} or of a part of it"
                )
            source = max(usable, key=lambda k: network.strides[k])
            self._sources.append((source, stride // network.strides[source]))

    @torch.no_grad()
    def levels(self, images: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
        """For each of the student's levels: unit features (B, C, h, w), confidence (B, h, w), and
        the scale of the teacher's own contrast. images: (B, 3, H, W) in 0..1.
        """
        own = self._network(images)
        taught = []
        for source, factor in self._sources:
            features, confidence = own[source]
            if factor > 1:
                features = F.normalize(F.avg_pool2d(features, factor), dim=1)
                confidence = F.avg_pool2d(confidence[:, None], factor)[:, 0]
            taught.append((features, confidence, self._log_scale[source].exp()))
        return taught


def distillation_loss(
    student: tuple[Tensor, Tensor],
    scale: Tensor,
    teacher: tuple[Tensor, Tensor, Tensor],
    reference_pixels: Tensor,
    query_pixels: Tensor,
    visible: Tensor,
) -> Tensor:
    """Divergence of the student's likeness of places from the teacher's, on one level.

    student: features (2B, C, h, w), references first, and confidence (2B, h, w); scale: of its
    contrast; teacher: as from `Teacher.levels`; pixels (B, N, 2) of the level; visible: (B, N).
    Anchors count as much as the teacher trusts them. A confidence that is learned is drawn to the
    teacher's as well.
    """
    features, confidence = student
    taught, trust, sharpness = teacher
    pairs = len(visible)
    wanted = torch.softmax(_likeness(taught, reference_pixels, query_pixels) * sharpness, -1)
    found = F.log_softmax(_likeness(features, reference_pixels, query_pixels) * scale, -1)
    divergence = (wanted * (wanted.clamp(min=1e-8).log() - found)).sum(-1)
    weight = visible * sample(trust[:pairs, None], reference_pixels)[..., 0]
    loss: Tensor = (divergence * weight).sum() / weight.sum().clamp(min=1e-3)
    if confidence.requires_grad:
        with torch.autocast(confidence.device.type, enabled=False):
            loss = loss + F.binary_cross_entropy(confidence.clamp(1e-4, 1 - 1e-4), trust)
    return loss


def _likeness(features: Tensor, reference_pixels: Tensor, query_pixels: Tensor) -> Tensor:
    pairs = len(reference_pixels)
    anchors = sample(features[:pairs], reference_pixels)
    return window_similarity(anchors, features[pairs:], query_pixels)
