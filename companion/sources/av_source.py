"""Video through PyAV: files, UDP MPEG-TS, RTSP and V4L2 devices."""

from __future__ import annotations

import logging
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from av.video.frame import PictureType

from companion.errors import (
    StreamDecodeError,
    StreamDepthError,
    StreamError,
    StreamOpenError,
    StreamSizeError,
    redacted,
)
from companion.sources.base import (
    GREY_RANGE_ADVICE,
    FrameSource,
    PacketTap,
    SourceCounters,
    SourceSettings,
    StateCallback,
    StreamState,
    fitted_camera,
    has_times,
    video_stream,
)
from companion.sources.datagrams import (
    SenderLock,
    SilentSenderError,
    UdpAddress,
    VideoDatagrams,
)
from companion.sources.references import DamageTracker, ReferenceTracker
from companion.sources.rtp import SdpSession
from companion.sources.timing import ExposureClock, misp_time
from localizer.geometry.camera import Camera
from localizer.pictures import GreyRange, grey_levels
from localizer.tracking.mailbox import Mailbox
from localizer.types import Frame, Image

_log = logging.getLogger(__name__)

_RETRY_FIRST_S = 0.25
_OPEN_TIMEOUT_S = 3.0  # a joining receiver has to see one key frame with its headers
_UNCONVERTED = (
    ", a kind of pixels that cannot be converted; have the camera or a converter send 8 bits a "
    "channel"
)
_ABORTING = {f"yaf{bits}{end}" for bits in (16, 32) for end in ("le", "be")}  # the process, too
# Without noparse FFmpeg's H.264 parser holds each picture until the next one begins: one frame
# period. MPEG-TS carries one picture per PES packet, so the parser is not needed.
_TRANSPORT = {"fflags": "nobuffer+noparse+nofillin"}
_LOW_DELAY = 0x80000  # AV_CODEC_FLAG_LOW_DELAY: hand a picture out at once, not in display order


@dataclass(frozen=True)
class _Input:
    """How FFmpeg opens a location."""

    url: str
    options: dict[str, str]
    format: str | None = None
    device: bool = False
    datagrams: VideoDatagrams | None = None
    """What is read instead of `url`, where the receiving is ours."""


class VideoDecoder:
    """Decodes one open container, single-threaded, because FFmpeg's frame threads add a frame of
    delay each. read_timeout_s: longest wait for data of a live stream; None for a file.
    """

    def __init__(
        self, source: _Input, read_timeout_s: float | None, taps: Sequence[PacketTap] = ()
    ) -> None:
        self._taps = taps
        timeout = None if read_timeout_s is None else (_OPEN_TIMEOUT_S, read_timeout_s)
        form, options = source.format, source.options
        if source.datagrams is not None:
            source.datagrams.begin(_OPEN_TIMEOUT_S)
            form = source.datagrams.format()
            options = options | (_TRANSPORT if form == "mpegts" else {})
        self._container = av.open(
            source.datagrams or source.url, format=form, options=options, timeout=timeout
        )
        if source.datagrams is not None and read_timeout_s is not None:
            source.datagrams.patience_s = read_timeout_s
        try:
            self.stream = video_stream(self._container, source.url)
        except StreamOpenError:
            self._container.close()
            raise
        self.has_times = has_times(self._container)
        self.late = 0  # pictures that packets before theirs held back (B-frames)
        context = self.stream.codec_context
        live = read_timeout_s is not None
        h264 = context.name == "h264" and live
        self._damage = DamageTracker() if live else None
        self._references = ReferenceTracker(bytes(context.extradata or b"")) if h264 else None
        context.thread_count = 1
        if read_timeout_s is not None:
            context.flags |= _LOW_DELAY
        for tap in taps:
            tap.begin(self.stream)

    def pictures(self) -> Iterator[tuple[av.VideoFrame | None, int]]:
        """Yield (frame or None, arrival time); None: a packet gave no intact frame. CLOCK_MONOTONIC
        ns.
        """
        for packet in self._container.demux(self.stream):
            arrival_ns = time.monotonic_ns()
            try:
                pictures = packet.decode()
            except av.error.InvalidDataError:
                pictures = []
                if self._damage is not None:
                    self._damage.add_undecodable(arrival_ns)
            for tap in self._taps if packet.size else ():
                tap.packet(packet)
            late = self._is_predicted_from_lost(packet, arrival_ns)  # each packet: it counts them
            whole = [p for p in pictures if not self._is_damaged(p, arrival_ns) and not late]
            self.late += max(0, len(whole) - (1 if packet.size else 0))
            for picture in whole:
                yield picture, arrival_ns
            if not whole and packet.size:
                yield None, arrival_ns

    def _is_damaged(self, picture: av.VideoFrame, arrival_ns: int) -> bool:
        if self._damage is None:
            return bool(picture.is_corrupt)
        clean = bool(picture.key_frame) or picture.pict_type == PictureType.I
        return self._damage.is_damaged(arrival_ns, marked=bool(picture.is_corrupt), clean=clean)

    def _is_predicted_from_lost(self, packet: av.Packet, arrival_ns: int) -> bool:
        follows = self._references
        return follows is not None and follows.is_broken(bytes(packet), arrival_ns)

    def close(self) -> None:
        """Close the container."""
        self._container.close()


class VideoFileSource(FrameSource):
    """Every frame of a video file. Exposure time: start of `frames` plus time since the first
    frame.
    """

    def __init__(
        self,
        path: Path,
        camera: Camera,
        settings: SourceSettings | None = None,
        on_state: StateCallback | None = None,
        *taps: PacketTap,
    ) -> None:
        if not path.is_file():
            raise StreamOpenError(f"{path}: no such video file")
        super().__init__(camera, settings, on_state)
        self._path = path
        self._taps = taps
        self._closed = threading.Event()
        self._rgb = _ToRgb(self._settings.grey_range)
        self._rate_hz: float | None = None  # of a file without times

    def frames(self) -> Iterator[Frame]:
        """Every frame, with `realtime` at the times recorded. `StreamOpenError` for no video,
        `StreamDecodeError` if no frame decodes; `StreamSizeError` and `StreamDepthError` for frames
        that do not fit.
        """
        try:
            decoder = VideoDecoder(_Input(str(self._path), {}), None, self._taps)
        except av.error.FFmpegError as error:
            raise StreamOpenError(
                f"{self._path}: not a video, or damaged from the start: {error}"
            ) from error
        self._report(StreamState.LIVE, f"{self._path}: {self._settle_rate(decoder)}")
        try:
            yield from self._play(decoder)
        except StreamError as error:
            self._report(StreamState.FAILED, str(error))
            raise
        finally:
            decoder.close()

    def close(self) -> None:
        """End `frames` after the present frame."""
        self._closed.set()
        self._report(StreamState.CLOSED, f"{self._path}: closed")

    def _play(self, decoder: VideoDecoder) -> Iterator[Frame]:
        start = time.monotonic_ns()
        first: int | None = None
        for picture in self._readable(decoder):
            camera = self._rgb.camera(picture, self._camera, str(self._path))
            self._report_scaling(camera, str(self._path))
            pts = self._pts_ns(picture, decoder)
            first = pts if first is None else first
            offset = pts - first
            if self._settings.realtime:
                self._closed.wait((start + offset - time.monotonic_ns()) / 1e9)
            if self._closed.is_set():
                return
            image, n = self._rgb(picture, str(self._path)), self._counters.delivered
            frame = Frame(image, start + offset, camera, n)
            self._count(received=1, delivered=1)
            _pass_exposure_time(self._taps, picture, frame.exposure_time_ns)
            yield frame
        if not self._counters.delivered:
            raise StreamDecodeError(f"{self._path}: no frame in it can be decoded; replace it")
        self._count(undecodable=-min(decoder.late, self._counters.undecodable))
        lost = self._counters.undecodable
        text = f"{self._path}: end of file, {self._counters.delivered} frames"
        self._report(StreamState.ENDED, text + (f", {lost} undecodable" if lost else ""))

    def _settle_rate(self, decoder: VideoDecoder) -> str:
        """Set the frame rate of a file without times (raw H.264); returns a text that names it."""
        if decoder.has_times:
            return "playing"
        stated = float(decoder.stream.codec_context.framerate or 0.0)
        given = "rate_hz" in self._settings.model_fields_set or not stated
        self._rate_hz = self._settings.rate_hz if given else stated
        by = "by camera.settings.rate_hz" if given else "as its headers say"
        text = f"has no times in it: {self._rate_hz:g} frames a second, {by}"
        _log.warning("%s: %s", self._path, text)
        return text

    def _readable(self, decoder: VideoDecoder) -> Iterator[av.VideoFrame]:
        try:
            for picture, _ in decoder.pictures():
                if picture is None:
                    self._count(undecodable=1)
                else:
                    yield picture
        except av.error.FFmpegError as error:
            # A damaged rest ends the file as its end would: what was before it is still good.
            self._count(undecodable=1)
            n = self._counters.delivered
            _log.warning("%s: damaged after %d frames: %s", self._path, n, error)

    def _pts_ns(self, picture: av.VideoFrame, decoder: VideoDecoder) -> int:
        stamp = _pts_ns(picture)
        if stamp is not None and self._rate_hz is None:
            return stamp
        rate = self._rate_hz or float(decoder.stream.average_rate or self._settings.rate_hz)
        return round(self._counters.delivered * 1e9 / rate)


class LiveVideoSource(FrameSource):
    """Decodes a live stream in a reader thread, which keeps only the newest frame. If the stream
    stops, the state becomes STALLED and the reader connects again, with longer waits after
    failures.

    Above 200 lines: the reader's thread and the thread that takes frames share one state.
    """

    def __init__(
        self,
        location: str,
        camera: Camera,
        settings: SourceSettings | None = None,
        on_state: StateCallback | None = None,
        on_stranger: Callable[[str], None] | None = None,
        *taps: PacketTap,
    ) -> None:
        super().__init__(camera, settings, on_state)
        self._taps, self._on_stranger = taps, on_stranger
        self._location = redacted(location)
        self._input = live_input(location, camera, self._settings, self._stranger)
        self._newest: Mailbox[tuple[av.VideoFrame, Camera, int, int]] = Mailbox()
        self._closing = threading.Event()
        self._reader: threading.Thread | None = None
        self._last_picture_ns = 0
        self._rgb = _ToRgb(self._settings.grey_range)

    @property
    def counters(self) -> SourceCounters:
        """Counters; `dropped` are frames replaced by a newer one."""
        with self._lock:
            datagrams = self._input.datagrams
            foreign = 0 if datagrams is None else datagrams.foreign
            return replace(self._counters, dropped=self._newest.dropped, foreign=foreign)

    def frames(self) -> Iterator[Frame]:
        """Start the reader, wait for the newest frame and yield it; ends only when closed.
        Raises `StreamSizeError` if the first frame has another aspect ratio than the camera model,
        `StreamDepthError` if its pixels cannot be converted. Later frames of this kind are skipped,
        with state MISFIT until a frame fits.
        """
        self._start()
        while (item := self._newest.take()) is not None:
            picture, camera, exposure_ns, sequence = item
            # Converted here and not in the reader: pictures that are dropped cost no conversion.
            try:
                image = self._rgb(picture, self._location)
            except StreamDepthError:  # another kind, which in flight must not end the feed
                if not self._counters.delivered:
                    raise
                self._count(misfits=1)  # the reader refuses and reports the next of its kind
                continue
            self._count(delivered=1)
            yield Frame(image, exposure_ns, camera, sequence)

    def close(self) -> None:
        """End `frames`; waits for the reader, at most about two open timeouts.

        Opening and probing in FFmpeg take one timeout each. If the interpreter ended during them,
        FFmpeg's callback into it would cause a segmentation fault.
        """
        with self._lock:  # a reader that is being started is started
            self._closing.set()
            reader = self._reader
        self._newest.close()
        datagrams = self._input.datagrams
        if datagrams is not None:
            datagrams.close()
        if reader is not None and reader is not threading.current_thread():
            reader.join(2 * _OPEN_TIMEOUT_S + self._settings.stall_timeout_s + 2.0)
        if self._state is not StreamState.CLOSED:
            self._report(StreamState.CLOSED, f"{self._location}: closed")

    def _start(self) -> None:
        with self._lock:
            if self._reader is None and not self._closing.is_set():
                self._reader = threading.Thread(target=self._run, name="video", daemon=True)
                self._reader.start()

    def _run(self) -> None:
        try:
            self._receive()
        finally:
            if self._input.datagrams is not None:
                self._input.datagrams.release()

    def _receive(self) -> None:
        wait_s = _RETRY_FIRST_S
        connections = 0
        told_instead = False  # what comes and is not read
        while not self._closing.is_set():
            if self._state is not StreamState.STALLED:
                self._report(StreamState.CONNECTING, f"{self._location}: connecting")
            received = self._counters.received
            try:
                reason = self._receive_once(reconnect=connections > 0)
                connections += 1
            except StreamError as error:
                self._report(StreamState.FAILED, str(error))
                self._newest.close(error.with_text(redacted(str(error))))
                return
            except av.error.ExitError:  # the open time-out
                reason = _nothing_came()
            except SilentSenderError as error:
                reason = error.instead or _nothing_came()
                if error.instead and not told_instead:  # though it is stalled already
                    told_instead = True
                    self._report(StreamState.STALLED, f"{self._location}: {reason}")
            except (av.error.FFmpegError, OSError) as error:
                reason = f"cannot connect: {error}"
            except Exception as error:  # whatever a stream may contain, the next try may be well
                trace = redacted(traceback.format_exc())
                _log.error("%s: unexpected error\n%s", self._location, trace)
                reason = f"unexpected {type(error).__name__}: {error}"
            if self._closing.is_set():
                return
            wait_s = _RETRY_FIRST_S if self._counters.received > received else wait_s
            self._report_stall(f"{reason}; trying again every {wait_s:.2g} s")
            self._closing.wait(wait_s)
            wait_s = min(2 * wait_s, self._settings.retry_max_s)

    def _receive_once(self, *, reconnect: bool) -> str:
        """Receive until the connection ends; returns the reason for the operator."""
        decoder = VideoDecoder(self._input, self._settings.stall_timeout_s, self._taps)
        if reconnect:
            self._count(reconnects=1)
        clock = ExposureClock(
            round(self._settings.latency_ms * 1e6),
            self._settings.timing,
            device=self._input.device,
        )
        self._last_picture_ns = time.monotonic_ns()
        try:
            for picture, arrival_ns in decoder.pictures():
                if self._closing.is_set():
                    return "closed"
                self._process_frame(picture, arrival_ns, clock)
            return "the sender ended the stream"
        except av.error.ExitError:  # the read time-out
            return f"no data for {self._settings.stall_timeout_s:g} s"
        except SilentSenderError as error:
            return str(error)
        except av.error.FFmpegError as error:
            return f"the stream broke off: {error}"
        finally:
            decoder.close()

    def _process_frame(
        self, picture: av.VideoFrame | None, arrival_ns: int, clock: ExposureClock
    ) -> None:
        if picture is None:
            self._count(undecodable=1)
            # A receiver that has just joined waits for a key frame: no stall yet.
            live = self._state in (StreamState.LIVE, StreamState.SCALED)
            patience_s = self._settings.stall_timeout_s if live else _OPEN_TIMEOUT_S
            if arrival_ns - self._last_picture_ns > patience_s * 1e9:
                self._report_stall("data arrives but no frame can be decoded (no key frame yet?)")
            return
        self._last_picture_ns = arrival_ns
        if self._input.datagrams is not None:
            self._input.datagrams.confirm_sender()
        camera = self._fitted(picture)
        if camera is None:
            return
        exposure_ns = clock.exposure_time(_pts_ns(picture), misp_time(picture), arrival_ns)
        exposure_ns -= self._settings.late_ns
        _pass_exposure_time(self._taps, picture, exposure_ns)
        if not self._newest.put((picture, camera, exposure_ns, self._counters.received)):
            return  # closed meanwhile
        self._count(received=1)
        if camera is self._camera:
            size = f"{camera.width}x{camera.height}"
            self._report_change(StreamState.LIVE, f"{self._location}: live, {size}")
        self._report_scaling(camera, self._location)

    def _fitted(self, picture: av.VideoFrame) -> Camera | None:
        """Camera model of the frame's size; None if it does not fit, but before any frame the
        error.
        """
        try:
            return self._rgb.camera(picture, self._camera, self._location)
        except (StreamSizeError, StreamDepthError) as error:
            if not self._counters.received:
                raise
            self._count(misfits=1)
            self._report_change(StreamState.MISFIT, str(error))
            return None

    def _stranger(self, host: str) -> None:
        _log.warning("%s: video of another sender ignored: %s", self._location, host)
        if self._on_stranger is not None:
            self._on_stranger(host)

    def _report_stall(self, reason: str) -> None:
        self._report_change(StreamState.STALLED, f"{self._location}: {reason}")

    def _report(self, state: StreamState, text: str) -> None:
        super()._report(state, redacted(text))  # FFmpeg's own errors name the whole address


def _nothing_came() -> str:
    return f"nothing came within {_OPEN_TIMEOUT_S:g} s; is the camera sending there?"


def live_input(
    location: str,
    camera: Camera,
    settings: SourceSettings,
    on_stranger: Callable[[str], None] = lambda _: None,
) -> _Input:
    """How FFmpeg opens a live location, with options for low delay; opens nothing. camera: gives
    the image size that a V4L2 device is set to. on_stranger: as of `open_source`. `StreamOpenError`
    for a wrong location or .sdp file, and if the video device does not exist.
    """
    timeout_us = str(round(settings.stall_timeout_s * 1e6))
    common = {"probesize": "65536", "analyzeduration": "200000", "flags": "low_delay"}
    if location.startswith(("udp://", "rtp://")) or location.endswith(".sdp"):
        lock = SenderLock(settings.sender, round(settings.stall_timeout_s * 1e9))
        sets = b""
        if location.endswith(".sdp"):
            session = SdpSession.read(Path(location))
            address, sets = UdpAddress(session.host, session.port), session.sets
        else:
            address = UdpAddress.parse(location)
        datagrams = VideoDatagrams(address, lock, on_stranger, sets)
        return _Input(location, common | {"fflags": "nobuffer"}, datagrams=datagrams)
    if location.startswith("rtsp://"):
        # TCP first; some servers refuse it (461) and send over UDP only.
        transport = {"rtsp_transport": "udp+tcp", "rtsp_flags": "prefer_tcp"}
        rtsp = {"fflags": "nobuffer", "timeout": timeout_us} | transport
        return _Input(location, common | rtsp)
    device = Path(location.removeprefix("v4l2://"))
    if not device.exists():
        raise StreamOpenError(
            f"{device}: no such video device; is the camera plugged in (v4l2-ctl --list-devices)?"
        )
    size = {"video_size": f"{camera.width}x{camera.height}", "fflags": "nobuffer"}
    return _Input(str(device), size, format="v4l2", device=True)


class _ToRgb:
    """Converts frames to RGB (H, W, 3) uint8. grey_range: as in `SourceSettings`."""

    def __init__(self, grey_range: GreyRange | None) -> None:
        self._grey_range = grey_range
        self._reformatter = av.video.reformatter.VideoReformatter()
        self._unknown = set(_ABORTING)  # kinds of pixels

    def __call__(self, picture: av.VideoFrame, where: str) -> Image:
        """Convert; where: for the error. `StreamDepthError` for pixels that cannot be converted."""
        try:
            if _is_counts(picture):
                counts = self._reformatter.reformat(picture, format="gray16le").to_ndarray()
                return np.asarray(
                    cv2.cvtColor(grey_levels(counts, self._grey_range), cv2.COLOR_GRAY2RGB),
                    np.uint8,
                )
            return np.ascontiguousarray(
                self._reformatter.reformat(picture, format="rgb24").to_ndarray()
            )
        except (av.error.FFmpegError, OSError, ValueError) as error:
            self._unknown.add(picture.format.name)
            raise StreamDepthError(f"{where}: {picture.format.name}{_UNCONVERTED}") from error

    def camera(self, picture: av.VideoFrame, camera: Camera, where: str) -> Camera:
        """Camera model of the frame, as `fitted_camera`. `StreamDepthError` for 16-bit grey without
        a range, and for a pixel format that could not be converted before.
        """
        if picture.format.name in self._unknown:
            raise StreamDepthError(f"{where}: {picture.format.name}{_UNCONVERTED}")
        if self._grey_range is None and _is_counts(picture):
            raise StreamDepthError(
                f"{where}: {picture.format.name}, 16-bit grey without a range; {GREY_RANGE_ADVICE}"
            )
        return fitted_camera(picture.width, picture.height, camera, where)


def _is_counts(picture: av.VideoFrame) -> bool:
    """Whether the frame holds a sensor's 16-bit counts. Grey of 9 to 14 bits comes from a codec
    (H.264, H.265), whose white level is known.
    """
    parts = picture.format.components
    return len(parts) == 1 and bool(parts[0].is_luma) and parts[0].bits == 16


def _pts_ns(picture: av.VideoFrame) -> int | None:
    if picture.pts is None or picture.time_base is None:
        return None
    time_ns: int = round(picture.pts * picture.time_base * 1_000_000_000)
    return time_ns


def _pass_exposure_time(
    taps: Sequence[PacketTap], picture: av.VideoFrame, exposure_ns: int
) -> None:
    for tap in taps:
        if picture.pts is not None and picture.time_base is not None:
            tap.frame_exposed(Fraction(picture.pts * picture.time_base), exposure_ns)
