"""Metadata of a live camera, over UDP and RTSP: every field of a picture is what was told of it."""

from __future__ import annotations

import io
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from companion.config import KlvConfig
from companion.klv.relay import KlvRelay
from companion.sources import SourceSettings, open_source
from companion.sources.timing import system_minus_monotonic
from companion.targets.target_manager import TargetEstimate
from localizer.geometry.pose import Array, matrix_from_euler
from localizer.types import TargetFix
from sitl.camera.stream import VideoSender
from tests.companion.klv.test_video import SCENE, estimate, fields_of, read_stream
from tests.companion.sources.rtsp_camera import CAMERA, RtspCamera

PATIENCE_S = 120.0
DESCRIBED = 8
UDP_RATE_HZ = 25
BODY = matrix_from_euler(0.05, 0.1, 2.0)


class UdpCamera:
    """Streams MPEG-TS to a port, with the times of its exposures in the pictures."""

    def __init__(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            self.url = f"udp://127.0.0.1:{free.getsockname()[1]}"
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._stream)
        self._thread.start()

    def close(self) -> None:
        self._closed.set()
        self._thread.join()

    def _stream(self) -> None:
        sender = VideoSender(self.url, CAMERA.width, CAMERA.height, UDP_RATE_HZ)
        image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
        while not self._closed.wait(1.0 / UDP_RATE_HZ):
            sender.send(image, time.monotonic_ns())
        sender.close()


@pytest.fixture(params=[UdpCamera, RtspCamera])
def camera(request: pytest.FixtureRequest) -> Iterator[Any]:
    made = request.param()
    yield made
    made.close()


class Listener:
    """Keeps every datagram that comes to its port."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self.url = f"udp://127.0.0.1:{self._socket.getsockname()[1]}"
        self._data = bytearray()
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def close(self) -> bytes:
        """All that came; to be called when nobody sends any more."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ender:
            ender.sendto(b"", self._socket.getsockname())
        self._thread.join()
        self._socket.close()
        return bytes(self._data)

    def _listen(self) -> None:
        while datagram := self._socket.recv(65536):
            self._data += datagram


def test_every_field_of_a_live_picture_is_what_was_told_of_it(camera: Any) -> None:
    listener = Listener()
    relay, offset_ns = _relay(listener.url)
    told = _fly(camera.url, relay)
    kinds, video, metadata = read_stream(io.BytesIO(listener.close()))
    assert relay.failed == 0
    assert [kind for kind, _ in kinds] == ["video", "data"]
    assert len(metadata) == relay.described >= DESCRIBED
    assert len(video) >= len(metadata)
    for packet in metadata.values():
        fields = fields_of(packet)
        taken_us = round(fields[2].timestamp() * 1e6)
        (east,) = [e for ns, e in told.items() if (ns + offset_ns) // 1000 == taken_us]
        _require_told(fields, east)


def _require_told(fields: dict[int, Any], east: float) -> None:
    """Of a camera 100 m over flat ground that looks straight down, and of its target."""
    place = SCENE.frame.position(np.array([east, 0.0, 100.0]))
    assert fields[3] == "survey 7"
    assert fields[13] == pytest.approx(place.latitude_deg, abs=3e-8)
    assert fields[14] == pytest.approx(place.longitude_deg, abs=6e-8)
    assert fields[15] == pytest.approx(place.height_m - SCENE.geoid_m, abs=0.16)
    assert fields[5] == pytest.approx(np.degrees(2.0), abs=0.003)
    assert (fields[6], fields[7]) == pytest.approx(np.degrees((0.1, 0.05)), abs=1e-3)
    under = SCENE.frame.position(np.array([east, 0.0, 0.0]))
    assert fields[21] == pytest.approx(100.0, abs=0.1)
    assert fields[23] == pytest.approx(under.latitude_deg, abs=3e-8)
    assert fields[24] == pytest.approx(under.longitude_deg, abs=6e-8)
    target = SCENE.frame.position(_target_of(east))
    assert fields[40] == pytest.approx(target.latitude_deg, abs=3e-8)
    assert fields[41] == pytest.approx(target.longitude_deg, abs=6e-8)


def _relay(output: str) -> tuple[KlvRelay, int]:
    offset_ns = system_minus_monotonic()
    config = KlvConfig(output=output, mission="survey 7", hold_ms=500)
    relay = KlvRelay(config, SCENE, lambda _: BODY, offset_ns)
    relay.start()
    return relay, offset_ns


def _fly(url: str, relay: KlvRelay) -> dict[int, float]:
    """Localize each picture at another place, until enough were described; by exposure."""
    told: dict[int, float] = {}
    source = open_source(url, CAMERA, SourceSettings(stall_timeout_s=20.0), tap=relay)
    end = time.monotonic() + PATIENCE_S
    try:
        for count, frame in enumerate(source.frames()):
            now_ns, east = frame.exposure_time_ns, 40.0 + 2.0 * count
            told[now_ns] = east
            one = estimate(now_ns, east)
            fix = TargetFix("car", _target_of(east), np.eye(3), (1.0, 1.0), now_ns)
            relay.add_target(TargetEstimate(fix, one))
            relay.add_estimate(one)
            if relay.described >= DESCRIBED or time.monotonic() > end:
                break
    finally:
        source.close()
        relay.stop()
    return told


def _target_of(east: float) -> Array:
    """(3,) metres: the target of the picture that was taken there; it moves as the camera does."""
    return np.array([east + 7.0, 3.0, 0.0])
