"""The networks that a run may name, and what the trainer and the tools need of each."""

from __future__ import annotations

from typing import Annotated

from pydantic import Discriminator, Tag
from torch import nn

from localizer.training.models.s0 import BranchedBlock, S0Config, S0Net
from localizer.training.models.tiny import MobileOneBlock, ModelConfig, TinyNet, folded_branch

Network = TinyNet | S0Net


def _named(config: object) -> str:
    """The network that a configuration names; without a name it is `tiny`, as in older files."""
    if isinstance(config, dict):
        return str(config.get("network", "tiny"))
    return str(getattr(config, "network", "tiny"))


NetworkConfig = Annotated[
    Annotated[ModelConfig, Tag("tiny")] | Annotated[S0Config, Tag("s0")], Discriminator(_named)
]


def build(config: ModelConfig | S0Config) -> Network:
    """The untrained network of a configuration; its `strides` say where its levels are."""
    return S0Net(config) if isinstance(config, S0Config) else TinyNet(config)


def fuse(network: nn.Module) -> nn.Module:
    """Fold training's branches and batch normalisations into single convolutions, in place; the
    function stays the same.
    """
    for name, child in network.named_children():
        if isinstance(child, MobileOneBlock | BranchedBlock):
            setattr(network, name, child.fused())
        else:
            fuse(child)
    if isinstance(network, nn.Sequential) and any(
        isinstance(child, nn.BatchNorm2d) for child in network
    ):  # of s0's decoder
        weight, bias = folded_branch(network)
        network[0] = nn.Conv2d(weight.shape[1], weight.shape[0], 3, padding=1)
        network[0].weight, network[0].bias = (nn.Parameter(v.detach()) for v in (weight, bias))
        network[1] = nn.Identity()
    return network
