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
def test_every_condition_is_deterministic_and_visible(condition, view):
    rgb, depth = view

    def draw() -> np.ndarray:
        rng = np.random.default_rng(5)
        return apply_appearance(rgb, depth, sample_appearance(rng, condition), rng)

    image = draw()
    assert image.shape == rgb.shape
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, draw())
    assert np.abs(image.astype(int) - rgb).mean() > 3


def test_an_unknown_condition_is_refused() -> None:
    with pytest.raises(ValueError, match="sandstorm"):
        sample_appearance(np.random.default_rng(0), "sandstorm")
