import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from companion.config import TargetConfig
from companion.targets.clicks import PoseHistory
from companion.targets.detections import Detection, TargetNumbers
from companion.targets.pictures import RecentPictures
from companion.targets.reporter import TargetReporter
from companion.targets.target_manager import Click
from localizer.errors import MapCacheError
from localizer.geometry.pose import Pose, so3_exp, so3_log
from localizer.map.cache.pick import BundleHits
from localizer.types import PoseEstimate
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.link.link import sleep_until
from tests.companion.estimates import estimated
from tests.companion.targets.scene import MS, estimate, pose_at


def _estimate(time_ns: int, accepted: bool = True) -> PoseEstimate:
    return estimated(time_ns=time_ns, accepted=accepted)


def _ground(origin, directions):
    return BundleHits(-origin[2] / directions[:, 2], np.tile([0.0, 0.0, 1.0], (len(directions), 1)))


def _sky(_, directions):
    return BundleHits(np.full(len(directions), np.nan), np.zeros((len(directions), 3)))


class Session:
    def __init__(self, cast=_ground, rate_hz=5.0):
        self.targets = []
        self.came = threading.Event()
        self.reporter = TargetReporter(
            TargetConfig(rate_hz=rate_hz, confirm_s=0.0), cast, self._add
        )
        self.reporter.start()

    def _add(self, target):
        self.targets.append(target)
        self.came.set()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.reporter.stop()


def test_detection_and_estimate_of_one_frame_meet_in_either_order():
    for first in ("detection", "estimate"):
        with Session() as s:
            detection = Detection("a", 50 * MS, 320.0, 240.0)
            if first == "detection":
                s.reporter.add_detection(detection)
                s.reporter.add_estimate(_estimate(50 * MS))
            else:
                s.reporter.add_estimate(_estimate(50 * MS))
                s.reporter.add_detection(detection)
            assert s.came.wait(30), first
            np.testing.assert_allclose(s.targets[0].fix.position_world, [0, 0, 0], atol=1e-6)


def test_a_detector_seven_seconds_behind_a_fast_camera_is_heard():
    """It names frames up to 256 back (`FrameTimes`); half of them had lost their pose by then."""
    with Session() as s:
        for k in range(250):
            s.reporter.add_estimate(_estimate((k + 1) * 33 * MS))
        s.reporter.add_detection(Detection("a", 33 * MS, 320.0, 240.0))
        assert s.came.wait(30)
        assert s.reporter.unmatched == 0


def test_detections_whose_frame_has_no_position_are_counted():
    with Session() as s:
        s.reporter.add_detection(Detection("a", 50 * MS, 320.0, 240.0))
        s.reporter.add_estimate(_estimate(50 * MS, accepted=False))
        s.reporter.add_estimate(_estimate(150 * MS))
        assert sleep_until(lambda: s.reporter.unmatched == 1, 30.0)
        for k in range(1000):  # of a clock that is ahead: they wait for frames that never come
            s.reporter.add_detection(Detection("a", 10**18 + k, 320.0, 240.0))
        assert s.reporter.unmatched == 1 + 1000 - 64
        assert not s.targets


@pytest.mark.parametrize(("cast", "u"), [(_sky, 320.0), (_ground, 5000.0)])
def test_a_ray_into_the_sky_and_a_pixel_beside_the_picture_are_counted(cast, u):
    with Session(cast=cast) as s:
        s.reporter.add_detection(Detection("a", 50 * MS, u, 240.0))
        s.reporter.add_estimate(_estimate(50 * MS))
        assert sleep_until(lambda: s.reporter.missed == 1, 30.0)
        assert not s.targets


def test_reports_keep_their_rate_and_a_failing_cast_does_not_end_them():
    calls = []

    def cast(origin, directions):
        calls.append(1)
        if len(calls) == 1:
            raise RuntimeError("boom")
        return _ground(origin, directions)

    with Session(cast=cast, rate_hz=5.0) as s:
        for k in range(21):
            s.reporter.add_estimate(_estimate(k * 50 * MS))
            s.reporter.add_detection(Detection("a", k * 50 * MS, 320.0, 240.0))
            time.sleep(0.01)
        assert sleep_until(lambda: len(s.targets) >= 4, 30.0)
        time.sleep(0.3)
        assert s.reporter.failed == 1
    assert 4 <= len(s.targets) <= 6  # 1 s at 5 Hz


def test_a_flood_of_names_is_bounded_and_room_comes_back(caplog):
    with Session(rate_hz=30.0) as s:

        def seen(names, time_ns):
            s.reporter.add_estimate(_estimate(time_ns))
            for name in names:
                s.reporter.add_detection(Detection(name, time_ns, 320.0, 240.0))

        seen([f"car {i}" for i in range(40)], 10**9)
        assert sleep_until(lambda: s.reporter.refused == 8, 30.0)
        seen(["car 3", "late"], 5 * 10**9)
        assert sleep_until(lambda: s.reporter.refused == 9, 30.0)
        seen(["late"], 12 * 10**9)  # all but car 3 are gone for more than 10 s
        assert sleep_until(lambda: len(s.targets) == 34, 30.0)
        assert s.targets[-1].fix.target_id == "late"
    assert sum("more than 32 targets" in r.message for r in caplog.records) == 1


def test_a_click_that_no_map_answers_is_refused_and_not_left_alive(caplog):
    """Its alert refers to the log, which had the first click's error only."""

    def unreadable(_origin, _directions):
        raise MapCacheError("tile 7: cannot be read")

    said: list[Alert] = []
    gone, ended = [], threading.Event()
    reporter = TargetReporter(
        TargetConfig(), unreadable, lambda _: None, lambda name: (gone.append(name), ended.set()),
        said.append,
    )  # fmt: skip
    reporter.start()
    try:
        for number in (3, 4):
            ended.clear()
            reporter.begin(Click(number, _estimate(50 * MS), (320.0, 240.0)))
            assert ended.wait(60.0)
    finally:
        reporter.stop()
    assert gone == ["ground station 3", "ground station 4"]
    assert said == [alert(AlertId.TARGET_UNREADABLE, number=number) for number in (3, 4)]
    assert reporter.failed == 2
    assert sum("could not be located" in r.message for r in caplog.records) == 2


# --- Where the camera was at a time that no frame has, and at one that a frame has nearly -------


def estimate_at(time_ns):
    """Of one pose, whenever."""
    return estimate(pose_at(1.0), time_ns)


def test_of_two_frames_that_are_near_the_nearer_one_is_meant():
    """At 60 frames/s both neighbours are within 20 ms, and a gimbal turns 1 degree between them."""
    history = PoseHistory()
    for k in range(4):
        history.add(estimate_at(round(k * 16.7 * MS)))
    for k in range(4):
        at = history.at(round(k * 16.7 * MS) - MS // 2)
        assert at.exposure_time_ns == round(k * 16.7 * MS), k


def test_between_two_frames_the_pose_is_between_and_the_worse_covariance_holds():
    history = PoseHistory()
    begin = estimate_at(0)
    end = estimate_at(200 * MS)
    place = Pose(
        end.world_from_camera.rotation, end.world_from_camera.translation + np.array([4.0, 0, 0])
    )
    worse = replace(end, world_from_camera=place, covariance=np.eye(6) * 9.0)
    history.add(begin)
    history.add(worse)
    at = history.at(50 * MS)
    offset = at.world_from_camera.translation - begin.world_from_camera.translation
    np.testing.assert_allclose(offset, [1.0, 0.0, 0.0], atol=1e-9)
    added = at.covariance - worse.covariance
    assert (np.diag(added) >= 0.0).all()
    assert np.abs(added).max() < 1e-3  # 200 ms of a motion of which nothing says that it changes
    assert history.at(400 * MS) is None
    assert history.at(-100 * MS) is None


def _swinging(time_s):
    """Swings by 6 degrees and 3 m, once in 4 s."""
    turn = np.array([0.0, 0.0, 0.1 * np.sin(0.5 * np.pi * time_s)])
    base = pose_at(1.0)
    aside = np.array([3.0 * np.cos(0.5 * np.pi * time_s), 0.0, 0.0])
    return Pose(so3_exp(turn) @ base.rotation, base.translation + aside)


def test_between_two_poses_of_a_camera_that_swings_the_error_is_in_the_covariance():
    """At two poses a second a line between them misses the swing by a degree: metres on the ground.

    Told was the covariance of the neighbours, 0.06 degrees.
    """
    history, sigma = PoseHistory(), np.repeat([0.1, 1e-3], 3)
    times = range(1000, 9000, 500)
    for ms in times:
        told = estimate(_swinging(ms / 1e3), ms * MS)
        history.add(replace(told, covariance=np.diag(sigma**2)))
    errors = []
    for ms in range(2000, 7000, 50):
        at, true = history.at(ms * MS), _swinging(ms / 1e3)
        pose = at.world_from_camera
        off = np.concatenate(
            [pose.translation - true.translation, so3_log(pose.rotation @ true.rotation.T)]
        )
        errors.append(np.abs(off) / np.sqrt(np.diag(at.covariance)))
    assert np.max(errors) < 2.0


def test_between_the_frames_of_a_steady_flight_the_covariance_is_what_it_was():
    history, sigma = PoseHistory(), np.repeat([0.06, 4.4e-4], 3)
    rng = np.random.default_rng(0)
    for ms in range(1000, 6000, 100):
        pose = pose_at(ms / 1e3)
        off = rng.normal(0.0, sigma)
        told = Pose(so3_exp(off[3:]) @ pose.rotation, pose.translation + off[:3])
        history.add(replace(estimate(told, ms * MS), covariance=np.diag(sigma**2)))
    middles = [history.at(ms * MS) for ms in range(1550, 5500, 100)]
    grown = [np.sqrt(np.diag(at.covariance)) / sigma for at in middles if at is not None]
    assert len(grown) == len(middles)
    assert np.median(grown) < 1.25


# --- The numbers that targets have in MAVLink ---------------------------------------------------


def test_a_name_keeps_its_number_and_a_click_its_own():
    numbers = TargetNumbers()
    first, second = numbers.number_of("car a"), numbers.number_of("car b")
    assert first != second
    assert numbers.number_of("car a") == first
    assert numbers.number_of("ground station 7") == 7
    assert numbers.number_of("console 8") == 8


def test_names_without_end_take_no_memory_without_end():
    """A detector names what it sees anew as long as it flies; no number is given twice."""
    numbers = TargetNumbers()
    kept = numbers.number_of("kept")
    given = set()
    for k in range(2000):
        given.add(numbers.number_of(f"thing {k}"))
        assert numbers.number_of("kept") == kept  # what is still there is not forgotten
    assert len(given) == 2000
    assert kept not in given
    assert numbers.number_of("thing 0") not in given  # it was forgotten


# --- pictures -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("shape", "kept"), [((54, 96), 16), ((540, 960), 16), ((2160, 3840), 4)])
def test_pictures_are_kept_by_number_and_by_bytes(shape, kept):
    """Attack: sixteen of 4K took 400 MB."""
    pictures = RecentPictures[np.ndarray](16, lambda image: image.nbytes)
    blank = np.zeros((*shape, 3), np.uint8)
    for _ in range(40):
        pictures.append(blank)
    assert len(pictures) == kept
    assert pictures.nbytes == kept * blank.nbytes <= 100 << 20


def test_what_is_dropped_makes_room():
    pictures = RecentPictures[bytes](8, len, most_bytes=40)
    for k in range(5):
        pictures.append(bytes([k]) * 10)
    assert [item[0] for item in pictures] == [1, 2, 3, 4]
    pictures.retain(lambda item: item[0] >= 3)
    assert (len(pictures), pictures.nbytes) == (2, 20)
    pictures.append(b"\x09" * 100)  # alone above what is allowed: the newest three stay
    assert [item[0] for item in pictures] == [3, 4, 9]
