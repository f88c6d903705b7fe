"""Where the search looks, by the operator's hint and by what it found; what is refused."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from companion.flight.reachable_region import ReachableRegion
from companion.flight.search import PlaceSearch, enu_on_map
from companion.inertial import InertialTrack
from localizer.config import LocalizerConfig
from localizer.errors import MapCacheError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose, so3_exp
from localizer.map.cache.cache import TileCache
from localizer.relocalization.types import Relocalization, SearchRegion
from localizer.types import Frame, TrackingState
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.messages import Attitude, InertialSample, PlaceHint, VehicleState


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
    at = enu_on_map(cache, *_beside(cache, 20.0), 10.0)
    middle = (cache.index.box_min[0] + cache.index.box_max[0]) / 2
    assert at == pytest.approx((middle[0] + 20.0, middle[1]), abs=0.1)
    assert enu_on_map(cache, *_beside(cache, half + 50.0), 100.0) is not None
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
        assert enu_on_map(cache, *place, 300.0) is None
        assert not search.hint_at(PlaceHint(*place, 100.0))
    assert not search.hint_at(PlaceHint(-latitude, longitude - 180.0, 20_000.0))
    assert told == []


class Lost:
    """An autopilot that knows no position."""

    def prior(self, _time_ns):
        return None


def test_the_whole_map_is_searched_now_and_then_and_where_the_operator_says(cache):
    about = SearchRegion.circle(np.array([10.0, 20.0]), 40.0)
    search = PlaceSearch(cache, LocalizerConfig(), Lost(), lambda *_: None, lambda _t: about)
    assert [search.region(k) for k in range(10)] == 2 * ([about] * 4 + [None])
    search.hint(300.0, 400.0, 50.0)
    assert search.region(0).centre == pytest.approx([300.0, 400.0])


class Falling:
    """An autopilot without a position, whose vehicle drifts east at 3 m/s and comes down at 2."""

    knows_heading = True

    def __init__(self, velocity=None):
        self.time_s, self.velocity = 0.0, velocity
        self.attitude: np.ndarray | None = np.eye(3)

    @property
    def height_m(self):
        return self.place[2] + 5.0  # the barometer's constant error

    @property
    def place(self):
        return np.array([3.0 * self.time_s, 10.0, 70.0 - 2.0 * self.time_s])

    def prior(self, _time_ns):
        return None

    def rotation(self, _time_ns):
        return self.attitude

    def frame(self):
        return Frame(
            image=np.zeros((8, 8, 3), np.uint8),
            camera=Camera(8, 8, 8.0, 8.0, 4.0, 4.0),
            exposure_time_ns=round(self.time_s * 1e9),
            sequence=round(self.time_s * 10),
        )


class Slow:
    """A relocalizer that is right; `wide_s` for the map and 0.3 s for a small part of it."""

    def __init__(self, autopilot):
        self.autopilot, self.queries, self.blind, self.wide_s = autopilot, [], False, 4.0

    @property
    def relocalizer(self):
        return self

    def close(self):
        pass

    def find(self, query, _should_stop):
        place = self.autopilot.place
        self.queries.append(query)
        wide = query.region is None or query.region.shape[0, 0] > 90.0**2
        self.autopilot.time_s += self.wide_s if wide else 0.3
        if self.blind or not (query.region is None or query.region.contains(place[:2])):
            return None
        pose = Pose(np.eye(3), place)
        return Relocalization(
            pose, np.eye(6) * 0.01, query.frame.exposure_time_ns, 0.8, 1.0, 0.8, 0.1, 0, 0.0, {}
        )


@pytest.fixture
def slowly(cache, monkeypatch):
    """Makes a search with a slow relocalizer, all on the autopilot's clock."""

    def make(reach=None, velocity=None):
        autopilot = Falling(velocity)
        slow = Slow(autopilot)
        monkeypatch.setattr("companion.flight.search.open_relocalizer", lambda *_, **__: slow)
        about = SearchRegion.circle(np.zeros(2), 100.0)
        search = PlaceSearch(
            cache, LocalizerConfig(), autopilot, lambda *_: None, reach or (lambda _t: about),
            clock=lambda: autopilot.time_s,
        )  # fmt: skip
        search.start()
        search.stop()
        return search, slow, autopilot

    return make


def test_a_place_of_seconds_ago_is_looked_for_again_where_it_can_be_by_now(slowly):
    search, slow, falling = slowly()
    assert search.search(falling.frame(), lambda: False) is None  # 12 m from where we are by now
    prior = search.search(falling.frame(), lambda: False)
    assert np.linalg.norm(prior.world_from_camera.translation - falling.place) < 2.0
    assert prior.velocity == pytest.approx([3.0, 0.0, -2.0], abs=0.01)
    assert slow.queries[1].height_m == pytest.approx(62.0)  # without the barometer's error
    assert slow.queries[1].heading_sigma_rad < slow.queries[0].heading_sigma_rad


def test_the_frames_of_the_last_seconds_are_searched_with_every_second_time(slowly):
    search, slow, falling = slowly()
    slow.blind, slow.wide_s = True, 0.0
    for _ in range(75):  # five a second
        falling.time_s += 0.2
        search.keep(falling.frame())
    falling.time_s += 0.1
    for _ in range(3):
        search.search(falling.frame(), lambda: False)
    first, second, third = (q.earlier for q in slow.queries)
    assert (len(second), len(third)) == (0, 10)
    ago_s = [(slow.queries[0].frame.exposure_time_ns - e.frame.exposure_time_ns) * 1e-9
             for e in first]  # fmt: skip
    np.testing.assert_allclose(np.diff(ago_s), 1.0, atol=1e-6)
    assert 0.0 < ago_s[0] <= 1.1
    np.testing.assert_allclose([e.higher_m for e in first], 2.0 * np.array(ago_s))
    falling.time_s += 60.0
    search.search(falling.frame(), lambda: False)
    search.search(falling.frame(), lambda: False)
    assert slow.queries[-1].earlier == ()  # too old, all of them


def test_a_kept_frame_is_small_and_its_camera_sees_as_far(slowly):
    search, slow, _ = slowly()
    slow.blind, large = True, Camera.from_fov(1920, 1080, 70.0)
    first, later = (
        Frame(np.zeros((1080, 1920, 3), np.uint8), k * 1_000_000_000, large, k) for k in (1, 2)
    )
    search.keep(first)
    search.search(later, lambda: False)
    (kept,) = slow.queries[-1].earlier
    assert kept.frame.image.shape == (270, 480, 3)
    assert kept.frame.camera.horizontal_fov_deg == pytest.approx(70.0)


def test_frames_are_kept_again_after_the_cameras_clock_jumped_back(slowly):
    search, slow, falling = slowly()
    slow.blind = True
    for time_s in (60.0, 61.0, 10.0, 11.0):
        falling.time_s = time_s
        search.keep(falling.frame())
    falling.time_s = 12.0
    search.search(falling.frame(), lambda: False)
    assert [e.frame.exposure_time_ns for e in slow.queries[-1].earlier] == [11 * S, 10 * S]


def test_a_place_that_three_frames_do_not_show_again_is_forgotten(slowly):
    search, slow, falling = slowly()
    search.search(falling.frame(), lambda: False)
    slow.blind = True
    for _ in range(3):
        assert search.search(falling.frame(), lambda: False) is None
    slow.blind = False
    assert search.search(falling.frame(), lambda: False) is None  # the wide search anew
    near = [float(np.sqrt(q.region.shape[0, 0])) for q in slow.queries[1:-1]]
    assert near == pytest.approx([70.0, 74.5, 79.0])
    assert slow.queries[-1].region is None  # the fifth search


def test_a_place_that_is_found_at_once_is_given_at_once(slowly, cache):
    search, slow, falling = slowly()
    search.hint(0.0, 10.0, 30.0)
    assert search.search(falling.frame(), lambda: False) is not None
    assert len(slow.queries) == 1


def test_a_search_that_is_not_ready_or_cannot_be_says_so(cache, monkeypatch):
    def fail(*_, **__):
        raise MapCacheError("too large a map")

    monkeypatch.setattr("companion.flight.search.open_relocalizer", fail)
    events = []
    search = PlaceSearch(cache, LocalizerConfig(), Lost(), lambda *e: events.append(e))
    assert search.lacks.value == AlertId.SEARCH_NOT_READY.value
    search.start()
    search.stop()
    assert search.lacks.value == AlertId.NO_SEARCH.value
    assert events == [("warning", "no search for a lost place: too large a map")]


def test_without_the_autopilots_attitude_it_says_what_it_waits_for(slowly):
    search, slow, falling = slowly()
    assert search.lacks is None
    falling.attitude = None
    search.search(falling.frame(), lambda: False)
    assert search.lacks is AlertId.WAITING_FOR_PRIOR
    falling.attitude = np.eye(3)
    search.search(falling.frame(), lambda: False)
    assert len(slow.queries) == 1
    assert search.lacks is None


def test_far_from_the_origin_the_height_is_counted_from_the_maps_plane(slowly, cache):
    """At 30 km that lies 70 m above the ellipsoid: no height that was tried was the right one."""
    search, slow, falling = slowly()
    search.hint(0.0, 30_000.0, 30.0)
    search.search(falling.frame(), lambda: False)
    place = cache.frame.position(np.array([0.0, 30_000.0, slow.queries[0].height_m]))
    assert place.height_m - cache.frame.origin.height_m == pytest.approx(75.0, abs=0.5)


def test_the_place_that_a_search_of_a_large_map_finds_is_followed_to_now(slowly):
    """A search of 45 s found where the camera had been, and the next one began anew for ever."""
    search, slow, falling = slowly()
    slow.wide_s = 45.0
    assert search.search(falling.frame(), lambda: False) is None
    slow.wide_s = 1.0
    assert search.search(falling.frame(), lambda: False) is None  # 3 m from where we are by now
    prior = search.search(falling.frame(), lambda: False)
    assert np.linalg.norm(prior.world_from_camera.translation - falling.place) < 2.0
    assert prior.velocity == pytest.approx([3.0, 0.0, -2.0], abs=0.01)
    followed, again = slow.queries[1:]
    assert float(np.sqrt(followed.region.shape[0, 0])) == pytest.approx(685.0)
    assert followed.heading_sigma_rad > again.heading_sigma_rad


def test_the_attitude_of_the_next_search_is_right_whatever_the_unknown_heading(slowly):
    (search, slow, falling), unknown = slowly(), np.eye(3)[[1, 0, 2]] * [[-1.0], [1.0], [1.0]]
    falling.attitude = unknown  # by 90 degrees
    assert search.search(falling.frame(), lambda: False) is None
    rolled = so3_exp(np.array([0.3, 0.1, 0.2]))  # in the map's axes
    falling.attitude = unknown @ rolled
    search.search(falling.frame(), lambda: False)
    assert slow.queries[1].rotation == pytest.approx(rolled)


@pytest.mark.parametrize(
    ("gone_s", "hint", "centre"), [(120.0, (), 0.0), (0.0, (500.0, 0.0), 500.0)]
)
def test_a_place_of_long_ago_or_before_an_operators_word_says_nothing(slowly, gone_s, hint, centre):
    search, slow, falling = slowly()
    assert search.search(falling.frame(), lambda: False) is None
    falling.time_s += gone_s
    if hint:
        search.hint(*hint, 30.0)
    search.search(falling.frame(), lambda: False)
    assert slow.queries[1].region.centre == pytest.approx([centre, 0.0])


def test_after_a_long_search_it_is_looked_for_where_it_circled_and_straight_on(slowly):
    search, slow, falling = slowly(velocity=np.array([20.0, 0.0, -2.0]))
    slow.wide_s = 45.0
    assert search.search(falling.frame(), lambda: False) is None
    search.search(falling.frame(), lambda: False)
    for place in ([0.0, 10.0], [900.0, 10.0]):
        assert slow.queries[1].region.contains(np.array(place))


@pytest.mark.parametrize(
    ("jump_m", "centre", "radius_m"),
    [(0.0, 12.0, 14.0), (60.0, 0.0, 70.0), (None, 12.0, 18.0)],
    ids=["whole record of the IMU", "broken one", "velocity of the EKF"],
)
def test_the_next_search_is_as_near_as_the_motion_is_known(slowly, jump_m, centre, radius_m):
    def reach(time_ns):
        t = time_ns * 1e-9
        return SearchRegion.circle(np.array([3.0 * t + jump_m * (t > 1.0), 0.0]), 100.0 + t)

    search, slow, falling = slowly(
        *((None, np.array([3.0, 0.0, -2.0])) if jump_m is None else (reach,))
    )
    assert search.search(falling.frame(), lambda: False) is None
    search.search(falling.frame(), lambda: False)
    region = slow.queries[1].region
    assert region.centre[0] == pytest.approx(centre)
    assert float(np.sqrt(region.shape[0, 0])) == pytest.approx(radius_m)


# --- Where the camera can be since it was last seen, by a simulated IMU -------------------------


S = 1_000_000_000
LEVEL = (1.0, 0.0, 0.0, 0.0)


class Flying:
    """Level, flying north at 6 m/s, and braking from `brakes_s` on; the IMU is read at 50 Hz."""

    def __init__(self, brakes_s=1e9, hole=(1e9, 1e9)):
        self.now_s = 0.0
        self._brakes_s, self._hole = brakes_s, hole
        self._samples = []

    def state(self):
        return replace(VehicleState(), local_velocity_ned=(6.0, 0.0, 0.0))

    def attitude_at(self, time_ns):
        return Attitude(time_ns, 0.0, 0.0, 0.0, LEVEL)

    def inertial_since(self, time_ns):
        return tuple(s for s in self._samples if s.time_ns > time_ns)

    def until(self, end_s, reach=None):
        while self.now_s < end_s:
            self.now_s += 0.02
            braking = self._brakes_s <= self.now_s < self._brakes_s + 3.0
            if not self._hole[0] <= self.now_s < self._hole[1]:
                force = (-2.0 if braking else 0.0, 0.0, -9.80665)
                t = round(self.now_s * S)
                self._samples.append(InertialSample(t, force, (0.0, 0.0, 0.0)))
            if reach is not None and round(self.now_s * 50) % 5 == 0:
                reach.follow()
                self._samples = self._samples[-100:]


def _estimate(time_ns, east, north, state=TrackingState.TRACKING):
    pose = Pose(np.eye(3), np.array([east, north, 60.0]))
    return SimpleNamespace(
        accepted=True, state=state, exposure_time_ns=time_ns, world_from_camera=pose
    )


def _seen_at_two(vehicle):
    reach = ReachableRegion(vehicle, InertialTrack())
    vehicle.until(2.0, reach)
    reach.add_estimate(_estimate(round(1.8 * S), 100.0, -50.0), None)
    return reach


def test_nothing_is_known_before_a_place_was_seen():
    reach = ReachableRegion(Flying(), InertialTrack())
    assert reach.region(5 * S) is None
    reach.add_estimate(_estimate(S, 0.0, 0.0, TrackingState.BRIDGING), None)
    assert reach.region(5 * S) is None


def test_the_imu_carries_the_place_through_a_brake():
    vehicle = Flying(brakes_s=4.0)
    reach = _seen_at_two(vehicle)
    vehicle.until(14.0, reach)
    region = reach.region(14 * S)
    # 2.2 s at 6 m/s, 3 s of braking to a stand.
    assert region.centre == pytest.approx([100.0, -50.0 + 13.2 + 9.0], abs=1.5)
    radius = float(np.sqrt(region.shape[0, 0]))
    assert 15.0 < radius < 60.0


def test_a_hole_in_the_imus_record_leaves_what_can_be_flown():
    vehicle = Flying(hole=(6.0, 8.0))
    reach = _seen_at_two(vehicle)
    vehicle.until(14.0, reach)
    region = reach.region(14 * S)
    assert region.centre == pytest.approx([100.0, -50.0])
    assert region.contains(np.array([100.0, -50.0 + 6.0 * 12.2]))


def test_it_grows_until_it_holds_the_map():
    vehicle = Flying()
    reach = _seen_at_two(vehicle)
    vehicle.until(60.0, reach)
    radii = [float(np.sqrt(reach.region(t * S).shape[0, 0])) for t in (61, 120, 600)]
    assert radii == sorted(radii)
    assert radii[-1] > 1000.0
