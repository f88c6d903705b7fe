"""UDP loopback: what a real sender's stream becomes at the companion."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import av
import numpy as np
import pytest

from companion.errors import StreamDepthError, StreamOpenError, StreamSizeError
from companion.sources import FrameSource, StreamState, open_source
from localizer.geometry.camera import Camera
from localizer.types import Frame, Image
from mavlink_bridge.link.link import sleep_until
from sitl.camera.stream import LossyLink, VideoSender
from tests.companion.sources.paced_sender import (
    CAMERA,
    CELL,
    PacedSender,
    Watch,
    counter_image,
    free_port,
    read_counter,
)


@pytest.fixture
def url() -> str:
    return f"udp://127.0.0.1:{free_port()}"


@pytest.mark.parametrize("form", ["rtp", "rtp hevc", "h264", "sdp"])
def test_rtp_and_raw_video_are_received_as_transport_streams_are(form, url, tmp_path):
    """QGroundControl's "UDP h.264", PX4's Gazebo, OpenHD and WFB-ng send RTP."""
    port, source = url.rpartition(":")[2], url
    target = f"{url}?pkt_size=1400" if form == "h264" else f"rtp://127.0.0.1:{port}"
    if form == "sdp":
        source = str(tmp_path / "feed.sdp")
        Path(source).write_text(
            f"v=0\nc=IN IP4 127.0.0.1\nm=video {port} RTP/AVP 96\na=rtpmap:96 H264/90000\n"
        )
    with (
        Watch(source) as watch,
        av.open(target, "w", format="h264" if form == "h264" else "rtp") as out,
    ):
        coder = "x265" if form == "rtp hevc" else "x264"
        stream = out.add_stream(f"lib{coder}", rate=20)
        stream.width, stream.height, stream.pix_fmt = CAMERA.width, CAMERA.height, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 90_000)
        more = ":keyint=10:log-level=none" if coder == "x265" else ""
        stream.options = {"preset": "ultrafast", "tune": "zerolatency", "g": "10",
                          f"{coder}-params": f"repeat-headers=1{more}"}  # fmt: skip
        sent = []
        for number in range(600):
            picture = av.VideoFrame.from_ndarray(counter_image(number), format="rgb24")
            sent.append(time.monotonic_ns())
            picture.pts = (sent[-1] - sent[0]) * 9 // 100_000
            picture.time_base = Fraction(1, 90_000)
            out.mux(stream.encode(picture))
            watch.shows(number, 0.05)
            if len(watch.frames) >= 8:
                break
    assert watch.error is None
    assert len(watch.frames) >= 8
    numbers = [read_counter(f.image) for f, _ in watch.frames]
    assert numbers == sorted(numbers)
    if form != "h264":  # RTP's times, not those of arrival
        lags = [
            f.exposure_time_ns - sent[n] for (f, _), n in zip(watch.frames, numbers, strict=True)
        ]
        assert np.diff(lags).max() < 0.1e6  # the smallest lag so far


def test_a_stream_that_is_not_read_is_never_told_as_silence(url, monkeypatch):
    monkeypatch.setattr("companion.sources.av_source._OPEN_TIMEOUT_S", 0.2)
    with Watch(url) as watch, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        mavlink = bytes.fromhex("fd09000001010000000000000000000403")
        watch.wait_until(lambda: StreamState.STALLED in watch.states)  # nothing came yet

        def is_told() -> bool:
            return any("MAVLink" in text for _, text in watch.told)

        while not watch.comes_true(is_told, 0.02):
            sender.sendto(mavlink, ("127.0.0.1", int(url.rpartition(":")[2])))


def test_pictures_of_a_second_sender_are_not_mixed_in(url: str) -> None:
    """Both streams decode well: before there was a rule, 41 of 117 pictures were the stranger's."""
    with Watch(url) as watch, PacedSender(url):
        watch.wait_for(3)
        with PacedSender(f"{url}?localaddr=127.0.0.2", first=500):
            watch.wait_until(lambda: watch.source.counters.foreign >= 50)
        before = len(watch.frames)
        watch.wait_for(before + 3)
    assert max(read_counter(frame.image) for frame, _ in watch.frames) < 500
    assert watch.strangers == ["127.0.0.2"]


def test_a_stream_of_another_shape_is_an_error_that_names_both(url: str) -> None:
    with Watch(url, camera=Camera.from_fov(640, 360, 70.0)) as watch, PacedSender(url):
        watch.wait_until(lambda: watch.error is not None)
    assert isinstance(watch.error, StreamSizeError)
    for text in ("320x240", "640x360", url):
        assert text in str(watch.error)
    assert watch.states[-2:] == [StreamState.FAILED, StreamState.CLOSED]


def test_a_stream_that_stops_or_changes_in_flight_is_told_and_taken_up_again(url: str) -> None:
    """Half the size goes on with the scaled camera; another shape gives no frame."""
    half, wide = CAMERA.resized(160, 120), Camera.from_fov(320, 180, 70.0)
    with Watch(url, stall_timeout_s=0.4, retry_max_s=0.5) as watch:
        with PacedSender(url):
            watch.wait_for(5)
        watch.wait_until(lambda: watch.states[-1] is StreamState.STALLED)
        assert watch.frames[0][0].camera == CAMERA
        with PacedSender(url, camera=half):
            watch.wait_until(lambda: watch.states[-1] is StreamState.SCALED)
            watch.wait_until(lambda: watch.frames[-1][0].camera == half)
        assert watch.frames[-1][0].image.shape == (120, 160, 3)
        with PacedSender(url, camera=wide):
            watch.wait_until(lambda: watch.states[-1] is StreamState.MISFIT)
        for state, *texts in (
            (StreamState.STALLED, url), (StreamState.SCALED, "160x120", "320x240"),
            (StreamState.MISFIT, "320x180", "320x240"),
        ):  # fmt: skip
            assert all(text in watch.text(state) for text in texts)
        fitting = len(watch.frames)
        with PacedSender(url, first=500) as last:
            watch.wait_until(lambda: watch.states[-1] is StreamState.LIVE)
            watch.wait_for(len(watch.frames) + 3)
    assert watch.error is None
    assert watch.states[-1] is StreamState.CLOSED
    assert watch.source.counters.reconnects >= 1
    assert watch.source.counters.misfits > 0
    assert {f.camera for f, _ in watch.frames} == {CAMERA, half}
    for frame, _ in watch.frames[fitting:]:  # by its own stamps, not by the first one's clock
        assert frame.image.shape == (240, 320, 3)
        assert abs(frame.exposure_time_ns - last.exposed[read_counter(frame.image)]) < 0.5e6


def test_closing_ends_the_iteration_before_any_frame_came(url: str) -> None:
    with Watch(url, stall_timeout_s=0.3) as watch:
        watch.wait_until(lambda: bool(watch.states))
    assert watch.frames == []
    assert watch.error is None
    assert watch.states[-1] is StreamState.CLOSED


def test_closing_waits_for_a_reader_that_is_just_being_started(url, monkeypatch):
    """The feed's first line and the order to stop come from two threads."""

    def decoder(*_: Any) -> None:
        raise ValueError("nothing comes")

    monkeypatch.setattr("companion.sources.av_source.VideoDecoder", decoder)
    source = open_source(url, CAMERA)
    begun, go_on = threading.Event(), threading.Event()
    start = threading.Thread.start

    def slow_start(thread: threading.Thread) -> None:
        if thread.name == "video":
            begun.set()
            go_on.wait(30.0)
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", slow_start)
    feed = threading.Thread(target=lambda: list(source.frames()))
    feed.start()
    assert begun.wait(30.0)
    errors: list[Exception] = []

    def close() -> None:
        try:
            source.close()
        except Exception as error:
            errors.append(error)

    closing = threading.Thread(target=close)
    closing.start()
    closing.join(0.3)  # as far as it comes
    go_on.set()
    for thread in (closing, feed):
        thread.join(60.0)
        assert not thread.is_alive()
    assert errors == []
    assert "video" not in {thread.name for thread in threading.enumerate()}


def test_a_port_in_use_is_reported_and_kept_trying(url: str) -> None:
    port = int(url.rsplit(":", 1)[1])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as holder:
        holder.bind(("127.0.0.1", port))
        with Watch(url, retry_max_s=0.3) as watch:
            watch.wait_until(lambda: StreamState.STALLED in watch.states)
            assert "in use" in watch.text(StreamState.STALLED)
            holder.close()
            with PacedSender(url):
                watch.wait_for(3)


@pytest.mark.parametrize(
    ("location", "why"),
    [
        ("/dev/video97", r"/dev/video97.*plugged in"),
        ("udp://127.0.0.1", "HOST:PORT"),
        ("udp://127.0.0.1:99999", "HOST:PORT"),
        ("udp://127.0.0.1:x", "HOST:PORT"),
    ],
)
def test_a_feed_that_cannot_be_is_named(location, why):
    with pytest.raises(StreamOpenError, match=why):
        open_source(location, CAMERA)


def test_an_unexpected_error_in_the_reader_is_a_stall_and_tried_again(url, monkeypatch):
    """The reader's thread is the only one that can bring the video back."""

    def decoder(*_: Any) -> None:
        raise ValueError("no such enumeration value")

    monkeypatch.setattr("companion.sources.av_source.VideoDecoder", decoder)
    with Watch(url, retry_max_s=0.3) as watch:
        watch.wait_until(lambda: StreamState.STALLED in watch.states)
        assert "unexpected ValueError" in watch.text(StreamState.STALLED)
        monkeypatch.undo()
        with PacedSender(url):
            watch.wait_for(3)
    assert watch.error is None


class _Decoder:
    """Pictures of these kinds of pixels, in turn, each once the one before was taken."""

    kinds: ClassVar[list[str]] = []
    taken: ClassVar[list[threading.Event]] = []
    late = 0

    def __init__(self, *_: Any) -> None:
        pass

    def pictures(self) -> Iterator[tuple[av.VideoFrame, int]]:
        for kind, taken in zip(self.kinds, self.taken, strict=True):
            yield av.VideoFrame(CAMERA.width, CAMERA.height, kind), time.monotonic_ns()
            taken.wait(30.0)

    def close(self) -> None:
        pass


def test_pixels_that_cannot_be_converted_do_not_end_the_feed_in_flight(url, monkeypatch):
    """FFmpeg's error left `frames` and ended the flight; one kind ends even the process."""
    monkeypatch.setattr("companion.sources.av_source.VideoDecoder", _Decoder)
    _Decoder.kinds = ["yuv420p", "y210be", "y210be", "yaf32le", "yuv420p"]
    _Decoder.taken = [threading.Event() for _ in _Decoder.kinds]
    source = open_source(url, CAMERA)
    frames = source.frames()
    first = next(frames)
    assert first.image.shape == (CAMERA.height, CAMERA.width, 3)
    _Decoder.taken[0].set()
    found: list[Frame] = []
    feed = threading.Thread(target=lambda: found.append(next(frames)), daemon=True)
    feed.start()
    while not source.counters.misfits:
        assert feed.is_alive()
        feed.join(0.01)
    for taken in _Decoder.taken:
        taken.set()
    feed.join(60.0)
    assert [frame.sequence for frame in found] > [first.sequence]
    source.close()


def test_pixels_that_cannot_be_converted_are_named_at_the_start(url, monkeypatch):
    monkeypatch.setattr("companion.sources.av_source.VideoDecoder", _Decoder)
    for kind in ("y210be", "yaf32le"):
        _Decoder.kinds, _Decoder.taken = [kind], [threading.Event()]
        source = open_source(url, CAMERA)
        with pytest.raises(StreamDepthError, match=f"{kind}, a kind of pixels"):
            next(source.frames())
        _Decoder.taken[0].set()
        source.close()


_TS_PACKET = 188
RATE_HZ = 8


class _HoledLink:
    """A link that loses whole pictures, or a transport packet in their middle, while `lost`."""

    def __init__(self, url: str, *, whole: bool) -> None:
        self.lost = False
        self._whole = whole
        self._link = LossyLink(url, 0.0)

    def write(self, data: bytes) -> int:
        if not self.lost:
            return self._link.write(data)
        if not self._whole:
            middle = len(data) // _TS_PACKET // 2 * _TS_PACKET
            self._link.write(data[:middle] + data[middle + _TS_PACKET :])
        return len(data)


def _rough_image(number: int) -> Image:
    """A counter image over grain that moves, so that a picture fills many packets."""
    image = counter_image(number)
    rows = CAMERA.height - 2 * CELL
    grain = np.random.default_rng(number).integers(0, 120, (rows // 4, CAMERA.width // 4))
    image[2 * CELL :] = np.kron(grain, np.ones((4, 4)))[..., None].astype(np.uint8)
    return image


class Steps:
    """A sender of pictures, each when the test says so; sent: when each was exposed."""

    def __init__(self, url: str, **options: Any) -> None:
        self.sent: dict[int, int] = {}
        self._sender = VideoSender(url, CAMERA.width, CAMERA.height, RATE_HZ, **options)

    def send(self, number: int) -> None:
        self.sent[number] = time.monotonic_ns()
        self._sender.send(_rough_image(number), self.sent[number])

    def join(self, watch: Watch) -> int:
        """Send until pictures come, which begin at a key frame; the number of the next one."""
        number = 0
        while not watch.frames:
            self.send(number)
            watch.shows(number, 0.02)
            number += 1
        return number + (-number) % RATE_HZ


@pytest.mark.parametrize("whole", [True, False], ids=["whole", "a part"])
def test_each_picture_comes_at_once_but_those_after_a_lost_one(url: str, whole: bool) -> None:
    """With the time of its exposure, and before the next one is sent."""
    link = _HoledLink(url, whole=whole)
    with Watch(url, stall_timeout_s=5.0) as watch:
        sender = Steps(url, link=link)
        joined = sender.join(watch)
        lost = joined + 3
        for n in range(max(sender.sent) + 1, joined + 2 * RATE_HZ):
            link.lost = n == lost
            sender.send(n)
            assert lost <= n < joined + RATE_HZ or watch.shows(n, 60.0)
    numbers = [read_counter(frame.image) for frame, _ in watch.frames]
    between = [n for n in numbers if joined <= n < joined + RATE_HZ]
    assert between == [joined, joined + 1, joined + 2]
    assert watch.source.counters.undecodable >= RATE_HZ - 4
    for frame, _ in watch.frames:
        assert abs(frame.exposure_time_ns - sender.sent[read_counter(frame.image)]) < 0.1e6
    counters, sequences = watch.source.counters, [f.sequence for f, _ in watch.frames]
    assert counters.received == counters.delivered + counters.dropped
    assert counters.delivered == len(sequences)
    assert sequences == sorted(set(sequences))


def test_by_presentation_times_an_exposure_is_the_arrival_less_what_was_measured(url):
    options = {"timing": "pts", "latency_ms": 300, "time_offset_ms": -20, "stall_timeout_s": 5.0}
    with Watch(url, **options) as watch:
        sender = Steps(url, misp=False)
        begun = sender.join(watch)
        for n in range(max(sender.sent) + 1, begun + RATE_HZ):
            sender.send(n)
            assert watch.shows(n, 60.0)
    lags = []
    for frame, seen_ns in watch.frames:
        sent_ns = sender.sent[read_counter(frame.image)]
        lags.append(frame.exposure_time_ns + 280e6 - sent_ns)  # the smallest lag so far
        assert -0.1e6 < lags[-1] < seen_ns - sent_ns
    assert np.diff(lags).max() < 0.1e6


def test_a_consumer_that_is_slow_gets_the_newest_frame_and_the_rest_are_counted(url):
    sender, source = Steps(url), open_source(url, CAMERA)
    frames, taken = source.frames(), []
    feed = threading.Thread(target=lambda: taken.append(next(frames)))
    feed.start()
    number = 0
    while feed.is_alive():
        sender.send(number)
        number += 1
        feed.join(0.02)
    for n in range(number, number + 5):
        received = source.counters.received
        sender.send(n)
        assert sleep_until(partial(_received_beyond, source, received), 60.0)
    newest, counters = next(frames), source.counters
    source.close()
    assert newest.sequence >= taken[0].sequence + 5
    assert counters.dropped == newest.sequence - taken[0].sequence - 1
    assert counters.delivered == 2


def _received_beyond(source: FrameSource, count: int) -> bool:
    return source.counters.received > count
