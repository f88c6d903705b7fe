"""Checkpoint to a model for the flight path: ONNX graph, description with hash, parity check."""

from __future__ import annotations

import copy
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from pydantic import ValidationError
from torch import Tensor, nn

from localizer.errors import ModelError
from localizer.features.extractor import OnnxExtractor
from localizer.training.checkpoint import load_weights, read_checkpoint
from localizer.training.config import TrainConfig
from localizer.training.models.networks import Network, build, fuse
from localizer.training.models.s0 import S0Net
from localizer.training.models.tiny import TinyNet

OPSET = 17
_TOLERANCE = 2e-4  # largest difference of a feature between torch and onnxruntime
_HALF_COSINE = 0.999  # least mean cosine of float16 features to the float32 ones


@dataclass(frozen=True)
class Parity:
    """How a model differs from torch in float32: largest difference of any output, and the mean
    cosine of the features on the worst level.
    """

    difference: float
    cosine: float


class Deployed(nn.Module):
    """The network as the flight path uses it: uint8 channels-last in, channels-last out. half:
    converts the network, in place, to float16; its outputs are float32 all the same.
    """

    def __init__(self, network: nn.Module, *, half: bool = False) -> None:
        super().__init__()
        self.network = network.half() if half else network
        self._kind = torch.float16 if half else torch.float32

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        """(1, H, W, 3) uint8 to features (1, h, w, C) and confidence (1, h, w) per level; of
        `tiny` to what `orientation_level` needs, (1, h, w, C - 7) per level.
        """
        planes = image.permute(0, 3, 1, 2).to(self._kind) / 255.0
        if isinstance(self.network, TinyNet):
            return tuple(f.permute(0, 2, 3, 1) for f in self.network.learned(planes))
        return tuple(t for f, c in self.network(planes) for t in (f.permute(0, 2, 3, 1), c))


def load_network(checkpoint: Path) -> tuple[Network, TrainConfig, dict[str, object]]:
    """The averaged network of a checkpoint in evaluation mode, its configuration, its progress.
    `ModelError` if the checkpoint is not a run's or of another version.
    """
    state = read_checkpoint(checkpoint)
    try:
        config = TrainConfig.model_validate(state["config"])
        progress: dict[str, object] = {"steps": state["step"], "seconds": round(state["seconds"])}
    except KeyError as error:
        raise ModelError(f"{checkpoint}: holds weights alone, no {error}: not a run's") from error
    except ValidationError as error:
        raise ModelError(f"{checkpoint}: of another version of the training: {error}") from error
    network = build(config.model)
    load_weights(network, state["average"], checkpoint)
    return network.eval(), config, progress


def export(checkpoint: Path, model: Path, *, half: bool = False) -> Parity:
    """Write `model` (ONNX) and its JSON; returns its checked difference from torch in float32.

    half: float16 inside, for GPUs; only for s0, because tiny's fixed channels need float32.
    `ModelError` for a precision that the network does not support, or a difference above rounding;
    then nothing is written.
    """
    network, config, progress = load_network(checkpoint)
    if half and not isinstance(network, S0Net):
        raise ModelError(f"{checkpoint}: float16 is for s0; tiny's fixed channels need float32")
    exact = fuse(network).eval()
    deployed = Deployed(copy.deepcopy(exact) if half else exact, half=half).eval()
    kinds = ("learned",) if isinstance(network, TinyNet) else ("features", "confidence")
    names = [f"{kind}_{k}" for k in range(len(network.strides)) for kind in kinds]
    axes = {"image": {1: "height", 2: "width"}}
    axes |= {name: {1: f"h{name[-1]}", 2: f"w{name[-1]}"} for name in names}
    model.parent.mkdir(parents=True, exist_ok=True)
    # A good model of that name stays until the new one has passed.
    made = model.with_name(f".{model.stem}-unchecked.onnx")
    try:
        torch.onnx.export(
            deployed,
            (torch.zeros(1, 64, 96, 3, dtype=torch.uint8),),
            str(made),
            input_names=["image"],
            output_names=names,
            dynamic_axes=axes,
            opset_version=OPSET,
            dynamo=False,
        )
        description = {
            "name": f"{config.name}-float16" if half else config.name,
            "sha256": hashlib.sha256(made.read_bytes()).hexdigest(),
            "levels": [{"stride": s, "channels": config.model.channels} for s in network.strides],
            "orientation": isinstance(network, TinyNet),
            "parameters": sum(p.numel() for p in network.parameters()),
            "training": {
                "seed": config.seed,
                **progress,
                "model": config.model.model_dump(mode="json"),
                "optimizer": config.optimizer.model_dump(mode="json"),
                # Paths are of one machine; what decides the weights is the rest.
                "warm_start": config.warm_start is not None,
                "data": config.data.model_dump(
                    mode="json", exclude={"shards", "photos", "workers"}
                ),
            },
        }
        made.with_suffix(".json").write_text(json.dumps(description, indent=2) + "\n")
        parity = check_parity(exact, made, half=half)
        made.replace(model)
        made.with_suffix(".json").replace(model.with_suffix(".json"))
    finally:
        for left in (made, made.with_suffix(".json")):
            left.unlink(missing_ok=True)
    return parity


def check_parity(network: nn.Module, model: Path, *, half: bool = False) -> Parity:
    """Compare onnxruntime with torch in float32 on an image of another size; ModelError if they
    differ by more than rounding explains. Both compute on the CPU: CUDA rounds products to TF32.
    """
    image = np.random.default_rng(0).integers(0, 256, (120, 168, 3), dtype=np.uint8)
    pyramid = OnnxExtractor(model, threads=1, only="CPU").extract(image)
    with torch.no_grad():
        expected = network(torch.from_numpy(image[None]).permute(0, 3, 1, 2).float() / 255.0)
    worst, cosines = 0.0, []
    for level, (f, c) in zip(pyramid.levels, expected, strict=True):
        features, confidence = f[0].permute(1, 2, 0).numpy(), c[0].numpy()
        worst = max(worst, float(np.abs(level.features - features).max()))
        worst = max(worst, float(np.abs(level.confidence - confidence).max()))
        cosines.append(float((level.features * features).sum(-1).mean()))
    parity = Parity(worst, min(cosines))
    if (parity.cosine < _HALF_COSINE) if half else (worst > _TOLERANCE):
        raise ModelError(
            f"{model}: differs from torch by {worst:.2g}, mean cosine {parity.cosine:.5f}; "
            f"allowed are {f'a cosine from {_HALF_COSINE} on' if half else _TOLERANCE}"
        )
    return parity
