"""Height fields to meshes: what simplification may take away, and what not."""

import numpy as np
import pytest

from localizer.map.importers.heightmesh import height_mesh

_CELLS, _STEP = 32, 0.5


def _made(seed: int, unknown: tuple[int, int] | None = None) -> tuple[np.ndarray, np.ndarray]:
    rough = np.random.default_rng(seed).normal(size=(_CELLS + 1, _CELLS + 1))
    mask = np.zeros(rough.shape, bool)
    if unknown is not None:
        mask[unknown] = True
    heights = np.ma.masked_array(0.02 * rough.cumsum(0).cumsum(1), mask)
    made = height_mesh(heights, np.ones((64, 64), bool), (_STEP, _STEP), lossless=False)
    assert made is not None
    return made


def _area(points: np.ndarray, faces: np.ndarray) -> float:
    (x1, y1), (x2, y2) = ((points[faces[:, k], :2] - points[faces[:, 0], :2]).T for k in (1, 2))
    return float((x1 * y2 - x2 * y1).sum() / 2)


@pytest.mark.parametrize("seed", range(8))
def test_a_tile_keeps_its_corners(seed):
    # Else the ground had a hole of about a metre wherever four such tiles meet.
    points, faces = _made(seed)
    side = _CELLS * _STEP
    for corner in ((0, 0), (side, 0), (0, -side), (side, -side)):
        assert np.abs(points[:, :2] - corner).max(axis=1).min() < 1e-6
    assert _area(points, faces) == pytest.approx(side * side, rel=1e-6)


def test_a_corner_that_nobody_knows_is_not_made_up():
    points, _ = _made(0, unknown=(0, 0))
    assert np.abs(points[:, :2]).max(axis=1).min() > 0.1 * _STEP
