"""Interface of all camera feeds."""

from __future__ import annotations

import logging
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from fractions import Fraction
from typing import Annotated, Protocol

import av
from av.format import Flags
from av.stream import Disposition
from pydantic import Field, field_validator

from companion.errors import StreamOpenError, StreamSizeError
from companion.sources.datagrams import parse_sender
from companion.sources.timing import Timing
from localizer.errors import CameraError
from localizer.geometry.camera import Camera
from localizer.pictures import GreyRange
from localizer.types import Frame
from mavlink_bridge.config import StrictModel

_log = logging.getLogger(__name__)
_LEAST_SHARE = 10  # a film has at least a tenth of the pictures of the longest: thumbnails have few

# What is said of 16-bit grey pictures without a range.
GREY_RANGE_ADVICE = (
    "set camera.settings.grey_range: [black, white] where a deployment reads them, or let the "
    "camera or a converter write 8 bits"
)

# Relative difference of width / height that rounding to even sizes makes; 1080 padded to 1088
# lines (0.7 %) lies outside.
_SHAPE_TOLERANCE = 0.005


class StreamState(Enum):
    """State of a feed; `SourceSettings` says when a live one is stalled.

    SCALED: the frames have another size than the calibration but the same aspect ratio, and are
    used. MISFIT: they have another aspect ratio, and are not used.
    """

    IDLE = "not started"
    CONNECTING = "connecting"
    LIVE = "live"
    SCALED = "live, scaled"
    MISFIT = "of another shape"
    STALLED = "stalled"
    ENDED = "ended"
    FAILED = "failed"
    CLOSED = "closed"


StateCallback = Callable[[StreamState, str], None]


@dataclass(frozen=True)
class SourceCounters:
    """Frame counters of a source. received: decoded frames that can be used; delivered: passed on
    by `frames`; dropped: replaced by a newer frame before they were delivered; undecodable: packets
    without a complete frame, or with one predicted from a lost frame
    (`companion.sources.references`); misfits: frames with another aspect ratio than the
    calibration, or with pixels that cannot be converted; reconnects: connections after the first;
    foreign: datagrams of other senders, which are ignored.
    """

    received: int = 0
    delivered: int = 0
    dropped: int = 0
    undecodable: int = 0
    misfits: int = 0
    reconnects: int = 0
    foreign: int = 0


Count = Annotated[int, Field(ge=0, le=65535)]  # of a 16-bit sensor


class SourceSettings(StrictModel):
    """Settings of a camera feed."""

    latency_ms: float = Field(
        default=0.0,
        ge=0,
        le=1000,
        description="constant glass-to-glass latency, for streams without exact times",
    )
    time_offset_ms: float = Field(
        default=0.0,
        ge=-1000,
        le=1000,
        description="constant time offset of the frames, from `calibrate flight`; subtracted",
    )
    timing: Timing = Field(
        default="auto",
        description="auto: MISP timestamps if the stream has them; pts: never",
    )
    # time without a frame after which a live stream is stalled
    stall_timeout_s: float = Field(1.0, exclude=True)
    retry_max_s: float = Field(4.0, exclude=True)  # longest wait between connection attempts
    rate_hz: float = Field(
        default=10.0,
        ge=0.01,
        le=1000,
        description="frame rate of an image folder without timestamps.txt, and of raw H.264",
    )
    realtime: bool = Field(
        default=False,
        description="play files and folders in real time",
    )
    sender: str | None = Field(
        default=None,
        description="UDP: accepted sender, ADDRESS or ADDRESS:PORT; null: the first",
    )

    grey_range: tuple[Count, Count] | None = Field(
        default=None,
        description="16-bit grey: counts of black and white; null: refused",
    )

    @property
    def late_ns(self) -> int:
        """`time_offset_ms` in ns: subtracted from exposure times."""
        return round(1e6 * self.time_offset_ms)

    @field_validator("grey_range")
    @classmethod
    def _is_a_range(cls, value: GreyRange | None) -> GreyRange | None:
        if value is not None and value[0] >= value[1]:
            raise ValueError(f"black at {value[0]} must lie below white at {value[1]}")
        return value

    @field_validator("sender")
    @classmethod
    def _is_a_sender(cls, value: str | None) -> str | None:
        if value is not None:
            parse_sender(value)
        return value


class PacketTap(Protocol):
    """Receives a video's undecoded packets, on the reader's thread; must not block."""

    def begin(self, stream: av.VideoStream) -> None:
        """A connection was opened; the following packets are of this stream."""
        ...

    def packet(self, packet: av.Packet) -> None:
        """The next packet in decoding order; the tap may keep it."""
        ...

    def frame_exposed(self, pts: Fraction, exposure_time_ns: int) -> None:
        """A frame of presentation time `pts` (s) was decoded; it was exposed then
        (CLOCK_MONOTONIC).
        """
        ...


def video_stream(container: av.container.InputContainer, where: str) -> av.VideoStream:
    """The container's video stream, not a cover image or thumbnails. If there are several, FFmpeg's
    choice, which is logged. where: location for the error text. `StreamOpenError` without one.
    """
    films = [
        s for s in container.streams.video
        if s.codec_context is not None and not s.disposition & Disposition.attached_pic
    ]  # fmt: skip
    most = max((s.frames for s in films), default=0)  # 0 where the container does not say
    films = [s for s in films if s.frames * _LEAST_SHARE >= most]
    if not films:
        raise StreamOpenError(f"{where}: has no video stream that can be read; give a video")
    best = container.streams.best("video")
    chosen = next((s for s in films if s is best), films[0])
    if len(films) > 1:
        _log.warning(
            "%s: holds %d video streams; number %d of %dx%d is read",
            where, len(films), chosen.index, chosen.width, chosen.height,
        )  # fmt: skip
    return chosen


def has_times(container: av.container.InputContainer) -> bool:
    """Whether the container's format has presentation times, unlike raw H.264."""
    return not container.format.flags & Flags.no_timestamps.value


class FrameSource(ABC):
    """A camera feed, with its camera model, settings, counters and a state that it reports. One
    consumer iterates `frames`; `close` may be called from any thread.
    """

    def __init__(
        self, camera: Camera, settings: SourceSettings | None, on_state: StateCallback | None
    ) -> None:
        self._camera, self._settings = camera, settings or SourceSettings()
        self._on_state = on_state
        self._state = StreamState.IDLE
        self._lock = threading.Lock()
        self._counters = SourceCounters()

    @abstractmethod
    def frames(self) -> Iterator[Frame]:
        """Yield frames in order of exposure, until a file ends or the source is closed.

        If a live stream stops, the iteration waits: the source reports its state and connects
        again.
        """

    @abstractmethod
    def close(self) -> None:
        """End `frames` and free device or socket; harmless when called again."""

    @property
    def counters(self) -> SourceCounters:
        """Counters so far."""
        return self._counters

    @property
    def state(self) -> StreamState:
        """State of the feed."""
        return self._state

    def _count(self, **more: int) -> None:
        with self._lock:
            c = self._counters
            self._counters = replace(c, **{k: getattr(c, k) + n for k, n in more.items()})

    def _report(self, state: StreamState, text: str) -> None:
        self._state = state
        if self._on_state is not None:
            self._on_state(state, text)

    def _report_change(self, state: StreamState, text: str) -> None:
        if self._state is not state:
            self._report(state, text)

    def _report_scaling(self, camera: Camera, where: str) -> None:
        """Report if `camera`, the model of a frame, is the calibrated one scaled."""
        if camera is not self._camera:
            self._report_change(
                StreamState.SCALED,
                f"{where}: delivers {camera.width}x{camera.height}, taken as the calibrated "
                f"{self._camera.width}x{self._camera.height} scaled down or up (wrong if the "
                "camera crops or zooms)",
            )


def fitted_camera(width: int, height: int, camera: Camera, where: str) -> Camera:
    """Camera model for frames of width x height pixels: the calibrated one, scaled if necessary.
    where: location for the error text. `StreamSizeError` for another aspect ratio.
    """
    if (width, height) == (camera.width, camera.height):
        return camera
    if abs(width * camera.height / (height * camera.width) - 1.0) > _SHAPE_TOLERANCE:
        raise StreamSizeError(
            f"{where} delivers {width}x{height} but the camera model is "
            f"{camera.width}x{camera.height}: set the stream to the calibrated size, or give the "
            f"camera model of {width}x{height} (intrinsics do not carry over to a cropped size)",
            (width, height),
        )
    try:
        return camera.resized(width, height)
    except CameraError as error:
        text = f"{where} delivers {width}x{height}: {error}"
        raise StreamSizeError(text, (width, height)) from error
