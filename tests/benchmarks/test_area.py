"""The region that hides a place: where the place is, and what the table counts."""

import numpy as np

from benchmarks.relocalization.area import AreaSearch, cells, hidden, repeated
from localizer.relocalization.overview import OverviewLevel, Projection


def level(seed, side, height_m, west, basis):
    rng = np.random.default_rng(seed)
    features = rng.integers(-90, 90, (2, side, side)).astype(np.int8)
    ground = np.full((side // 16, side // 16), height_m, np.float32)
    projection = Projection(np.zeros(2, np.float32), np.asarray(basis, np.float32))
    return OverviewLevel(features, ground, projection, west, -west, 0.5)


def test_the_place_lies_in_the_region_where_it_was_and_in_the_regions_components():
    hay = repeated(level(0, 384, 30.0, 900.0, np.eye(2)), 2000.0)
    place = level(1, 64, 5.0, -40.0, np.eye(2)[::-1])
    place.ground[:, 2:] = np.nan  # beyond the map
    region = hidden(place, hay, 256.0)
    assert region.shape == hay.shape == (992, 992)
    assert (region.west + 128 * 2.0, region.north - 128 * 2.0) == (place.west, place.north)
    seen = np.s_[:, 128:192, 128:160]
    np.testing.assert_array_equal(region.features[seen], place.features[::-1, :, :32])
    around = np.ones(hay.shape, bool)
    around[seen[1:]] = False
    was = hay.features[:, :, :]
    np.testing.assert_array_equal(region.features[:, :, :][:, around], was[:, around])
    assert (region.ground == 5.0).all()  # as high as the place


def test_repeated_ground_goes_on_as_in_a_mirror():
    one = level(0, 384, 30.0, 0.0, np.eye(2))
    many = repeated(one, 1536.0)
    np.testing.assert_array_equal(many.features[:, :, 384:], many.features[:, :, 383::-1])


def test_the_table_counts_the_places_that_were_first_and_among_the_candidates():
    found = [AreaSearch("quito", 99.7, False, k, 20.0, 500.0, 900.0 + k) for k in (0, 5, -1)]
    (line,) = cells([*found, AreaSearch("quito", 99.7, False, 0, 30.0, 500.0, 700.0)])
    assert line == ("100", "unknown", "quito", "4", "2", "3", "20.00", "0.20", "5.0", "905")
