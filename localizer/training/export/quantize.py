"""`tiny` with its costly convolutions in eight bits, for processors with 8-bit dot products.

Half of the network's time is the decoder's four dense 3 x 3 convolutions. They alone are quantized
(activations to one scale each, weights to one a channel); the image, the fixed orientation
channels, the encoder and the unit length stay in float32.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import onnx
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

from localizer.errors import ModelError
from localizer.features.extractor import OnnxExtractor, read_model_info
from localizer.types import Image

_DECODER = "/merge"  # in the names of the convolutions and of their ReLUs
_LEAST_COSINE = 0.99  # of the features to the float32 ones, mean of an image's level


class _Images(CalibrationDataReader):  # type: ignore[misc]
    def __init__(self, images: Sequence[Image]) -> None:
        self._left: Iterator[Image] = iter(images)

    def get_next(self) -> dict[str, Image] | None:
        image = next(self._left, None)
        return None if image is None else {"image": image[None]}


def quantize(model: Path, out: Path, images: Sequence[Image]) -> float:
    """Write the quantized `model` and its JSON; returns the least mean cosine of any level of the
    images (each (H, W, 3) uint8), whose activations set the scales, to the features of `model`.
    """
    info = read_model_info(model)
    names = [node.name for node in onnx.load(str(model)).graph.node
             if node.op_type in ("Conv", "Relu") and _DECODER in node.name]  # fmt: skip
    if not names or not images:
        raise ModelError(f"{model}: quantizing needs a network of `tiny` and shards, got "
                         f"{len(names)} of its convolutions and {len(images)} images")  # fmt: skip
    quantize_static(
        str(model), str(out), _Images(images), quant_format=QuantFormat.QDQ, per_channel=True,
        activation_type=QuantType.QUInt8, weight_type=QuantType.QInt8, nodes_to_quantize=names,
    )  # fmt: skip
    described = info.model_dump(mode="json") | {
        "name": f"{info.name}-int8",
        "sha256": hashlib.sha256(out.read_bytes()).hexdigest(),
        "training": info.training | {"quantized": {"from": info.sha256, "images": len(images)}},
    }
    out.with_suffix(".json").write_text(json.dumps(described, indent=2) + "\n")
    exact, quantized = (OnnxExtractor(m, threads=1, only="CPU") for m in (model, out))
    cosines = [
        float((a.features * b.features).sum(-1).mean())
        for image in images
        for a, b in zip(exact.extract(image).levels, quantized.extract(image).levels, strict=True)
    ]
    if min(cosines) < _LEAST_COSINE:
        raise ModelError(f"{out}: its features' mean cosine to float32 is {min(cosines):.4f} at "
                         f"worst; from {_LEAST_COSINE} on is allowed")  # fmt: skip
    return min(cosines)
