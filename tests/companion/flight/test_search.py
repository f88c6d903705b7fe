"""The operator's hint: where the search looks, and what is refused."""

import numpy as np
import pytest

from companion.flight.search import PlaceSearch, place_on_map
from localizer.config import LocalizerConfig
from localizer.map.cache.cache import TileCache
from localizer.relocalization.types import SearchRegion
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


class Lost:
    """An autopilot that knows no position."""

    def prior(self, _time_ns):
        return None


def test_the_whole_map_is_searched_now_and_then_whatever_was_seen(cache):
    about = SearchRegion.circle(np.array([10.0, 20.0]), 40.0)
    search = PlaceSearch(cache, LocalizerConfig(), Lost(), lambda *_: None, lambda _t: about)
    assert [search.region(k) for k in range(10)] == 2 * ([about] * 4 + [None])


def test_the_operators_word_comes_before_what_was_seen(cache):
    about = SearchRegion.circle(np.array([10.0, 20.0]), 40.0)
    search = PlaceSearch(cache, LocalizerConfig(), Lost(), lambda *_: None, lambda _t: about)
    search.hint(300.0, 400.0, 50.0)
    assert search.region(0).centre == pytest.approx([300.0, 400.0])
