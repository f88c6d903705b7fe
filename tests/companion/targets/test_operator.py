"""What an operator gets for his clicks: one target, one number, one life, under his own pixel."""

from typing import Any

import numpy as np
import pytest

from companion.config import TargetConfig
from companion.targets.clicks import ClickPolicy
from companion.targets.detections import Detection, clicked_name
from companion.targets.target_manager import TargetManager
from localizer.targets.track import pixel_of
from localizer.types import TrackingState, Visibility
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import ClickRefusal
from mavlink_bridge.messages import TrackRequest
from tests.companion.targets.scene import CAMERA, MS, cast, estimate, pose_at

FRAME_MS = 100


class Operator:
    """Clicks into the picture of `delay_ms` ago; everything runs in the caller's thread."""

    def __init__(self, delay_ms=250.0, sigma_ms=0.0, flown=pose_at, **settings):
        self.config = TargetConfig(
            operator_delay_ms=delay_ms, operator_delay_sigma_ms=sigma_ms, **settings
        )
        self.told: list[Any] = []
        self.gone: list[Any] = []
        self.alerts: list[Any] = []
        self.population = TargetManager(
            self.config, cast, self.told.append, self._end, self.alerts.append
        )
        self.begin = self.population.begin
        self.clicks = ClickPolicy(self, self.alerts.append, self.config)
        self.flown = flown
        self.time_ms = self.count = 0

    def forget(self, names):
        self.population.end(names)

    def _end(self, name):
        self.gone.append(name)

    def fly(self, frames=1, state=TrackingState.TRACKING):
        for _ in range(frames):
            seen = estimate(self.flown(self.time_ms / 1e3), self.time_ms * MS, state)
            self.clicks.add_estimate(seen)
            if state is TrackingState.TRACKING:
                self.population.predict(seen)
            self.time_ms += FRAME_MS
        self.now_ms = self.time_ms - FRAME_MS

    def clicks_at(self, *coordinates, after_ms=40):
        """A point or rectangle, `after_ms` behind the newest frame; its number."""
        self.count += 1
        kind = "point" if len(coordinates) == 2 else "rectangle"
        time_ns = (self.now_ms + after_ms) * MS
        self.clicks.on_request(TrackRequest(kind, time_ns, coordinates, number=self.count))
        return self.count, time_ns

    def stops(self, number=0):
        self.clicks.on_request(TrackRequest("stop", self.now_ms * MS, number=number))

    def of(self, number):
        return [t for t in self.told if t.fix.target_id == clicked_name(number)]


@pytest.mark.parametrize("flight", range(3))
def test_forty_clicks_and_rectangles_with_stops_between_are_each_told_under_their_own_pixel(flight):
    rng = np.random.default_rng(flight)
    turn = (0.0, 0.2, -0.1)[flight]
    operator = Operator(flown=lambda t: pose_at(t, speed=(10.0, 6.0, 14.0)[flight], turn=turn))
    operator.fly(10)
    wanted, alive = {}, []
    for _ in range(40):
        operator.fly(int(rng.integers(1, 4)))
        middle, half = rng.uniform(0.15, 0.85, 2), rng.uniform(0.01, 0.05, 2)
        shape = (*(middle - half), *(middle + half)) if rng.random() < 0.5 else tuple(middle)
        number, time_ns = operator.clicks_at(*shape, after_ms=int(rng.integers(0, 90)))
        wanted[number] = (middle * (CAMERA.width, CAMERA.height), time_ns - 250 * MS)
        alive.append(number)
        if rng.random() < 0.3:
            stopped = int(rng.choice(alive)) if rng.random() < 0.5 else 0
            operator.fly(2)  # a click that still waits for its frame would be ended unseen
            operator.stops(stopped)
            alive = [n for n in alive if stopped not in (0, n)]
            told = len(operator.told)
            operator.fly(3)
            ended = {clicked_name(n) for n in wanted} - {clicked_name(n) for n in alive}
            assert not ended & {t.fix.target_id for t in operator.told[told:]}
    operator.fly(5)
    assert operator.count == 40
    for number, (pixel, seen_ns) in wanted.items():
        told = operator.of(number)
        assert told, number
        first = told[0]
        # In the frame that the operator saw, not in the one that was newest when he clicked.
        assert abs(first.estimate.exposure_time_ns - seen_ns) <= 20 * MS
        exact = estimate(operator.flown(seen_ns * 1e-9), seen_ns)
        back = np.array(pixel_of(exact, first.fix.position_world))
        assert (
            np.linalg.norm(back - pixel)
            < 12.0 * abs(first.estimate.exposure_time_ns - seen_ns) / (20 * MS) + 1.0
        )
        np.testing.assert_allclose(
            pixel_of(first.estimate, first.fix.position_world), pixel, atol=0.5
        )
        for target in told:  # a life of one place, and no velocity where none was measured
            assert target.fix.velocity is None
            assert np.linalg.norm(target.fix.position_world - first.fix.position_world) < 0.05


def test_the_delay_s_error_is_in_the_covariance_along_the_picture_s_motion():
    def sigma(sigma_ms):
        operator = Operator(sigma_ms=sigma_ms)
        operator.fly(30)
        operator.clicks_at(0.5, 0.8)
        operator.fly(1)
        return np.sqrt(operator.told[0].fix.covariance.diagonal())

    sure, vague = sigma(0.0), sigma(100.0)
    assert vague[0] > sure[0] + 0.5  # 1 m of flight to the east, and some sway
    assert vague[2] < sure[2] + 0.1


def test_a_click_waits_for_its_frame_and_is_refused_when_none_comes():
    operator = Operator(delay_ms=0.0)
    operator.fly(10)
    operator.clicks_at(0.5, 0.5, after_ms=90)
    assert not operator.told
    operator.fly(1)
    assert len(operator.told) == 1
    operator.clicks_at(0.5, 0.5, after_ms=90)
    for _ in range(25):  # frames of which none is accepted
        lost = estimate(pose_at(0.0), operator.time_ms * MS, TrackingState.LOST, accepted=False)
        operator.clicks.add_estimate(lost)
        operator.time_ms += FRAME_MS
    assert operator.alerts[-1] == alert(AlertId.NO_TARGET, why=ClickRefusal.UNKNOWN)


def test_an_impatient_operator_is_told_once_and_a_place_seen_too_long_ago_is_none():
    operator = Operator()
    operator.fly(5)
    operator.now_ms += 3000  # nothing came since
    for _ in range(5):
        operator.clicks_at(0.5, 0.5)
    assert operator.alerts == [alert(AlertId.NO_TARGET, why=ClickRefusal.UNKNOWN)]
    assert not operator.told


@pytest.mark.parametrize("state", [TrackingState.INITIALIZING, TrackingState.LOST])
def test_no_click_is_placed_by_a_pose_that_nothing_confirms(state):
    """Nor by one between a confirmed frame and an unconfirmed one."""
    operator = Operator()
    operator.fly(10)
    operator.fly(1, state)
    operator.clicks_at(0.5, 0.5, after_ms=220)
    assert operator.alerts == [alert(AlertId.NO_TARGET, why=ClickRefusal.UNCONFIRMED)]
    operator.fly(10)
    operator.clicks_at(0.5, 0.5)
    assert len(operator.told) == 1


def test_a_ninth_target_ends_the_first_with_a_word():
    operator = Operator()
    operator.fly(10)
    for k in range(9):
        operator.clicks_at(0.1 + 0.08 * k, 0.5)
        operator.fly(2)
    assert operator.gone == [clicked_name(1)]
    assert alert(AlertId.TARGET_REPLACED, number=1) in operator.alerts
    told = len(operator.told)
    operator.fly(3)
    assert len({t.fix.target_id for t in operator.told[told:]}) == 8
    operator.stops()
    assert len(operator.gone) == 9


def test_a_click_without_map_is_refused_with_a_word_and_leaves_room():
    up = estimate(pose_at(0.0), 0).world_from_camera
    level = type(up)(up.rotation @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0.0]]), up.translation)
    operator = Operator(flown=lambda _: level)
    operator.fly(10)
    number, _ = operator.clicks_at(0.5, 0.95)  # the sky: it hangs upside down
    assert operator.alerts == [alert(AlertId.TARGET_REFUSED, number=number, why="no map under it")]
    assert operator.gone == [clicked_name(number)]
    assert not operator.told


def test_a_target_is_held_by_geometry_hidden_by_a_roof_and_ends_when_it_is_long_out_of_sight():
    operator = Operator(delay_ms=0.0, timeout_s=2.0, flown=lambda t: pose_at(t, speed=10.0))
    place = np.array([-12.0, 0.0, 0.0])  # on the ground, beside the roof (-10 to 10 m)
    operator.fly(10)
    pixel = pixel_of(estimate(pose_at(0.9), 0), place)
    assert pixel is not None
    operator.clicks_at(pixel[0] / 640, pixel[1] / 480, after_ms=0)
    operator.fly(200)
    seen = [t.fix.visibility for t in operator.told]
    assert seen[0] is Visibility.SEEN
    assert Visibility.HELD in seen
    assert Visibility.HIDDEN in seen  # from the other side the roof is before it
    assert seen[-1] is Visibility.OUTSIDE
    assert operator.told[-1].fix.pixel is None
    for target in operator.told:
        np.testing.assert_allclose(target.fix.position_world, place, atol=0.3)
    assert operator.gone == [clicked_name(1)]
    assert operator.alerts[-1] == alert(AlertId.TARGET_OUT_OF_VIEW, number=1)


def test_stop_ends_clicked_targets_and_no_detected_one():
    operator = Operator()
    operator.fly(10)
    operator.clicks_at(0.25, 0.5)
    operator.population.add_detection(
        Detection("car", 0, 320.0, 240.0), estimate(pose_at(0.9), operator.now_ms * MS)
    )
    operator.stops()
    assert operator.gone == [clicked_name(1)]
    told = len(operator.told)
    operator.fly(3)
    assert len(operator.told) == told
