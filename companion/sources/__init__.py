"""Camera feeds: UDP (MPEG-TS, RTP, H.264), RTSP, V4L2 devices, video files and image folders."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from companion.errors import StreamOpenError
from companion.sources.av_source import LiveVideoSource, VideoFileSource
from companion.sources.base import (
    FrameSource,
    PacketTap,
    SourceCounters,
    SourceSettings,
    StateCallback,
    StreamState,
)
from companion.sources.folder_source import FolderSource
from localizer.geometry.camera import Camera

__all__ = [
    "FolderSource",
    "FrameSource",
    "LiveVideoSource",
    "PacketTap",
    "SourceCounters",
    "SourceSettings",
    "StateCallback",
    "StreamState",
    "VideoFileSource",
    "open_source",
]

_LIVE = ("udp://", "rtp://", "rtsp://", "v4l2://", "/dev/")


def open_source(
    location: str | Path,
    camera: Camera,
    settings: SourceSettings | None = None,
    on_state: StateCallback | None = None,
    on_stranger: Callable[[str], None] | None = None,
    *taps: PacketTap,
) -> FrameSource:
    """Open the feed at `location`: ``udp://host:port`` (MPEG-TS, RTP or raw H.264 or H.265), the
    ``.sdp`` file of an RTP feed, ``rtsp://...``, ``/dev/videoN`` (or ``v4l2:///dev/videoN``), a
    video file, or a folder of images.

    camera: calibrated model of the feed's frames. on_state: called with the state and a text for
    the operator when the state changes. on_stranger: called once for each other IP address that
    sends video to a UDP feed. taps: receive the packets of a video; unused for a folder of images.
    Raises `StreamOpenError` if a file or device does not exist. A live stream may start later.
    """
    text = str(location)
    if text.startswith(_LIVE) or text.endswith(".sdp"):
        return LiveVideoSource(text, camera, settings, on_state, on_stranger, *taps)
    if "://" in text:
        raise StreamOpenError(
            f"{text}: unknown kind of source; use udp://, rtsp://, /dev/videoN, a file (.sdp of an "
            "RTP feed, or a video) or a folder"
        )
    path = Path(location)
    if path.is_dir():
        return FolderSource(path, camera, settings, on_state)
    if path.is_file():
        return VideoFileSource(path, camera, settings, on_state, *taps)
    raise StreamOpenError(f"{path}: no such file or folder")
