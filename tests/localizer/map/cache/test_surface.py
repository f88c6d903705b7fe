"""Rays against the finest tiles: exact, whatever is drawn, within the budget, errors named."""

from __future__ import annotations

import numpy as np
import pytest

from localizer.map.cache.pick import MapSurface, cast_bundle, cast_rays
from tests.localizer.map.conftest import leaf_meshes

EYE = np.array([-40.0, 30.0, 150.0])


def _bundle(rng, axis, spread=0.004):
    directions = np.asarray(axis, float) + rng.normal(0, spread, (25, 3))
    return directions / np.linalg.norm(directions, axis=1)[:, None]


@pytest.mark.parametrize("axis", [(0, 0, -1), (0.3, 0.5, -1), (1.0, 0.2, -0.7), (0, -1, -0.2)])
def test_a_bundle_meets_what_single_rays_meet_in_the_finest_tiles(cache, axis):
    directions = _bundle(np.random.default_rng(0), axis)
    expected = cast_rays(leaf_meshes(cache), EYE, directions)
    hits = MapSurface(cache).cast(EYE, directions)
    np.testing.assert_array_equal(np.isnan(hits.distances), np.isnan(expected))
    np.testing.assert_allclose(hits.distances, expected, rtol=1e-9)
    met = np.isfinite(expected)
    assert (np.einsum("ij,ij->i", hits.normals[met], directions[met]) < 0).all()
    np.testing.assert_allclose(np.linalg.norm(hits.normals[met], axis=1), 1.0)


def test_heights_are_those_of_the_source_not_of_a_coarse_level(cache, make):
    rng = np.random.default_rng(1)
    surface, coarse = MapSurface(cache), [cache.load_tile(0)]
    errors = []
    for east, north in rng.uniform(-180, 180, (40, 2)):
        eye, down = np.array([east, north, 150.0]), np.array([[0.0, 0.0, -1.0]])
        true = 150.0 - make.height(east, north)
        errors.append([abs(cast(eye) - true) for cast in (
            lambda e: surface.cast(e, down).distances[0],  # noqa: B023
            lambda e: cast_bundle(coarse, e, down).distances[0],  # noqa: B023
        )])  # fmt: skip
    fine, rough = np.median(errors, axis=0)
    assert fine < 0.5 * rough


def test_a_vertical_ray_on_the_border_of_tiles_meets_one_of_them(cache):
    """Each tile's corners are rounded to its own float32: a ray between two of them met neither."""
    index, down = cache.index, np.array([[0.0, 0.0, -1.0]])
    leaves = np.flatnonzero(index.child_count == 0)
    low, high = index.box_min[leaves].min(axis=0), index.box_max[leaves].max(axis=0)
    inner = [np.unique(index.box_min[leaves][:, a].round(3)) for a in (0, 1)]
    rng, surface, missed = np.random.default_rng(4), MapSurface(cache), []
    tiles = leaf_meshes(cache)
    for axis in (0, 1):
        for border in (b for b in inner[axis] if low[axis] + 1 < b < high[axis] - 1):
            along = rng.uniform(low[1 - axis] + 1, high[1 - axis] - 1, 6)
            for place in ((border, a) if axis == 0 else (a, border) for a in along):
                eye = np.array([*place, 150.0])
                hits = surface.cast(eye, down).distances
                single = cast_rays(tiles, eye, down)
                if not (np.isfinite(hits).all() and np.isfinite(single).all()):
                    missed.append(place)
    assert missed == []


def test_rays_beside_the_map_and_into_the_sky_meet_nothing(cache):
    surface = MapSurface(cache)
    for eye, axis in ((EYE, (0, 0, 1)), (EYE + np.array([5000.0, 0, 0]), (0, 0, -1))):
        hits = surface.cast(eye, _bundle(np.random.default_rng(2), axis))
        assert np.isnan(hits.distances).all()


def test_memory_stays_within_the_budget(cache):
    one = cache.load_geometry(len(cache.tile_ids) - 1).nbytes
    surface = MapSurface(cache, byte_budget=3 * one)
    rng = np.random.default_rng(3)
    for east, north in rng.uniform(-180, 180, (30, 2)):
        eye = np.array([east, north, 150.0])
        assert np.isfinite(surface.cast(eye, _bundle(rng, (0, 0, -1))).distances).all()
        assert 0 < surface.resident_bytes <= 3 * one + one
