"""The networks that a run may name, and what the trainer and the tools need of each."""

from __future__ import annotations

from typing import Annotated

from pydantic import Discriminator, Tag

from localizer.training.models import s0 as model_s0
from localizer.training.models import tiny as model
from localizer.training.models.s0 import S0Config, S0Net
from localizer.training.models.tiny import ModelConfig, TinyNet

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


def fuse(network: Network) -> Network:
    """Fold training's branches into single convolutions, in place; the function stays the same."""
    if isinstance(network, S0Net):
        model_s0.fuse(network)
    else:
        model.fuse(network)
    return network
