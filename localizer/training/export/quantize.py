"""The learned convolutions of a model in int8 (static, QDQ), calibrated on training pairs."""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import onnx
from onnxruntime.quantization import (
    CalibrationDataReader,
    CalibrationMethod,
    QuantFormat,
    QuantType,
    quantize_static,
)
from onnxruntime.quantization.shape_inference import quant_pre_process

from localizer.errors import ModelError
from localizer.features.extractor import OnnxExtractor
from localizer.synth.appearance.model import apply_appearance, sample_appearance
from localizer.training.data.batches import tamed
from localizer.training.data.shards import read_shard
from localizer.types import Image

_FIXED = "orientation"  # in the names of the fixed channels' nodes, which stay float
_HEADS = ("features", "share", "projections", "uncertainties")  # of both networks


def quantize(model: Path, out: Path, shards: Sequence[Path]) -> float:
    """Write the int8 form of `model` and its JSON; returns the mean cosine between the features of
    both on the calibration images. Heads and fixed channels stay float. `out` may be `model`: what
    stands there is replaced when the new model is whole.
    """
    OnnxExtractor(model)  # its errors now, not after minutes
    images = list(calibration_images(shards))
    if not images:
        raise ModelError("quantisation needs training pairs to calibrate on, got no shard with any")
    out.parent.mkdir(parents=True, exist_ok=True)
    # Beside `out`, since a file is only replaced at once on its own disk.
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.stem}-") as temporary:
        made = Path(temporary) / out.name
        _write_int8(model, made, images)
        description = json.loads(model.with_suffix(".json").read_text())
        description["name"] += "-int8"
        description["sha256"] = hashlib.sha256(made.read_bytes()).hexdigest()
        made.with_suffix(".json").write_text(json.dumps(description, indent=2) + "\n")
        likeness = _likeness(model, made, images[:8])
        made.replace(out)
        made.with_suffix(".json").replace(out.with_suffix(".json"))
    return likeness


def _write_int8(model: Path, out: Path, images: Sequence[Image]) -> None:
    prepared = out.with_name(f"prepared-{out.name}")
    quant_pre_process(str(model), str(prepared), skip_symbolic_shape=True)
    graph = onnx.load(str(prepared)).graph
    quantize_static(
        str(prepared),
        str(out),
        _Calibration(images),
        quant_format=QuantFormat.QDQ,
        op_types_to_quantize=["Conv", "Add", "Relu", "Resize"],
        per_channel=True,
        activation_type=QuantType.QUInt8,
        weight_type=QuantType.QInt8,
        nodes_to_exclude=[n.name for n in graph.node if _stays_float(n.name)],
        calibrate_method=CalibrationMethod.Entropy,
    )


def _stays_float(node: str) -> bool:
    return _FIXED in node or any(f"/{head}." in node for head in _HEADS)


class _Calibration(CalibrationDataReader):
    def __init__(self, images: Sequence[Image]) -> None:
        self._left = iter(images)

    def get_next(self) -> dict[str, np.ndarray] | None:
        image = next(self._left, None)
        return None if image is None else {"image": image[None]}


def calibration_images(shards: Sequence[Path]) -> Iterator[Image]:
    """One reference and one degraded query of every shard."""
    for k, path in enumerate(shards):
        rng = np.random.default_rng(k)
        for pair in read_shard(path)[:1]:
            look = tamed(sample_appearance(rng), pair.query_depth)
            yield pair.reference
            yield apply_appearance(pair.query, pair.query_depth, look, rng)


def _likeness(model: Path, out: Path, images: Sequence[Image]) -> float:
    before, after = OnnxExtractor(model), OnnxExtractor(out)
    cosines = [
        float((a.features * b.features).sum(-1).mean())
        for image in images
        for a, b in zip(before.extract(image).levels, after.extract(image).levels, strict=True)
    ]
    return float(np.mean(cosines))
