"""A published model back into trainable form, so that training can go on without its checkpoint."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn

from localizer.errors import ModelError
from localizer.features.extractor import read_model_info
from localizer.training.model import MobileOneBlock, ModelConfig, TinyNet
from localizer.types import Image


def unfuse(model: Path, images: list[Image]) -> TinyNet:
    """The network of an exported `model`, the same function in evaluation mode.

    Every fused convolution becomes a convolution with batch normalisation whose statistics are
    those of `images` (each (H, W, 3) uint8, sides divisible by 8) and whose gain undoes them, so
    that the function stays about the same in training mode too. A model whose share of the fixed
    channels is one number a level gets it as the bias of the share at every pixel.
    """
    info = read_model_info(model)
    network = TinyNet(ModelConfig.model_validate(info.training["model"])).eval()
    values = {i.name: numpy_helper.to_array(i) for i in onnx.load(str(model)).graph.initializer}
    weights = {k.removeprefix("network."): torch.tensor(v) for k, v in values.items()}
    blocks = {n: m for n, m in network.named_modules() if isinstance(m, MobileOneBlock)}
    with torch.no_grad():
        for name, block in blocks.items():
            _fill_block(block, *(_take(weights, f"{name}.0.{kind}", model) for kind in _KINDS))
        for name, module in network.named_modules():
            plain = isinstance(module, nn.Conv2d) and not name.endswith(".main.0")
            if plain and not (name.startswith("share.") and f"{name}.weight" not in weights):
                for kind in _KINDS:
                    getattr(module, kind).copy_(_take(weights, f"{name}.{kind}", model))
        constants = [v for k, v in values.items() if k.startswith("onnx::Sigmoid")]
        for conv, constant in zip(network.share, constants, strict=False):
            conv.bias.fill_(float(constant))
        _calibrate(network, list(blocks.values()), images)
    return network


_KINDS = ("weight", "bias")


def _take(weights: dict[str, Tensor], name: str, model: Path) -> Tensor:
    if name not in weights:
        raise ModelError(f"{model}: has no {name}; it was not exported from this network")
    return weights[name]


def _fill_block(block: MobileOneBlock, weight: Tensor, bias: Tensor) -> None:
    """Weights for normalisation that does nothing yet; the identity branch is taken out again."""
    inputs, outputs, size, _, groups, _ = block.shape
    weight = weight.clone()
    if block.residual:
        index = torch.arange(outputs)
        weight[index, index % (inputs // groups), size // 2, size // 2] -= 1.0
    conv, norm = block.main
    conv.weight.copy_(weight)
    norm.running_mean.zero_()
    norm.running_var.fill_(1.0 - norm.eps)
    norm.weight.fill_(1.0)
    norm.bias.copy_(bias)


def _calibrate(network: TinyNet, blocks: list[MobileOneBlock], images: list[Image]) -> None:
    """Give every normalisation the statistics of its input, and a gain and shift that undo them."""
    seen: dict[int, list[Tensor]] = {k: [] for k in range(len(blocks))}
    hooks = [
        block.main[0].register_forward_hook(
            lambda _, __, y, k=k: seen[k].append(torch.stack([y.mean((0, 2, 3)),
                                                             (y * y).mean((0, 2, 3))]))
        )
        for k, block in enumerate(blocks)
    ]  # fmt: skip
    for image in images:
        tensor = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None]
        network(tensor.float() / 255.0)
    for hook in hooks:
        hook.remove()
    for k, block in enumerate(blocks):
        norm = block.main[1]
        mean, square = torch.stack(seen[k]).mean(0)
        variance = (square - mean * mean).clamp(min=1e-6)
        norm.running_mean.copy_(mean)
        norm.running_var.copy_(variance)
        norm.weight.copy_(torch.sqrt(variance + norm.eps))
        norm.bias.add_(mean)
