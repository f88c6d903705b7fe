"""The fast appearance against the general one that it stands for."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from localizer.synth.appearance.model import Appearance, apply_appearance, sample_appearance
from sitl.camera.imaging import Sensor


def _scene(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    rgb = cv2.resize(rng.integers(0, 256, (15, 20, 3), np.uint8), (160, 120))
    depth = np.linspace(60, 900, 120 * 160, dtype=np.float32).reshape(120, 160)
    depth[:10] = 0  # sky
    return rgb, depth


def _appearances() -> list[Appearance]:
    rng = np.random.default_rng(7)
    drawn = [sample_appearance(rng, name) for name in ("day", "day", "dusk", "fog")]
    return [Appearance(), *drawn]


@pytest.mark.parametrize("index", range(5))
def test_without_noise_the_fast_path_is_the_general_one(index: int) -> None:
    quiet = replace(
        _appearances()[index], shot_noise=0.0, read_noise=0.0, motion_blur_px=0.0, jpeg_quality=100
    )
    rgb, depth = _scene(index)
    expected = apply_appearance(rgb, depth, quiet, np.random.default_rng(0))
    result = Sensor(quiet).apply(rgb, depth, 0.0, 0.0)
    assert np.abs(result.astype(int) - expected).max() <= 2
    assert np.abs(result.astype(int) - expected).mean() < 0.1


def test_the_noise_has_the_general_ones_strength_and_differs_between_frames() -> None:
    noisy = Appearance(shot_noise=0.04, read_noise=0.02)
    sensor = Sensor(noisy, seed=3)
    depth = np.full((120, 160), 100, np.float32)
    for level in (20, 128, 220):
        rgb = np.full((120, 160, 3), level, np.uint8)
        expected = apply_appearance(rgb, depth, noisy, np.random.default_rng(0)).std()
        first, second = (sensor.apply(rgb, depth, 0.0, 0.0) for _ in range(2))
        assert first.std() == pytest.approx(expected, rel=0.05)
        correlation = np.corrcoef(first.ravel(), second.ravel())[0, 1]
        assert abs(correlation) < 0.05


@pytest.mark.parametrize("condition", ["rain", "snow"])
def test_weather_that_is_drawn_goes_through_the_general_function(condition: str) -> None:
    drawn = sample_appearance(np.random.default_rng(2), condition)
    quiet = replace(drawn, shot_noise=0.0, read_noise=0.0, jpeg_quality=100)
    rgb, depth = _scene()
    result = Sensor(quiet, seed=5).apply(rgb, depth, 0.0, 0.0)
    without = replace(quiet, rain_streaks=0, snow_flakes=0, snow_cover=0.0)
    bare = Sensor(without, seed=5).apply(rgb, depth, 0.0, 0.0)
    assert np.abs(result.astype(int) - bare).max() > 10  # dim rain is 20, snow 60
