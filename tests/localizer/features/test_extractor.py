from __future__ import annotations

import hashlib
import json
import logging
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from localizer.errors import ModelError
from localizer.features import extractor
from localizer.features.detail import DetailExtractor, detail_level
from localizer.features.extractor import OnnxExtractor, load_extractor, model_key
from localizer.features.gradient import GradientExtractor
from localizer.types import FeaturePyramid


@pytest.fixture
def image() -> np.ndarray:
    rng = np.random.default_rng(3)
    small = rng.integers(0, 256, (30, 40, 3), dtype=np.uint8)
    return cv2.resize(small, (320, 240), interpolation=cv2.INTER_CUBIC)


def assert_is_pyramid(pyramid: FeaturePyramid, image: np.ndarray) -> None:
    assert (pyramid.width, pyramid.height) == (image.shape[1], image.shape[0])
    strides = [level.stride for level in pyramid.levels]
    assert strides == sorted(strides, reverse=True)
    for level in pyramid.levels:
        shape = (image.shape[0] // level.stride, image.shape[1] // level.stride)
        assert level.features.shape[:2] == shape
        assert level.confidence.shape == shape
        assert level.features.dtype == level.confidence.dtype == np.float32
        assert level.features.flags.c_contiguous
        np.testing.assert_allclose(np.linalg.norm(level.features, axis=-1), 1.0, atol=1e-4)
        assert level.confidence.min() >= 0.0
        assert level.confidence.max() <= 1.0


def test_gradient_ignores_exposure_and_contrast_sign(image: np.ndarray) -> None:
    extract = GradientExtractor().extract
    plain, darker, inverted = extract(image), extract(image // 2), extract(255 - image)
    for a, b, c in zip(plain.levels, darker.levels, inverted.levels, strict=True):
        assert float((a.features * b.features).sum(-1).mean()) > 0.97
        assert float((a.features * c.features).sum(-1).mean()) > 0.97


@pytest.mark.parametrize(
    "bad",
    [
        np.zeros((240, 321, 3), np.uint8),
        np.zeros((240, 320), np.uint8),
        np.zeros((240, 320, 3), np.float32),
    ],
)
def test_bad_images_are_named(bad: np.ndarray) -> None:
    with pytest.raises(ModelError, match="image"):
        GradientExtractor().extract(bad)


def test_without_shipped_weights_the_fallback_says_so(monkeypatch, tmp_path, caplog):
    monkeypatch.setattr(extractor, "SHIPPED_MODEL", tmp_path / "tiny.onnx")
    with caplog.at_level(logging.WARNING):
        loaded = load_extractor()
    assert "fallback" in loaded.name
    assert "tiny.onnx" in caplog.text


def test_shipped_weights_run_at_sizes_divisible_by_eight(image: np.ndarray) -> None:
    loaded = load_extractor(threads=1)
    assert isinstance(loaded, OnnxExtractor)
    assert loaded.name.startswith("tiny (")
    assert_is_pyramid(loaded.extract(image), image)
    odd = np.ascontiguousarray(image[:200, :264])
    assert_is_pyramid(loaded.extract(odd), odd)
    with pytest.raises(ModelError, match="divisible by 8"):
        loaded.extract(np.ascontiguousarray(image[:, :300]))


def test_a_model_asked_for_by_path_must_exist(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="no such model file"):
        load_extractor(tmp_path / "other.onnx")


def copied_model(folder: Path) -> Path:
    model = folder / "tiny.onnx"
    model.write_bytes(extractor.SHIPPED_MODEL.read_bytes())
    model.with_suffix(".json").write_text(extractor.SHIPPED_MODEL.with_suffix(".json").read_text())
    return model


def test_two_models_of_one_name_are_told_apart(tmp_path: Path) -> None:
    """What is kept of a map's features is of one of them: the other would find no place by it."""
    model = tmp_path / "again.onnx"
    model.write_bytes(extractor.SHIPPED_MODEL.read_bytes() + b"\x32\x01x")  # protobuf: a remark
    description = json.loads(extractor.SHIPPED_MODEL.with_suffix(".json").read_text())
    description["sha256"] = hashlib.sha256(model.read_bytes()).hexdigest()
    model.with_suffix(".json").write_text(json.dumps(description))
    shipped, trained = load_extractor(), load_extractor(model)
    assert shipped.name == trained.name
    assert model_key(shipped) != model_key(trained)
    assert model_key(shipped) == model_key(load_extractor())


def test_a_changed_byte_is_found(tmp_path: Path) -> None:
    model = copied_model(tmp_path)
    data = bytearray(model.read_bytes())
    data[len(data) // 2] ^= 1
    model.write_bytes(data)
    with pytest.raises(ModelError, match="SHA-256"):
        load_extractor(model)


def test_a_description_that_lies_about_levels_is_found(tmp_path: Path) -> None:
    model = copied_model(tmp_path)
    description = json.loads(model.with_suffix(".json").read_text())
    description["levels"][0]["channels"] += 1
    model.with_suffix(".json").write_text(json.dumps(description))
    with pytest.raises(ModelError, match="its description says"):
        load_extractor(model)


def test_a_description_that_lies_about_a_stride_is_found(tmp_path: Path) -> None:
    model = copied_model(tmp_path)
    description = json.loads(model.with_suffix(".json").read_text())
    description["levels"][0]["stride"] *= 2
    model.with_suffix(".json").write_text(json.dumps(description | {"multiple": 16}))
    with pytest.raises(ModelError, match="for a level of 4x4"):
        load_extractor(model)


def test_a_description_that_leaves_a_level_out_is_found(tmp_path: Path) -> None:
    model = copied_model(tmp_path)
    path = model.with_suffix(".json")
    description = json.loads(path.read_text())
    del description["levels"][-1]
    path.write_text(json.dumps(description))
    with pytest.raises(ModelError, match="outputs, its description names"):
        load_extractor(model)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"levels": [{"stride": 2, "channels": 32}, {"stride": 4, "channels": 32}]}, "coarse to"),
        ({"multiple": 12}, "not divisible by the strides"),
        ({"multiple": 4096}, "multiple"),
        ({"levels": []}, "levels"),
    ],
)
def test_a_description_of_no_pyramid_is_found(tmp_path, change, why):
    model = tmp_path / "tiny.onnx"
    model.write_bytes(extractor.SHIPPED_MODEL.read_bytes())
    description = json.loads(extractor.SHIPPED_MODEL.with_suffix(".json").read_text()) | change
    model.with_suffix(".json").write_text(json.dumps(description))
    with pytest.raises(ModelError, match=why) as refused:
        OnnxExtractor(model)
    assert "\n" not in str(refused.value)


def test_a_file_that_is_no_graph_is_found(tmp_path: Path) -> None:
    model = copied_model(tmp_path)
    model.write_bytes(b"not a graph")
    description = json.loads(model.with_suffix(".json").read_text())
    description["sha256"] = hashlib.sha256(b"not a graph").hexdigest()
    model.with_suffix(".json").write_text(json.dumps(description))
    with pytest.raises(ModelError, match="cannot load"):
        load_extractor(model)


def test_a_model_without_description_is_found(tmp_path: Path) -> None:
    model = copied_model(tmp_path)
    model.with_suffix(".json").unlink()
    with pytest.raises(ModelError, match="JSON"):
        load_extractor(model)


def test_the_flight_path_does_not_import_torch() -> None:
    code = "import sys, localizer.features; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# --- The detail level: invariant to light, exact in position ------------------------------------


@pytest.fixture(scope="module")
def image_detail():
    rng = np.random.default_rng(0)
    noise = rng.uniform(60, 180, (60, 80, 3)).astype(np.float32)
    return cv2.GaussianBlur(noise, (0, 0), 2.0) * 3.0 - 240.0


def bytes_of(values):
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def test_it_is_the_last_level_of_the_pyramid(image_detail):
    pyramid = DetailExtractor(GradientExtractor()).extract(bytes_of(image_detail)[:56])
    assert [level.stride for level in pyramid.levels] == [8, 4, 2, 1]
    detail = pyramid.levels[-1]
    assert detail.features.shape == (56, 80, 4)
    assert detail.features.dtype == detail.confidence.dtype == np.float32
    assert detail.features.flags.c_contiguous
    assert 0 < detail.confidence.min() <= detail.confidence.max() < 1


def test_exposure_and_contrast_cancel(image_detail):
    bright, dim = (
        detail_level(bytes_of(image_detail)),
        detail_level(bytes_of(0.6 * image_detail + 30)),
    )
    inside = (slice(12, -12), slice(12, -12))
    difference = np.abs(bright.features - dim.features)[inside]
    assert np.median(difference) < 0.1 * bright.features[inside].std()


def test_it_moves_with_the_image(image_detail):
    moved = detail_level(bytes_of(np.roll(image_detail, (3, -5), (0, 1)))).features
    inside = (slice(20, -20), slice(20, -20))
    still = np.roll(detail_level(bytes_of(image_detail)).features, (3, -5), (0, 1))
    np.testing.assert_allclose(moved[inside], still[inside], atol=2e-3)


def test_the_contrast_is_that_of_a_gaussian_window_of_five_pixels(image_detail):
    image = bytes_of(image_detail)
    smooth = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) / 255.0, (0, 0), 0.8)
    mean, squares = (cv2.GaussianBlur(v, (0, 0), 5.0) for v in (smooth, smooth**2))
    contrast = np.sqrt(squares - mean**2) + 0.01
    inside = (slice(12, -12), slice(12, -12))
    expected = (0.3 * (smooth - mean) / contrast)[inside]
    difference = np.abs(detail_level(image).features[..., 0][inside] - expected)
    assert difference.mean() < 0.02 * np.abs(expected).mean()


def test_a_flat_image_has_no_confidence_and_no_structure():
    level = detail_level(np.full((40, 40, 3), 128, np.uint8))
    assert np.abs(level.features).max() < 1e-3
    assert level.confidence.max() < 0.5
