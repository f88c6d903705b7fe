"""The processes of one run under torchrun, or the single process without it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import nn


@dataclass(frozen=True)
class TrainingProcess:
    """This process's rank among `count`, and its device."""

    rank: int
    count: int
    device: torch.device

    @classmethod
    def from_environment(cls) -> TrainingProcess:
        """Join the group that torchrun describes in RANK, WORLD_SIZE and LOCAL_RANK, if any."""
        cuda = torch.cuda.is_available()
        count = int(os.environ.get("WORLD_SIZE", "1"))
        local = int(os.environ.get("LOCAL_RANK", "0"))
        device = torch.device(f"cuda:{local}" if cuda else "cpu")
        if count == 1:
            return cls(0, 1, device)
        if cuda:
            torch.cuda.set_device(device)
        if not dist.is_initialized():
            dist.init_process_group("nccl" if cuda else "gloo")
        return cls(dist.get_rank(), count, device)

    def average_gradients(self, parameters: Sequence[nn.Parameter]) -> None:
        """Replace every process's gradients by their mean, so that all take the same step.

        All gradients are sent as one message: the networks are small, so overlapping with the
        backward pass would gain nothing.
        """
        if self.count == 1:
            return
        gradients = [p.grad for p in parameters if p.grad is not None]
        flat = torch.cat([g.flatten() for g in gradients])
        dist.all_reduce(flat)
        flat /= self.count
        for gradient, mean in zip(
            gradients, flat.split([g.numel() for g in gradients]), strict=True
        ):
            gradient.copy_(mean.view_as(gradient))
