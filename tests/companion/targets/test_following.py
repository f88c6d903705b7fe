"""A clicked target followed in made pictures: a car behind a roof, a place that stands."""

import cv2
import numpy as np
import pytest

from companion.targets import target_manager
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose, so3_exp
from localizer.targets.follow import FollowedPosition
from localizer.targets.limits import RefusalReason, TargetRefusal
from localizer.targets.track import TargetTrack, pixel_of
from localizer.types import Visibility
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from tests.companion.targets import scene
from tests.companion.targets.scene import MS
from tests.companion.targets.test_operator import Operator

CELL = 0.25  # metres of the ground's texture
SIZE = 1200
CAMERA = Camera(240, 180, 200.0, 200.0, 120.0, 90.0)
ROOF = (10.0, 8.0)  # half side and height, about the origin
AWAY = ((500.0, 500.0), 0.0)


def texture(seed, size):
    rng = np.random.default_rng(seed)
    fine = cv2.GaussianBlur(rng.uniform(0, 255, (size, size)).astype(np.float32), (0, 0), 1.2)
    return cv2.normalize(fine, None, 40, 215, cv2.NORM_MINMAX)


NOISE = np.random.default_rng(4).normal(0, 3, (180, 240))
GROUND, CAR, TILES = texture(1, SIZE), texture(2, 24), texture(3, 80)


class Pictures:
    """Renders ground, a car and a roof for the scene's camera, by one ray a pixel."""

    def __init__(self, car_at):
        self._car_at = car_at
        v, u = np.mgrid[0:180, 0:240] + 0.5
        self._rays = CAMERA.rays(np.stack([u, v], axis=-1))

    def of(self, pose, time_s):
        ground, roof = self._level(pose, 0.0), self._level(pose, ROOF[1])
        image = self._sample(GROUND, ground, CELL)
        along = self._along_car(ground, time_s)
        inside = (np.abs(along) < (2.5, 1.2)).all(axis=-1)
        image[inside] = self._sample(CAR, along, CELL)[inside]
        covered = (np.abs(roof) < ROOF[0]).all(axis=-1)
        image[covered] = self._sample(TILES, roof, CELL)[covered]
        return self._noisy(image, time_s)

    def _level(self, pose, height_m):
        """Where each pixel's ray meets a height."""
        d = self._rays @ pose.rotation.T
        at = pose.translation + d * ((height_m - pose.translation[2]) / d[..., 2])[..., None]
        return at[..., :2]

    def _along_car(self, ground, time_s):
        """Points of the ground along and across the car, from its middle."""
        place, course = self._car_at(time_s)
        c, s = np.cos(course), np.sin(course)
        return (ground - place) @ np.array([[c, -s], [s, c]])

    @staticmethod
    def _noisy(image, time_s):
        noise = np.roll(NOISE, round(time_s * 10) * 7, axis=1)
        return np.clip(image + noise, 0, 255).astype(np.uint8)

    @staticmethod
    def _sample(picture, points, cell):
        at = (points / cell + np.array(picture.shape[::-1]) / 2).astype(np.float32)
        return cv2.remap(picture, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)


def looking(eye, at):
    z = np.array(at) - eye
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    return Pose(np.column_stack([x, np.cross(z, x), z]), np.array(eye))


def watching(time_s):
    """Circles at 90 m, and keeps the middle in view."""
    angle = 0.05 * time_s
    eye = (25.0 * np.cos(angle), 25.0 * np.sin(angle) - 10.0, 90.0)
    return looking(eye, (0.0, -5.0, 0.0))


def close_by(time_s):
    """Half as high, a car's length off the crossing."""
    return looking((-14.0 + 2.0 * time_s, -24.0, 45.0), (-14.0, -16.0, 0.0))


def driving(time_s):
    """A bend beside the roof, then under its edge: 5 m/s."""
    way = 5.0 * time_s - 30.0
    return (way, -11.0 + 6.0 * np.tanh(way / 10.0)), float(
        np.arctan2(0.6 / np.cosh(way / 10) ** 2, 1)
    )


class Watcher(Operator):
    """An operator with pictures; poses err by a little, as a registration's do."""

    def __init__(self, pictures, flown=watching, sigma_m=0.05):
        super().__init__(flown=flown, rate_hz=10.0)
        self.at, self._sigmas = flown, np.repeat([sigma_m, 6e-3 * sigma_m], 3)
        self._pictures = pictures
        self._rng = np.random.default_rng(0)

    def fly(self, frames=1, state=None):
        for _ in range(frames):
            time_s = self.time_ms / 1e3
            true = self.at(time_s)
            off = self._rng.normal(0, self._sigmas)
            told = Pose(so3_exp(off[3:]) @ true.rotation, true.translation + off[:3])
            seen = scene.estimate(told, self.time_ms * MS, sigma=0.05, camera=CAMERA)
            self.clicks.add_estimate(seen)
            self.population.add_image(seen, self._pictures.of(true, time_s))
            self.population.predict(seen)
            self.time_ms += 100
        self.now_ms = self.time_ms - 100


def click(watcher, point, delay_s=0.25):
    """Where the operator saw it: the frame is `delay_s` old when the command comes."""
    seen_s = (watcher.now_ms + 40) / 1e3 - delay_s
    seen = scene.estimate(watcher.at(seen_s), 0, camera=CAMERA)
    pixel = pixel_of(seen, np.array(point(seen_s)))
    assert pixel is not None
    u, v = pixel
    watcher.clicks_at(u / CAMERA.width, v / CAMERA.height)


def test_a_car_is_followed_through_a_bend_and_found_again_behind_a_roof():
    watcher = Watcher(Pictures(driving))
    watcher.fly(8)
    click(watcher, lambda t: (*driving(t)[0], 0.0))
    watcher.fly(110)
    assert watcher.gone == []
    told = [(t.fix, t.estimate.exposure_time_ns * 1e-9) for t in watcher.of(1)]
    error = {s: np.linalg.norm(f.position_world[:2] - driving(s)[0]) for f, s in told}
    seen = [s for f, s in told if f.visibility is Visibility.SEEN]
    assert np.median([error[s] for s in seen]) < 0.5
    for fix, s in told:  # in the second before its motion is measured, too
        assert error[s] < 4.0 * np.sqrt(fix.covariance.trace()), s
    settled = [f for f, s in told if f.visibility is Visibility.SEEN and s > 3.0]
    assert all(f.velocity is not None for f in settled)
    assert np.median([np.hypot(*f.velocity[:2]) for f in settled]) == pytest.approx(5.3, abs=0.7)
    gaps = np.diff(seen)
    assert gaps.max() > 1.9  # behind the roof
    assert seen[-1] > 11.0


def test_a_place_that_stands_is_never_told_to_move_though_a_car_passes_it():
    watcher = Watcher(Pictures(driving))
    watcher.fly(8)
    place = np.array([-8.0, -16.0, 0.0])
    click(watcher, lambda _: place)
    watcher.fly(65)  # the car passes over it
    fixes = [t.fix for t in watcher.of(1)]
    assert len(fixes) > 40
    assert all(f.velocity is None for f in fixes)
    for fix in fixes:
        np.testing.assert_allclose(fix.position_world, place, atol=1.0)


class Crossing(Pictures):
    """A car as grey as its road on a zebra crossing, as three flights lost it."""

    def of(self, pose, time_s):
        ground = self._level(pose, 0.0)
        along = self._along_car(ground, time_s)
        road = 0.15 * super().of(pose, time_s).astype(np.float32) + 75.0
        striped = (np.abs(ground[..., 0] + 20.0) < 3.0) & (np.mod(ground[..., 1], 2.4) < 1.2)
        image = np.where(striped, 215.0, road)
        image[(np.abs(along) < (2.5, 1.2)).all(axis=-1)] = 85.0
        for window in (0.9, -1.4):
            image[(np.abs(along - (window, 0.0)) < (0.4, 1.0)).all(axis=-1)] = 45.0
        return self._noisy(cv2.GaussianBlur(image, (0, 0), 0.7), time_s)


def test_a_car_that_is_clicked_at_on_a_zebra_crossing_is_followed():
    watcher = Watcher(Crossing(driving), close_by, 0.02)
    watcher.fly(22)
    click(watcher, lambda t: (*driving(t)[0], 0.0))
    watcher.fly(35)
    told = [(t.fix, t.estimate.exposure_time_ns * 1e-9) for t in watcher.of(1)]
    late = [(f, s) for f, s in told if s > 3.0 and f.visibility is Visibility.SEEN]
    assert len(late) > 8
    for fix, s in late:
        assert np.linalg.norm(fix.position_world[:2] - driving(s)[0]) < 1.0
        assert fix.velocity is not None
    assert watcher.gone == []


@pytest.mark.parametrize(
    ("gone_s", "before", "after", "told"),
    [(2.25, 22, 30, AlertId.TARGET_LEFT), (4.0, 8, 100, AlertId.TARGET_LOST)],
)
def test_a_car_that_is_gone_is_ended_with_a_word(gone_s, before, after, told):
    """It is not held at its place, be it that it left unseen or that it does not come back."""
    watcher = Watcher(Pictures(lambda t: driving(t) if t < gone_s else AWAY))
    watcher.fly(before)
    click(watcher, lambda t: (*driving(t)[0], 0.0))
    watcher.fly(after)
    assert watcher.alerts[-1] == alert(told, number=1)
    assert watcher.gone == ["ground station 1"]


@pytest.mark.parametrize("place", [(9.5, -9.5, 8.0), (-9.9, 0.0, 8.0), (-14.0, -20.0, 0.0)])
def test_a_place_that_stands_has_not_left(place):
    """A roof's corner and edge move against the ground in charts of them, as a car would."""
    watcher = Watcher(Pictures(driving))
    watcher.fly(8)
    click(watcher, lambda _: place)
    watcher.fly(45)
    assert watcher.gone == []
    assert [of.id for of in watcher.alerts] == [AlertId.TARGET_FOUND]


class _Slides:
    """A look that slides off a standing place at `speed` m/s and seems to have moved at once, as a
    roof's edge 10 m above the ground does in charts of it.
    """

    speed = 0.45
    ready = True
    is_changed = False

    def __init__(self, _gray, estimate, position, _half_m):
        self._begun_ns, self._place = estimate.exposure_time_ns, position
        self.is_isolated = False

    def isolate(self, pictures):
        self.is_isolated = len(pictures) > 1
        return self.is_isolated

    def forget_shape(self):
        self.is_isolated = False

    def find(self, _gray, estimate, expected, reach_m, was_hidden=False):
        since_s = (estimate.exposure_time_ns - self._begun_ns) * 1e-9
        return self._met(estimate, self.speed * since_s, expected, reach_m)

    def _met(self, estimate, way_m, expected, reach_m):
        """It, `way_m` north of its place, if that is within reach of where it is expected."""
        at = self._place + np.array([0.0, way_m, 0.0])
        pixel = pixel_of(estimate, at)
        near = pixel is not None and np.linalg.norm(at - expected) <= reach_m
        return FollowedPosition(at, pixel, 0.9) if near else None

    def find_on_ground(self, *_picture, **_how):
        return False, None  # it looks as the ground does

    def shows_ground(self, _gray, _estimate):
        return False

    def watch(self, *_picture):
        return self.is_changed


class _Drives(_Slides):
    speed = 4.0


class _Returns(_Drives):
    """A car under a roof for a second."""

    from_s, until_s = 1.2, 2.2

    def find(self, gray, estimate, expected, reach_m, was_hidden=False):
        since_s = (estimate.exposure_time_ns - self._begun_ns) * 1e-9
        if since_s < self.from_s:
            return super().find(gray, estimate, expected, reach_m)
        return self.beside(gray, estimate, expected, reach_m, since_s)

    def beside(self, gray, estimate, expected, reach_m, since_s):
        if since_s < self.until_s:
            return None
        return super().find(gray, estimate, expected, reach_m)


class _Edge(_Returns):
    """The same, but its edge looks like the car, 2 m ahead of where the car comes out."""

    def beside(self, gray, estimate, expected, reach_m, since_s):
        if since_s < self.until_s:
            return None
        return self._met(estimate, self.speed * self.until_s + 2.0, expected, reach_m)


class _Glimpse(_Slides):
    """What stands, of which something elsewhere once looks the same, before other ground."""

    speed = 0.0
    times_s: tuple[float, ...] = (0.2,)

    def find_on_ground(self, _gray, estimate, *_picture, **_how):
        since_s = round((estimate.exposure_time_ns - self._begun_ns) * 1e-9, 1)
        at = self._place + np.array([0.0, 3.0, 0.0])
        found = (
            FollowedPosition(at, pixel_of(estimate, at), 0.9) if since_s in self.times_s else None
        )
        return True, found


class _Beside(_Glimpse):
    """The same at one place all the time, as a roof's other corner."""

    times_s = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)


def _flown(follower, monkeypatch, frames, at=(0.5, 0.3)):
    monkeypatch.setattr(target_manager, "ImageFollower", follower)
    watcher = Operator(rate_hz=10.0)
    gray = np.zeros((480, 640), np.uint8)

    def fly(frames):
        for _ in range(frames):
            seen = scene.estimate(scene.pose_at(watcher.time_ms / 1e3), watcher.time_ms * MS)
            watcher.clicks.add_estimate(seen)
            watcher.population.add_image(seen, gray)
            watcher.population.predict(seen)
            watcher.time_ms += 100
        watcher.now_ms = watcher.time_ms - 100

    fly(10)
    watcher.clicks_at(*at)
    fly(frames)
    return watcher


def test_a_roof_s_edge_that_looks_like_the_car_is_not_taken_for_it(monkeypatch):
    """In two of four replays a car that drove under a roof was found again at the roof's edge."""
    told = [t.fix for t in _flown(_Edge, monkeypatch, 40).of(1)]
    begun_ns = told[0].exposure_time_ns
    seen = [f for f in told if f.visibility is Visibility.SEEN]
    assert (seen[-1].exposure_time_ns - begun_ns) * 1e-9 < _Edge.until_s
    assert len(seen) >= 5


def test_a_car_that_comes_out_where_it_must_is_found_at_once(monkeypatch):
    told = [t.fix for t in _flown(_Returns, monkeypatch, 40).of(1)]
    begun_ns = told[0].exposure_time_ns
    seen = [f for f in told if f.visibility is Visibility.SEEN]
    times = np.array([(f.exposure_time_ns - begun_ns) * 1e-9 for f in seen])
    assert times[times > _Returns.from_s].min() < _Returns.until_s + 0.6
    assert seen[-1].velocity is not None


@pytest.mark.parametrize("refused_s", [6.0, 1.0])
def test_a_car_that_is_found_and_refused_for_seconds_is_lost_with_a_word(monkeypatch, refused_s):
    """It was neither told nor ended: the operator heard of it no more."""
    see = TargetTrack.observe

    def refuses(track, estimate, pixel, **known):
        if 2_300 <= estimate.exposure_time_ns // MS < 2_300 + 1_000 * refused_s:
            track.refusal = TargetRefusal(RefusalReason.OFF_MAP)
            return None
        return see(track, estimate, pixel, **known)

    monkeypatch.setattr(TargetTrack, "observe", refuses)
    flown = _flown(_Drives, monkeypatch, 75, (0.9, 0.95))
    is_lost = refused_s > 4.0
    lost = alert(AlertId.TARGET_NOT_LOCATED, number=1, why="no map at its place")
    assert flown.alerts.count(lost) == is_lost
    assert bool(flown.gone) == is_lost


@pytest.mark.parametrize("follower", [_Slides, _Drives])
def test_what_has_not_left_after_a_second_does_not_move(monkeypatch, follower):
    watcher = _flown(follower, monkeypatch, 30)
    fixes = [t.fix for t in watcher.of(1)]
    assert len(fixes) > 20
    moved = np.linalg.norm(fixes[-1].position_world - fixes[0].position_world)
    if follower is _Drives:  # a car is told to move as before
        assert moved > 8.0
        assert fixes[-1].velocity is not None
    else:
        assert moved < 0.5
        assert all(f.velocity is None for f in fixes)


@pytest.mark.parametrize("follower", [_Glimpse, _Beside])
def test_what_looks_like_it_elsewhere_is_not_taken_for_its_departure(monkeypatch, follower):
    """In a flight's pictures roofs' corners and a pitch's line were told to drive off."""
    fixes = [t.fix for t in _flown(follower, monkeypatch, 25).of(1)]
    assert len(fixes) > 15
    assert all(f.velocity is None for f in fixes)
    assert all(np.linalg.norm(f.position_world - fixes[0].position_world) < 0.5 for f in fixes)


# --- A clicked car that stood and is gone: its old place is not told as if it were seen there ---


PLACE = (-26.0, -14.5)


def _told(until_s, gone_s=np.inf, back_s=np.inf):
    """A car at its place, but for between two times; it is clicked at after 0.8 s."""

    def car(time_s):
        return AWAY if gone_s < time_s < back_s else (PLACE, 0.0)

    watcher = Watcher(Crossing(car), watching, 0.02)
    watcher.fly(8)
    click(watcher, lambda _: (*PLACE, 0.0))
    watcher.fly(round(10 * until_s) - 8)
    return watcher, [(t.fix, t.estimate.exposure_time_ns * 1e-9) for t in watcher.of(1)]


def test_a_parked_car_that_is_gone_may_have_left_until_its_place_looks_as_it_did():
    """Of a grey car beside a zebra crossing a template shows the crossing, which stays."""
    watcher, told = _told(8.2, gone_s=2.4, back_s=7.6)
    assert watcher.alerts[1:] == [
        alert(AlertId.TARGET_MAY_HAVE_LEFT, number=1), alert(AlertId.TARGET_BACK, number=1),
    ]  # fmt: skip
    before = [f for f, s in told if s < 2.4]
    gone = [f for f, s in told if 7.4 < s < 7.6]
    assert {f.visibility for f in before} <= {Visibility.SEEN, Visibility.HELD}
    assert {f.visibility for f in gone} == {Visibility.HIDDEN}
    assert gone[-1].covariance[0, 0] > 10.0 * before[-1].covariance[0, 0]
    last = told[-1][0]
    assert last.visibility is Visibility.HELD
    assert last.covariance[0, 0] < 1.1 * before[-1].covariance[0, 0]
    assert all(f.velocity is None for f, _ in told)


def test_a_car_that_stays_parked_has_not_left():
    watcher, told = _told(4.0)
    assert len(watcher.alerts) == 1
    assert all(f.visibility is not Visibility.HIDDEN for f, _ in told)
