"""A detector that names its frame by number or presentation time gets that frame's exposure."""

from fractions import Fraction

import numpy as np
import pytest

from companion.errors import DetectionError
from companion.targets.detections import Detection, FrameName, parse_detection
from companion.targets.frame_times import FrameTimes
from localizer.geometry.camera import Camera
from localizer.types import Frame

CAMERA = Camera(64, 48, 60.0, 60.0, 32.0, 24.0)
IMAGE = np.zeros((48, 64, 3), np.uint8)


def _asked(text):
    return parse_detection(text.encode())


def test_each_of_the_three_ways_to_name_a_frame():
    told: list[Detection] = []
    times = FrameTimes(told.append)
    times.add_frame(Frame(IMAGE, 1000, CAMERA, 7))
    times.frame_exposed(Fraction(3003, 90_000), 2000)
    for way in ('"time_ns": 500', '"sequence": 7', '"pts_s": 0.0333'):
        times.add_detection(*_asked(f'{{"target_id": "car", "u": 1.5, "v": 2.5, {way}}}'))
    assert told == [Detection("car", t, 1.5, 2.5) for t in (500, 1000, 2000)]
    assert times.unmatched == 0


def test_a_detection_may_come_before_its_frame_and_none_is_given_anothers_time():
    told: list[Detection] = []
    times = FrameTimes(told.append)
    car = Detection("car", 0, 1.0, 2.0)
    times.add_detection(car, FrameName(pts_s=0.1))
    times.add_detection(car, FrameName(sequence=3))
    times.frame_exposed(Fraction(9180, 90_000), 10)  # 2 ms beside
    times.add_frame(Frame(IMAGE, 20, CAMERA, 2))
    assert told == []
    times.add_frame(Frame(IMAGE, 30, CAMERA, 3))
    times.frame_exposed(Fraction(1, 10), 40)
    assert [d.time_ns for d in told] == [30, 40]


def test_after_a_reconnection_old_presentation_times_mean_nothing():
    told: list[Detection] = []
    times = FrameTimes(told.append)
    times.frame_exposed(Fraction(1), 10)
    times.begin(None)
    times.add_detection(Detection("car", 0, 1.0, 2.0), FrameName(pts_s=1.0))
    assert told == []
    times.frame_exposed(Fraction(1), 99)
    assert [d.time_ns for d in told] == [99]


def test_what_waits_for_a_picture_of_the_old_connection_gets_none_of_the_new():
    """The camera was switched off and on: its presentation times begin anew."""
    told: list[Detection] = []
    times = FrameTimes(told.append)
    times.add_detection(Detection("car", 0, 1.0, 2.0), FrameName(pts_s=5.0))
    times.add_detection(Detection("van", 0, 1.0, 2.0), FrameName(sequence=3))
    times.begin(None)
    times.frame_exposed(Fraction(5), 99)
    assert told == []
    assert times.unmatched == 1
    times.add_frame(Frame(IMAGE, 120, CAMERA, 3))  # frames are counted on
    assert [d.target_id for d in told] == ["van"]


def test_frames_that_never_come_are_counted_and_a_flood_of_them_takes_no_memory():
    times = FrameTimes(lambda _: pytest.fail("no frame came"))
    for k in range(1000):
        times.add_detection(Detection("car", 0, 1.0, 2.0), FrameName(sequence=k))
    assert times.unmatched == 1000 - 64


@pytest.mark.parametrize(
    "way", ["", '"sequence": 1, "pts_s": 1.0', '"pts_s": NaN', '"sequence": "x"', '"time_ns": null']
)
def test_a_detection_without_one_frame_is_refused(way):
    with pytest.raises(DetectionError):
        _asked(f'{{"target_id": "car", "u": 1.5, "v": 2.5{", " if way else ""}{way}}}')
