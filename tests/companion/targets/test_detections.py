import socket
import threading
from fractions import Fraction

import numpy as np
import pytest

from companion.errors import ConfigError, DetectionError
from companion.targets.detections import (
    Detection,
    DetectionListener,
    FrameName,
    Senders,
    encode_detection,
    parse_detection,
    parse_host_port,
)
from companion.targets.frame_times import FrameTimes
from localizer.geometry.camera import Camera
from localizer.types import Frame


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"{",
        b"[]",
        b"\xff\xfe",
        b'{"target_id": "a", "time_ns": 1, "u": 1}',
        b'{"target_id": "a", "time_ns": "x", "u": 1, "v": 2}',
        b'{"target_id": "a", "time_ns": 1, "u": NaN, "v": 2}',
        b'{"target_id": "", "time_ns": 1, "u": 1, "v": 2}',
        b'{"target_id": "' + b"a" * 100 + b'", "time_ns": 1, "u": 1, "v": 2}',
        b"[" * 1500,
        b'{"target_id": "\\ud800", "time_ns": 1, "u": 1, "v": 2}',  # half a surrogate pair
        b'{"target_id": "a\\nb", "time_ns": 1, "u": 1, "v": 2}',
        b'{"target_id": "ground station 3", "time_ns": 1, "u": 1, "v": 2}',  # a click's name
        b'{"target_id": "detector car 1", "time_ns": 1, "u": 1, "v": 2}',  # of another detector
        b'{"target_id": "a", "u": 1, "v": 2}',  # which frame?
        b'{"target_id": "a", "sequence": 1, "pts_s": 1.0, "u": 1, "v": 2}',
        b'{"target_id": "a", "pts_s": NaN, "u": 1, "v": 2}',
        b'{"target_id": "a", "sequence": "x", "u": 1, "v": 2}',
        b'{"target_id": "a", "time_ns": null, "u": 1, "v": 2}',
    ],
)
def test_bad_datagrams_are_named(data):
    with pytest.raises(DetectionError):
        parse_detection(data)


@pytest.mark.parametrize("text", ["", "5600", "host", "host:", "host:0", "host:99999", ":1"])
def test_bad_addresses_are_named(text):
    with pytest.raises(ConfigError):
        parse_host_port(text)


def test_garbage_and_what_fails_on_one_detection_do_not_close_the_door():
    """Its thread ended without a word, and every later detection was lost."""
    got, came = [], threading.Event()

    def take(detection, name):
        if detection.target_id == "bad":
            raise RuntimeError("a part's fault")
        got.append(detection)
        came.set()

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        listener = DetectionListener(f"127.0.0.1:{port}", take)
        try:
            sender.sendto(b"garbage", ("127.0.0.1", port))
            for name in ("bad", "good"):
                one = encode_detection(Detection(name, 1, 2.0, 3.0))
                sender.sendto(one, ("127.0.0.1", port))
            assert came.wait(30.0)
        finally:
            listener.close()
    assert got == [Detection("good", 1, 2.0, 3.0)]
    assert (listener.rejected, listener.failed) == (1, 1)


# --- frame times --------------------------------------------------------------------------------


CAMERA = Camera(64, 48, 60.0, 60.0, 32.0, 24.0)
IMAGE = np.zeros((48, 64, 3), np.uint8)


def test_each_of_the_three_ways_to_name_a_frame():
    told: list[Detection] = []
    times = FrameTimes(told.append)
    times.add_frame(Frame(IMAGE, 1000, CAMERA, 7))
    times.frame_exposed(Fraction(3003, 90_000), 2000)
    for way in ('"time_ns": 500', '"sequence": 7', '"pts_s": 0.0333'):
        text = f'{{"target_id": "car", "u": 1.5, "v": 2.5, {way}}}'
        times.add_detection(*parse_detection(text.encode()))
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


def test_what_waits_for_a_picture_of_the_old_connection_gets_none_of_the_new():
    """The camera was switched off and on: its presentation times begin anew."""
    told: list[Detection] = []
    times = FrameTimes(told.append)
    times.frame_exposed(Fraction(5), 7)
    times.begin(None)
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


# --- Two detectors with one name for a target are two; one that was started again is the same ---


A, B, C = ("127.0.0.1", 4000), ("127.0.0.1", 4001), ("10.0.0.2", 4000)
S = 1_000_000_000


def _named(senders, *order, name="car", step_ns=S // 10):
    return [senders.name_of(name, who, k * step_ns) for k, who in enumerate(order)]


def test_two_detectors_with_one_name_are_two():
    """Their targets were one, that leapt between two places."""
    told = _named(Senders(), A, B, A, B, A, B, C, B, C)
    assert told[2:6] == ["car", "car #2", "car", "car #2"]
    assert told[-2:] == ["car #2", "car #3"]


def test_other_names_are_not_touched():
    senders = Senders()
    _named(senders, A, B, A, B)
    assert _named(senders, A, A, name="van") == ["van", "van"]


@pytest.mark.parametrize(
    "order", [[A, A, A, B, B, B], [("127.0.0.1", port) for port in range(5000, 5400)]]
)
def test_a_detector_that_is_started_again_or_opens_a_socket_each_time_is_one(order):
    assert set(_named(Senders(), *order)) == {"car"}


def test_a_name_is_free_once_its_sender_is_silent():
    senders = Senders()
    _named(senders, A, B, A, B)
    assert senders.name_of("car", C, 100 * S) == "car"
