"""A published model back into trainable form, so that training can go on without its checkpoint."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from pydantic import TypeAdapter, ValidationError
from torch import Tensor, nn

from localizer.errors import ModelError
from localizer.features.extractor import read_model_info
from localizer.synth.appearance.model import apply_appearance, sample_appearance
from localizer.training.data.batches import tamed
from localizer.training.data.shards import read_shard
from localizer.training.models.networks import Network, NetworkConfig, build
from localizer.training.models.s0 import BranchedBlock, S0Config, S0Net
from localizer.training.models.tiny import MobileOneBlock, ModelConfig, TinyNet
from localizer.types import Image

_KINDS = ("weight", "bias")


def shard_images(shards: Sequence[Path]) -> Iterator[Image]:
    """One reference and one degraded query of every shard: (H, W, 3) uint8."""
    for k, path in enumerate(shards):
        rng = np.random.default_rng(k)
        for pair in read_shard(path)[:1]:
            look = tamed(sample_appearance(rng), pair.query_depth)
            yield pair.reference
            yield apply_appearance(pair.query, pair.query_depth, look, rng)


def trainable_network(model: Path, images: list[Image]) -> Network:
    """The network of an exported `model`, the same function in evaluation mode.

    Every fused convolution becomes a convolution with batch normalisation whose statistics are
    those of `images` (each (H, W, 3) uint8, sides divisible by 8) and whose gain undoes them, so
    that the function stays about the same in training mode too. `s0`'s other branches start with a
    gain of zero. A `tiny` whose share of the fixed channels is one number a level gets it as the
    bias of the share at every pixel.
    """
    if not images:
        raise ModelError(
            "unfusing needs training pairs to take statistics on, got no shard with any"
        )
    network: Network = build(_config(model)).eval()
    try:
        values = {i.name: numpy_helper.to_array(i) for i in onnx.load(str(model)).graph.initializer}
    except Exception as error:  # protobuf's and onnx's own
        raise ModelError(f"{model}: not an ONNX model: {error}") from error
    weights = {
        k.removeprefix("network."): torch.tensor(v.astype(np.float32))
        for k, v in values.items()
        if v.dtype.kind == "f"
    }
    fused = dict(_fused(network))
    with torch.no_grad():
        for name, (conv, norm, identity) in fused.items():
            weight, bias = (_take(weights, f"{name}.0.{kind}", model) for kind in _KINDS)
            conv.weight.copy_(weight - identity)
            norm.running_mean.zero_()
            norm.running_var.fill_(1.0 - norm.eps)
            norm.weight.fill_(1.0)
            norm.bias.copy_(bias)
        for name, module in network.named_modules():
            plain = isinstance(module, nn.Conv2d) and not name.startswith(tuple(fused))
            if plain and not (name.startswith("share.") and f"{name}.weight" not in weights):
                for kind in _KINDS:
                    getattr(module, kind).copy_(_take(weights, f"{name}.{kind}", model))
        if isinstance(network, TinyNet):
            constants = [v for k, v in values.items() if k.startswith("onnx::Sigmoid")]
            for share, constant in zip(network.share, constants, strict=False):
                share.bias.fill_(float(constant))
        _calibrate(network, [(conv, norm) for conv, norm, _ in fused.values()], images)
    return network


def _config(model: Path) -> ModelConfig | S0Config:
    described = read_model_info(model).training.get("model")
    adapter: TypeAdapter[ModelConfig | S0Config] = TypeAdapter(NetworkConfig)
    try:
        return adapter.validate_python(described)
    except ValidationError as error:
        raise ModelError(f"{model}: its description names no network of this training") from error


def _fused(network: Network) -> Iterator[tuple[str, tuple[nn.Conv2d, nn.BatchNorm2d, Tensor]]]:
    """Name of each part that is one convolution in the model, what is to carry it, and the identity
    that the part adds by itself. The other branches of the part are silenced.
    """
    for name, module in network.named_modules():
        if isinstance(module, MobileOneBlock):
            inputs, outputs, size, _, groups, _ = module.shape
            identity = torch.zeros_like(module.main[0].weight)
            if module.residual:
                index = torch.arange(outputs)
                identity[index, index % (inputs // groups), size // 2, size // 2] = 1.0
            yield name, (module.main[0], module.main[1], identity)
        elif isinstance(module, BranchedBlock):
            first, *others = module.convolutions
            silent = [branch[1] for branch in (*others, *filter(None, [module.point]))]
            for norm in (*silent, *filter(None, [module.skip])):
                nn.init.zeros_(norm.weight)
                nn.init.zeros_(norm.bias)
            yield name, (first[0], first[1], torch.zeros_like(first[0].weight))
    if isinstance(network, S0Net):
        for k, block in enumerate(network.decoder):
            yield f"decoder.{k}", (block[0], block[1], torch.zeros_like(block[0].weight))


def _take(weights: dict[str, Tensor], name: str, model: Path) -> Tensor:
    if name not in weights:
        raise ModelError(f"{model}: has no {name}; it was not exported from this network")
    return weights[name]


def _calibrate(
    network: Network, parts: list[tuple[nn.Conv2d, nn.BatchNorm2d]], images: list[Image]
) -> None:
    """Give every normalisation the statistics of its input, and a gain and shift that undo them."""
    seen: dict[int, list[Tensor]] = {k: [] for k in range(len(parts))}
    hooks = [
        conv.register_forward_hook(
            lambda _, __, y, k=k: seen[k].append(torch.stack([y.mean((0, 2, 3)),
                                                             (y * y).mean((0, 2, 3))]))
        )
        for k, (conv, _) in enumerate(parts)
    ]  # fmt: skip
    for image in images:
        tensor = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None]
        network(tensor.float() / 255.0)
    for hook in hooks:
        hook.remove()
    for k, (_, norm) in enumerate(parts):
        mean, square = torch.stack(seen[k]).mean(0)
        variance = (square - mean * mean).clamp(min=1e-6)
        norm.running_mean.copy_(mean)
        norm.running_var.copy_(variance)
        norm.weight.copy_(torch.sqrt(variance + norm.eps))
        norm.bias.add_(mean)
