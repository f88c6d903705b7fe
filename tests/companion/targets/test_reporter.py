import threading
import time

import numpy as np

from companion.config import TargetConfig
from companion.targets.detections import Detection
from companion.targets.reporter import TargetReporter
from companion.targets.target_manager import Click
from localizer.errors import MapCacheError
from localizer.map.cache.pick import BundleHits
from localizer.types import PoseEstimate
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.link.link import sleep_until
from tests.companion.estimates import estimated

MS = 1_000_000


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


def test_a_ray_into_the_sky_is_counted():
    with Session(cast=_sky) as s:
        s.reporter.add_detection(Detection("a", 50 * MS, 320.0, 240.0))
        s.reporter.add_estimate(_estimate(50 * MS))
        assert sleep_until(lambda: s.reporter.missed == 1, 30.0)
        assert not s.targets


def test_a_pixel_beside_the_picture_is_counted_as_missed():
    with Session() as s:
        s.reporter.add_detection(Detection("a", 50 * MS, 5000.0, 240.0))
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


def test_a_click_that_no_map_answers_is_refused_and_not_left_alive():
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
        reporter.begin(Click(3, _estimate(50 * MS), (320.0, 240.0)))
        assert ended.wait(60.0)
    finally:
        reporter.stop()
    assert gone == ["ground station 3"]
    assert said == [alert(AlertId.TARGET_UNREADABLE, number=3)]
    assert reporter.failed == 1
