"""A network cut to some of its outputs computes the same there, and nothing for the others."""

from __future__ import annotations

import time

import numpy as np
import pytest

from localizer.features.extractor import SHIPPED_MODEL, load_extractor
from localizer.features.subgraph import cut_to_outputs

COARSE = ["features_0", "confidence_0", "features_1", "confidence_1"]


def picture(side: int = 128) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (side, side, 3), dtype=np.uint8)


def cpu_seconds(extractor, rgb) -> float:
    took = []
    for _ in range(5):
        began = time.process_time()
        extractor.extract(rgb)
        took.append(time.process_time() - began)
    return min(took)


def test_the_levels_that_stay_are_the_same_bit_by_bit_and_cost_half():
    whole, coarse = load_extractor(threads=1), load_extractor(threads=1, finest=4)
    rgb = picture()
    kept = coarse.extract(rgb).levels
    assert [level.stride for level in kept] == [8, 4]
    for level, same in zip(kept, whole.extract(rgb).levels[:2], strict=True):
        np.testing.assert_array_equal(level.features, same.features)
        np.testing.assert_array_equal(level.confidence, same.confidence)
    assert cpu_seconds(coarse, rgb) < 0.6 * cpu_seconds(whole, rgb)


def test_a_cut_model_is_valid_and_one_with_all_outputs_is_untouched():
    onnx = pytest.importorskip("onnx")
    model = SHIPPED_MODEL.read_bytes()
    cut = onnx.load_from_string(cut_to_outputs(model, COARSE))
    onnx.checker.check_model(cut)
    assert [output.name for output in cut.graph.output] == COARSE
    whole = onnx.load_from_string(model)
    names = [output.name for output in whole.graph.output]
    assert cut_to_outputs(model, names) == model
    needed = {name for node in cut.graph.node for name in node.input} | set(COARSE)
    assert all(needed.intersection(node.output) for node in cut.graph.node)
    assert len(cut.graph.node) < len(whole.graph.node)
