"""OpenVINO: where it is chosen, what happens if it fails, its features where it is installed."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from importlib.machinery import ModuleSpec
from pathlib import Path

import numpy as np
import pytest

from localizer.features import providers
from localizer.features.extractor import SHIPPED_MODEL, OnnxExtractor, load_extractor
from localizer.features.openvino_session import OpenVinoSession, is_worthwhile
from localizer.features.subgraph import cut_to_outputs

FLAGS = "processor\t: 0\nflags\t\t: fpu avx512f amx_bf16 amx_tile\n"


def image(seed: int, width: int = 64, height: int = 48) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


@pytest.mark.parametrize(
    ("installed", "text", "wanted"),
    [
        (True, FLAGS, True),
        (False, FLAGS, False),
        (True, FLAGS.replace("amx_bf16", "avx512_bf16"), True),
        (True, FLAGS.replace("amx_bf16", "avx512_vnni"), False),
        (True, "CPU architecture: 8\nFeatures: asimd bf16\n", False),
        (True, None, False),
    ],
)
def test_it_is_used_where_the_processor_has_bfloat16(
    installed, text, wanted, tmp_path, monkeypatch
):
    spec = ModuleSpec("openvino", None) if installed else None
    monkeypatch.setattr("importlib.util.find_spec", lambda _: spec)
    file = tmp_path / "cpuinfo"
    if text is not None:
        file.write_text(text)
    assert is_worthwhile(file) is wanted


class Refuses:
    """Starts, and fails with the first image."""

    def __init__(self, model: Path, threads: int) -> None:
        pass

    def run(self, outputs: list[str], inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
        raise RuntimeError("Illegal instruction set\nat line 17")


def test_where_it_fails_onnxruntime_serves_and_one_line_says_so(monkeypatch, caplog):
    monkeypatch.setattr(providers, "is_worthwhile", lambda: True)
    monkeypatch.setattr(providers, "OpenVinoSession", Refuses)
    with caplog.at_level(logging.WARNING):
        extractor = OnnxExtractor(SHIPPED_MODEL)
    assert extractor.name == "tiny (onnxruntime, CPU)"
    (line,) = caplog.messages
    assert line.startswith("features: OpenVINO does not run tiny.onnx, trying CPU: ")
    assert line.endswith("Illegal instruction set")


def test_its_features_are_onnxruntimes_to_a_few_percent(monkeypatch):
    pytest.importorskip("openvino", reason="the extra openvino is not installed")
    monkeypatch.setattr(providers, "is_worthwhile", lambda: True)
    exact = OnnxExtractor(SHIPPED_MODEL, threads=1, only="CPU")
    extractor = OnnxExtractor(SHIPPED_MODEL, threads=1)
    assert extractor.name == "tiny (OpenVINO, CPU, bfloat16)"
    for size in ((64, 48), (96, 64)):
        picture = image(0, *size)
        for level, wanted in zip(
            extractor.extract(picture).levels, exact.extract(picture).levels, strict=True
        ):
            assert level.features.shape == wanted.features.shape
            assert np.linalg.norm(level.features - wanted.features, axis=-1).mean() < 0.03
            assert np.abs(level.confidence - wanted.confidence).mean() < 0.01


def test_callers_on_several_threads_have_results_of_their_own():
    pytest.importorskip("openvino", reason="the extra openvino is not installed")
    session = OpenVinoSession(SHIPPED_MODEL.read_bytes(), 1)
    pictures = [image(seed)[None] for seed in range(8)]

    def features(picture: np.ndarray) -> np.ndarray:
        found: np.ndarray = session.run(["learned_2"], {"image": picture})[0]
        return found

    one_by_one = [features(picture) for picture in pictures]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(features, pictures))
    assert not np.allclose(one_by_one[0], one_by_one[1])
    for a, b in zip(one_by_one, together, strict=True):
        np.testing.assert_array_equal(a, b)


def test_it_tells_its_maker_nothing():
    """Importing it reported its use, on a thread of its own."""
    pytest.importorskip("openvino", reason="the extra openvino is not installed")
    code = (
        "import os, sys, threading, numpy; sys.addaudithook(lambda e, a: os._exit(9) if "
        "e.startswith('socket.') else None); "
        "from localizer.features.openvino_session import OpenVinoSession as S; "
        f"S(open({str(SHIPPED_MODEL)!r}, 'rb').read(), 1)"
        ".run(['learned_0'], {'image': numpy.zeros((1, 32, 32, 3), numpy.uint8)}); "
        "assert threading.active_count() == 1, threading.enumerate()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False, text=True)
    assert done.returncode == 0, done.stderr


# --- A network cut to some of its outputs computes the same there, and nothing for the others ---


COARSE = ["learned_0", "learned_1"]


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
    rgb = picture(256)
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


# --- Importing the localizer must not start onnxruntime's telemetry -----------------------------


def test_no_device_id_is_written(tmp_path):
    """onnxruntime with telemetry leaves a device id and a queue in the cache folder."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("ORT_", "XDG_"))}
    environment["HOME"] = str(tmp_path)
    subprocess.run([sys.executable, "-c", "import localizer.features"], env=environment, check=True)
    assert not list(tmp_path.rglob("*onnxruntime*"))
