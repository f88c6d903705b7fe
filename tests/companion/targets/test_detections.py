import socket
import threading
import time

import pytest

from companion.errors import ConfigError, DetectionError
from companion.targets.detections import (
    Detection,
    DetectionListener,
    encode_detection,
    parse_detection,
    parse_host_port,
)


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
    ],
)
def test_bad_datagrams_are_named(data):
    with pytest.raises(DetectionError):
        parse_detection(data)


@pytest.mark.parametrize("text", ["", "5600", "host", "host:", "host:0", "host:99999", ":1"])
def test_bad_addresses_are_named(text):
    with pytest.raises(ConfigError):
        parse_host_port(text)


def test_listener_survives_garbage():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    got: list[Detection] = []
    listener = DetectionListener(f"127.0.0.1:{port}", lambda detection, _: got.append(detection))
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(b"garbage", ("127.0.0.1", port))
            sender.sendto(encode_detection(Detection("a", 1, 2.0, 3.0)), ("127.0.0.1", port))
        deadline = time.monotonic() + 30
        while not got and time.monotonic() < deadline:
            time.sleep(0.01)
    finally:
        listener.close()
    assert got == [Detection("a", 1, 2.0, 3.0)]
    assert listener.rejected == 1


def test_what_fails_on_one_detection_does_not_close_the_door():
    """Its thread ended without a word, and every later detection was lost."""
    got, came = [], threading.Event()

    def take(detection, name):
        if detection.target_id == "bad":
            raise RuntimeError("a part's fault")
        got.append(detection.target_id)
        came.set()

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        listener = DetectionListener(f"127.0.0.1:{port}", take)
        try:
            for name in ("bad", "good"):
                one = encode_detection(Detection(name, 1, 2.0, 3.0))
                sender.sendto(one, ("127.0.0.1", port))
            assert came.wait(30.0)
        finally:
            listener.close()
    assert (got, listener.failed) == (["good"], 1)
