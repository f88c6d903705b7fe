from dataclasses import replace

import numpy as np
import pytest

from localizer.synth.appearance.model import (
    CONDITIONS,
    Appearance,
    apply_appearance,
    sample_appearance,
)


@pytest.fixture
def view() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    rgb = rng.integers(40, 200, (96, 128, 3), dtype=np.uint8)
    depth = np.tile(np.linspace(400, 60, 96, dtype=np.float32)[:, None], (1, 128))
    depth[:8] = 0.0
    return rgb, depth


def test_the_default_appearance_changes_nothing(view: tuple[np.ndarray, np.ndarray]) -> None:
    rgb, depth = view
    np.testing.assert_array_equal(
        apply_appearance(rgb, depth, Appearance(), np.random.default_rng(0)), rgb
    )


@pytest.mark.parametrize("condition", CONDITIONS)
def test_every_condition_is_deterministic_and_visible(
    condition: str, view: tuple[np.ndarray, np.ndarray]
) -> None:
    rgb, depth = view

    def draw() -> np.ndarray:
        rng = np.random.default_rng(5)
        return apply_appearance(rgb, depth, sample_appearance(rng, condition), rng)

    image = draw()
    assert image.shape == rgb.shape
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, draw())
    assert np.abs(image.astype(int) - rgb).mean() > 3


def test_haze_hides_what_is_far(view: tuple[np.ndarray, np.ndarray]) -> None:
    rgb, depth = view
    haze = replace(Appearance(), extinction_per_m=0.01, haze_color=(0.8, 0.8, 0.8))
    image = apply_appearance(rgb, depth, haze, np.random.default_rng(0)).astype(float)
    # Contrast falls by exp(-extinction * distance): at 60 m to 0.55, at 400 m to 0.02.
    near = image[-4:].std() / rgb[-4:].std()
    assert near == pytest.approx(np.exp(-0.01 * 65), abs=0.05)
    assert image[8:14].std() / rgb[8:14].std() < 0.05
    np.testing.assert_allclose(image[:8], 204, atol=1)


def test_night_is_darker_than_day(view: tuple[np.ndarray, np.ndarray]) -> None:
    rgb, depth = view

    def brightness(condition: str) -> float:
        values = []
        for seed in range(12):
            rng = np.random.default_rng(seed)
            look = sample_appearance(rng, condition)
            values.append(apply_appearance(rgb, depth, look, rng).mean())
        return float(np.mean(values))

    assert brightness("night") < 0.5 * brightness("day")


def test_an_unknown_condition_is_refused() -> None:
    with pytest.raises(ValueError, match="sandstorm"):
        sample_appearance(np.random.default_rng(0), "sandstorm")
