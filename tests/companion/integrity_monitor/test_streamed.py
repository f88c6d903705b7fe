"""Real streams that do not show the present: encoded, sent by UDP, decoded, and watched."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from companion.sources import SourceSettings, open_source
from localizer.geometry.camera import Camera
from localizer.types import Image
from mavlink_bridge.alerts.ids import AlertId
from sitl.camera.stream import VideoSender
from tests.companion.integrity_monitor.simulated import Flight, leg, monitor, second
from tests.companion.sources.paced_sender import (
    CAMERA,
    Watch,
    counter_image,
    free_port,
    read_counter,
)

HZ = 8.0
SHOT = Camera.from_fov(320, 240, 70.0)
FAULT_S = 16.0


@pytest.fixture(scope="module")
def ground() -> Image:
    """0.2 m to a pixel, 480 m by 160 m."""
    noise = np.random.default_rng(3).integers(40, 215, (150, 400, 3), np.uint8)
    return np.asarray(cv2.resize(noise, (800, 2400)), np.uint8)


def shown(ground: Image, at_s: float, rng: np.random.Generator) -> Image:
    """What the camera sees of `leg`, with the sensor's noise."""
    north, east = leg(at_s)
    shift = np.array([[1.0, 0.0, -(200 + 5.0 * east)], [0.0, 1.0, -(60 + 5.0 * north)]])
    picture = cv2.warpAffine(ground, shift, (SHOT.width, SHOT.height)).astype(np.float64)
    noisy = picture + rng.normal(0.0, 2.0, picture.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


@contextmanager
def streamed() -> Iterator[Callable[[Image], Image | None]]:
    """Sends a picture and hands over what came out of it, if anything did."""
    url = f"udp://127.0.0.1:{free_port()}"
    with Watch(url, SHOT, stall_timeout_s=30.0) as watch:
        sender = VideoSender(url, SHOT.width, SHOT.height, HZ)

        def through(image: Image) -> Image | None:
            before = len(watch.frames)
            sender.send(image, time.monotonic_ns())
            if not before:  # it joins at a key frame
                time.sleep(0.02)
                return watch.frames[-1][0].image if watch.frames else None
            watch.wait_until(lambda: len(watch.frames) > before)
            return watch.frames[-1][0].image

        yield through
        sender.close()


@pytest.mark.parametrize(
    ("wrong", "told", "within_s"),
    [
        (lambda at_s: min(at_s, FAULT_S), AlertId.VIDEO_FROZEN, 1.0),
        (
            lambda at_s: at_s if at_s < FAULT_S else 10.0 + (at_s - 10.0) % 6.0,
            AlertId.VIDEO_REPEATS,
            4.0,
        ),
    ],
    ids=["frozen", "loop"],
)
def test_a_stream_that_does_not_show_the_present_is_told(ground, wrong, told, within_s):
    """At 10 m/s, the fixes as they should be: only the pictures can tell. Each is encoded anew,
    with fresh noise and a fresh stamp, as behind an encoder that goes on.
    """
    rng = np.random.default_rng(4)
    flight = Flight(monitor(), leg, noise_m=0.03)
    with streamed() as through:
        for k in range(round(21.0 * HZ)):
            at_s = k / HZ
            image = through(shown(ground, wrong(at_s), rng))
            if image is not None:
                flight.monitor.add_frame(second(at_s), image)
            flight.fly(at_s + 1.0 / HZ)
    assert FAULT_S < flight.told(told) <= FAULT_S + within_s
    assert not [fix for fix in flight.passed if fix.time_ns > second(FAULT_S + within_s + 0.2)]


def test_pictures_after_a_lost_one_are_not_given_in_h265(tmp_path: Path) -> None:
    """FFmpeg's decoder knows by the reference picture set that one is missing, and gives none until
    the next key frame.
    """
    period, count = 8, 40
    lost = 3 * period + 3
    with av.open(str(tmp_path / "lost.ts"), "w", format="mpegts") as out:
        stream = out.add_stream("libx265", rate=8)
        stream.width, stream.height, stream.pix_fmt = CAMERA.width, CAMERA.height, "yuv420p"
        keys = f"keyint={period}:min-keyint={period}:repeat-headers=1"
        x265 = f"{keys}:log-level=none:pools=1:frame-threads=1"
        stream.options = {"preset": "ultrafast", "tune": "zerolatency", "x265-params": x265}
        packets = []
        for n in range(count):
            picture = av.VideoFrame.from_ndarray(counter_image(n), format="rgb24")
            picture.pts, picture.time_base = n, Fraction(1, 8)
            packets += stream.encode(picture.reformat(format="yuv420p"))
        packets += stream.encode(None)
        assert len(packets) == count
        for n, packet in enumerate(packets):
            if n != lost:
                out.mux(packet)
    source = open_source(
        str(tmp_path / "lost.ts"), CAMERA, SourceSettings(), lambda *_: None, lambda _: None
    )
    numbers = [read_counter(frame.image) for frame in source.frames()]
    assert [n for n in numbers if 3 * period <= n < 4 * period] == [lost - 3, lost - 2, lost - 1]
    assert numbers[-1] >= count - 2
