"""The operator's hint: where the search looks, and what is refused."""

import numpy as np
import pytest

from companion.flight.search import PlaceSearch, place_on_map
from localizer.config import LocalizerConfig
from localizer.map.cache.cache import TileCache
from mavlink_bridge.messages import PlaceHint


@pytest.fixture
def cache(small_assets):
    return TileCache.open(small_assets.map_cache)


def _beside(cache, east):
    """Latitude and longitude `east` metres beside the map's middle."""
    low, high = cache.index.box_min[0], cache.index.box_max[0]
    middle = (low[:2] + high[:2]) / 2
    return cache.frame.geodetic_from_enu(np.array([middle[0] + east, middle[1], 0.0]))[:2]


def test_a_hint_on_the_map_or_that_reaches_it_is_taken(cache):
    half = float((cache.index.box_max[0] - cache.index.box_min[0])[0]) / 2
    at = place_on_map(cache, *_beside(cache, 20.0), 10.0)
    middle = (cache.index.box_min[0] + cache.index.box_max[0]) / 2
    assert at == pytest.approx((middle[0] + 20.0, middle[1]), abs=0.1)
    assert place_on_map(cache, *_beside(cache, half + 50.0), 100.0) is not None
    told = []
    search = PlaceSearch(cache, LocalizerConfig(), None, lambda *event: told.append(event))
    assert search.hint_at(PlaceHint(*_beside(cache, 20.0), 40.0))
    assert [level for level, _ in told] == ["info"]


def test_another_country_and_the_far_side_of_the_earth_are_refused(cache):
    latitude, longitude = cache.manifest.origin.latitude_deg, cache.manifest.origin.longitude_deg
    far = ((float("nan"), 8.0), _beside(cache, 50_000.0), (-latitude, longitude - 180.0))
    told = []
    search = PlaceSearch(cache, LocalizerConfig(), None, lambda *event: told.append(event))
    for place in far:
        assert place_on_map(cache, *place, 300.0) is None
        assert not search.hint_at(PlaceHint(*place, 100.0))
    assert not search.hint_at(PlaceHint(-latitude, longitude - 180.0, 20_000.0))
    assert told == []
