"""`tiny` with encoder and decoder in eight bits, for processors with 8-bit dot products.

Activations get one scale each, weights one a channel. The first convolution, the fixed orientation
channels, the last convolutions and the unit length stay in float32.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import numpy_helper
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

from localizer.errors import ModelError
from localizer.features.extractor import OnnxExtractor, read_model_info
from localizer.synth.appearance.model import apply_appearance, sample_appearance
from localizer.training.data.batches import tamed
from localizer.training.data.shards import read_shard
from localizer.types import Image

_QUANTIZED = ("/stage", "/lateral", "/down", "/merge")  # in names of convolutions and ReLUs
_LEAST_COSINE = 0.99  # of the features to the float32 ones, mean of an image's level


class _Images(CalibrationDataReader):
    def __init__(self, images: Sequence[Image]) -> None:
        self._left: Iterator[Image] = iter(images)

    def get_next(self) -> dict[str, Image] | None:
        image = next(self._left, None)
        return None if image is None else {"image": image[None]}


def _images(shards: Sequence[Path]) -> Iterator[Image]:
    for k, path in enumerate(shards):
        rng = np.random.default_rng(k)
        for pair in read_shard(path)[:1]:
            look = tamed(sample_appearance(rng), pair.query_depth)
            yield pair.reference
            yield apply_appearance(pair.query, pair.query_depth, look, rng)


def _join(graph: onnx.GraphProto, first: str, second: str) -> None:
    """One convolution instead of two of the same input, where both are there: the same values."""
    nodes = {node.name: node for node in graph.node}
    if not {first, second} <= nodes.keys():
        return
    values = {i.name: i for i in graph.initializer}
    one, other = nodes[first], nodes[second]
    parts = [numpy_helper.to_array(values[n.input[1]]) for n in (one, other)]
    for a, b in zip(one.input[1:], other.input[1:], strict=True):
        both = np.concatenate([numpy_helper.to_array(values[n]) for n in (a, b)])
        values[a].CopyFrom(numpy_helper.from_array(both, a))
        graph.initializer.remove(values[b])
    sizes = numpy_helper.from_array(np.array([len(p) for p in parts]), f"{first}/sizes")
    graph.initializer.append(sizes)
    split = onnx.helper.make_node("Split", [f"{first}/both", sizes.name],
                                  [one.output[0], other.output[0]], axis=1)  # fmt: skip
    one.output[0] = f"{first}/both"
    graph.node.insert(list(graph.node).index(one) + 1, split)
    graph.node.remove(other)


def quantize(model: Path, out: Path, shards: Sequence[Path]) -> float:
    """Write the quantized `model` and its JSON. The activations of the first pair of each of the
    shards, a reference and a degraded query, set the scales; returns the least mean cosine of any
    level of these images to the features of `model`.
    """
    images = list(_images(shards))
    info = read_model_info(model)
    graph = onnx.load(str(model))
    names = [node.name for node in graph.graph.node if node.op_type in ("Conv", "Relu")
             and any(part in node.name for part in _QUANTIZED)]  # fmt: skip
    if not names or not images:
        raise ModelError(f"{model}: quantizing needs a network of `tiny` and shards, got "
                         f"{len(names)} of its convolutions and {len(images)} images")  # fmt: skip
    for k in range(len(info.levels)):
        _join(graph.graph, f"/network/features.{k}/Conv", f"/network/share.{k}/Conv")
    quantize_static(
        graph, str(out), _Images(images), quant_format=QuantFormat.QDQ, per_channel=True,
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
