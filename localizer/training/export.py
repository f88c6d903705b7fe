"""Checkpoint to a model for the flight path: ONNX graph, description with hash, parity check."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import torch
from pydantic import ValidationError
from torch import Tensor, nn

from localizer.errors import ModelError
from localizer.features.extractor import OnnxExtractor
from localizer.training.checkpoint import fill, read_checkpoint
from localizer.training.config import TrainConfig
from localizer.training.model import STRIDES, TinyNet, fuse, parameter_count

OPSET = 17
_TOLERANCE = 2e-4  # largest difference of a feature between torch and onnxruntime


class Deployed(nn.Module):
    """The network as the flight path sees it: uint8 channels-last in, channels-last out."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        """(1, H, W, 3) uint8 to features (1, h, w, C) and confidence (1, h, w) per level."""
        levels = self.network(image.permute(0, 3, 1, 2).float() / 255.0)
        return tuple(t for f, c in levels for t in (f.permute(0, 2, 3, 1), c))


def load_network(checkpoint: Path) -> tuple[TinyNet, TrainConfig, dict[str, object]]:
    """The averaged network of a checkpoint in evaluation mode, its configuration, its progress."""
    state = read_checkpoint(checkpoint)
    try:
        config = TrainConfig.model_validate(state["config"])
        progress: dict[str, object] = {"steps": state["step"], "seconds": round(state["seconds"])}
    except KeyError as error:
        raise ModelError(f"{checkpoint}: holds weights alone, no {error}: not a run's") from error
    except ValidationError as error:
        raise ModelError(f"{checkpoint}: of another version of the training: {error}") from error
    network = TinyNet(config.model)
    fill(network, state["average"], checkpoint)
    return network.eval(), config, progress


def export(checkpoint: Path, model: Path) -> float:
    """Write `model` (ONNX) and its JSON; returns the largest difference to torch, checked."""
    network, config, progress = load_network(checkpoint)
    deployed = Deployed(fuse(network)).eval()
    names = [f"{kind}_{k}" for k in range(len(STRIDES)) for kind in ("features", "confidence")]
    axes = {"image": {1: "height", 2: "width"}}
    axes |= {name: {1: f"h{name[-1]}", 2: f"w{name[-1]}"} for name in names}
    model.parent.mkdir(parents=True, exist_ok=True)
    torch.onnx.export(
        deployed,
        (torch.zeros(1, 64, 96, 3, dtype=torch.uint8),),
        str(model),
        input_names=["image"],
        output_names=names,
        dynamic_axes=axes,
        opset_version=OPSET,
        dynamo=False,
    )
    description = {
        "name": config.name,
        "sha256": hashlib.sha256(model.read_bytes()).hexdigest(),
        "levels": [{"stride": s, "channels": config.model.channels} for s in STRIDES],
        "parameters": parameter_count(network),
        "training": {
            "seed": config.seed,
            **progress,
            "model": config.model.model_dump(mode="json"),
            "optimizer": config.optimizer.model_dump(mode="json"),
            # Paths are of one machine; what decides the weights is the rest.
            "warm_start": config.warm_start is not None,
            "data": config.data.model_dump(mode="json", exclude={"shards", "photos", "workers"}),
        },
    }
    model.with_suffix(".json").write_text(json.dumps(description, indent=2) + "\n")
    return check_parity(deployed, model)


def check_parity(deployed: Deployed, model: Path) -> float:
    """Largest difference between torch and onnxruntime on an image of another size."""
    image = np.random.default_rng(0).integers(0, 256, (120, 168, 3), dtype=np.uint8)
    pyramid = OnnxExtractor(model, threads=1).extract(image)
    with torch.no_grad():
        expected = deployed(torch.from_numpy(image[None]))
    worst = 0.0
    for k, level in enumerate(pyramid.levels):
        worst = max(worst, float(np.abs(level.features - expected[2 * k][0].numpy()).max()))
        worst = max(worst, float(np.abs(level.confidence - expected[2 * k + 1][0].numpy()).max()))
    if worst > _TOLERANCE:
        raise ModelError(f"{model}: differs from torch by {worst:.2g}, more than {_TOLERANCE}")
    return worst
