"""When an operator's click is placed, and by which frame."""

from types import SimpleNamespace

import numpy as np
import pytest

from companion.config import TargetConfig
from companion.targets.clicks import ClickPolicy
from companion.targets.detections import Detection
from companion.targets.reporter import TargetReporter
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.map.cache.pick import BundleHits
from localizer.types import PoseEstimate, RegistrationStatus, TrackingState
from mavlink_bridge.link.link import sleep_until
from mavlink_bridge.messages import TrackRequest


@pytest.mark.parametrize(("age_s", "placed"), [(0.3, True), (2.5, False), (None, False)])
def test_a_click_is_not_placed_by_an_old_pose(age_s, placed):
    """The operator points into the present picture, and is told when nobody knows where it is."""
    second, now_ns = 10**9, 10**12
    detections, texts = [], []
    reporter = SimpleNamespace(add_detection=detections.append, forget=lambda _: None)
    clicks = ClickPolicy(reporter, lambda _, text: texts.append(text))
    if age_s is not None:
        exposure_ns, camera = now_ns - round(age_s * second), SimpleNamespace(width=160, height=120)
        state = TrackingState.TRACKING
        clicks.add_estimate(
            SimpleNamespace(camera=camera, exposure_time_ns=exposure_ns, accepted=True, state=state)
        )
    for k in range(5):  # an impatient operator
        clicks.on_request(TrackRequest("point", now_ns + k, (0.5, 0.25)))
    clicks.on_request(TrackRequest("stop", now_ns))
    assert [(d.u, d.v) for d in detections] == ([(80.0, 30.0)] * 5 if placed else [])
    told = ["PiLoT: no target: the camera's position is not known"]
    assert texts == ([] if placed else told)


class Ground:
    """A ground station that clicks into frames of a camera 100 m above flat ground."""

    def __init__(self):
        self.targets, self.texts, self.gone = [], [], []
        self.reporter = TargetReporter(
            TargetConfig(), flat, self.targets.append, on_gone=self.gone.append
        )
        self.clicks = ClickPolicy(self.reporter, lambda _, text: self.texts.append(text))
        self.reporter.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.reporter.stop()

    def sees(self, time_ns, state=TrackingState.TRACKING):
        estimate = PoseEstimate(
            NADIR, np.eye(6) * 1e-4, 1.0, state, RegistrationStatus.OK, True, time_ns, 0, CAMERA
        )
        self.clicks.add_estimate(estimate)
        self.reporter.add_estimate(estimate)

    def clicks_at(self, x, y, time_ns):
        self.clicks.on_request(TrackRequest("point", time_ns, (x, y)))

    def has(self, count):
        return sleep_until(lambda: len(self.targets) >= count, 30.0)


CAMERA = Camera.from_fov(640, 480, 60)
NADIR = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 100.0]))
MS = 1_000_000


def flat(origin, directions):
    return BundleHits(-origin[2] / directions[:, 2], np.tile([0.0, 0.0, 1.0], (len(directions), 1)))


def _places(ground):
    return [tuple(np.round(t.fix.position_world[:2])) for t in ground.targets]


def test_a_second_click_is_a_second_target():
    """A, then B 60 m away: B was reported as A, twice, and then with A's way to B as velocity."""
    with Ground() as ground:
        for k, x in enumerate((0.25, 0.25 + 0.52, 0.25, 0.25 + 0.52)):
            ground.sees(k * 400 * MS)
            ground.clicks_at(x, 0.5, k * 400 * MS + 10)
            assert ground.has(k + 1)
        a, b = _places(ground)[:2]
        assert b[0] - a[0] == pytest.approx(60.0, abs=1.0)
        assert _places(ground) == [a, b, a, b]
        assert len({t.fix.target_id for t in ground.targets}) == 4
        assert [t.velocity for t in ground.targets] == [None] * 4


def test_stop_ends_every_clicked_target_and_no_detected_one():
    with Ground() as ground:
        ground.sees(0)
        ground.clicks_at(0.25, 0.5, 10)
        ground.reporter.add_detection(Detection("car", 0, 320.0, 240.0))
        assert ground.has(2)
        ground.clicks.on_request(TrackRequest("stop", 20))
        clicked = [t.fix.target_id for t in ground.targets if t.fix.target_id != "car"]
        assert sleep_until(lambda: ground.gone == clicked, 30.0)
        ground.clicks.on_request(TrackRequest("stop", 30))  # there is nothing left to stop
        ground.sees(400 * MS)
        ground.clicks_at(0.25, 0.5, 400 * MS)
        ground.reporter.add_detection(Detection("car", 400 * MS, 320.0, 240.0))
        assert ground.has(4)
        assert len(ground.gone) == 1
        cars = [t for t in ground.targets if t.fix.target_id == "car"]
        assert cars[0].velocity is None
        assert np.linalg.norm(cars[1].velocity) < 0.5  # the same one, seen twice


@pytest.mark.parametrize("state", [TrackingState.INITIALIZING, TrackingState.LOST])
def test_a_click_is_not_placed_by_a_pose_that_nothing_confirms(state):
    with Ground() as ground:
        ground.sees(0)
        ground.sees(100 * MS, state)
        ground.clicks_at(0.5, 0.5, 100 * MS)
        assert ground.texts == ["PiLoT: no target: the camera's position is not confirmed yet"]
        ground.sees(200 * MS)
        ground.clicks_at(0.5, 0.5, 200 * MS)
        assert ground.has(1)
        assert len(ground.texts) == 1
