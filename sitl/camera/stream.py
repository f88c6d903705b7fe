"""H.264 in MPEG-TS over UDP, as a gimbal camera sends it."""

from __future__ import annotations

import socket
from fractions import Fraction
from typing import Any
from urllib.parse import urlsplit

import av
import numpy as np

from companion.sources.timing import MispTime, sei_nal, system_minus_monotonic
from localizer.types import Image

_CLOCK = Fraction(1, 90_000)  # MPEG-TS presentation clock, Hz
_NS_PER_TICK = Fraction(1_000_000_000) * _CLOCK
_DATAGRAM = 1316  # bytes: seven TS packets, what fits an Ethernet frame


class LossyLink:
    """Output file for FFmpeg: sends datagrams to ``udp://host:port`` and drops a random share."""

    def __init__(self, url: str, loss: float, seed: int = 0) -> None:
        parts = urlsplit(url)
        if parts.scheme != "udp" or parts.hostname is None or parts.port is None:
            raise ValueError(f"{url}: packets are lost on udp://host:port only")
        self._address = (parts.hostname, parts.port)
        self._loss = loss
        self._rng = np.random.default_rng([seed, 37])
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._lost = 0

    @property
    def lost(self) -> int:
        """Number of dropped datagrams."""
        return self._lost

    def write(self, data: bytes) -> int:
        """Send bytes (whole TS packets) in datagrams."""
        for start in range(0, len(data), _DATAGRAM):
            if self._rng.random() < self._loss:
                self._lost += 1
                continue
            self._socket.sendto(data[start : start + _DATAGRAM], self._address)
        return len(data)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class VideoSender:
    """Encodes frames as H.264 and sends them as MPEG-TS over UDP.

    misp: add the exposure time of each frame (MISB ST 0604); otherwise the receiver has only
    presentation times. link: output that loses packets, instead of the url. Every key frame (one a
    second) carries the headers, so that a receiver can join at any time.
    """

    def __init__(
        self,
        url: str,
        width: int,
        height: int,
        rate_hz: float,
        *,
        bit_rate: int = 4_000_000,
        misp: bool = True,
        link: LossyLink | None = None,
    ) -> None:
        self._misp = misp
        self._encoder = _encoder(width, height, rate_hz, bit_rate)
        # The PES length lets a receiver end a picture with its last byte, not at the next one's
        # first.
        separator = "&" if "?" in url else "?"
        target: Any = f"{url}{separator}pkt_size={_DATAGRAM}" if link is None else link
        # Whole datagrams at once: FFmpeg hands its buffer over when it is full, or flushed.
        buffer = 24 * _DATAGRAM
        self._container = av.open(
            target,
            "w",
            buffer_size=buffer,
            format="mpegts",
            options={
                "omit_video_pes_length": "0",
                "mpegts_flags": "resend_headers",
                "flush_packets": "1",
            },
        )
        self._stream = self._container.add_stream("libx264", rate=round(rate_hz))
        self._stream.width, self._stream.height = width, height
        self._stream.pix_fmt = "yuv420p"
        self._bytes = 0

    @property
    def sent_bytes(self) -> int:
        """Encoded bytes sent, without the transport's overhead."""
        return self._bytes

    def send(self, image: Image, exposure_ns: int, stamped_ns: int | None = None) -> None:
        """Send an RGB image (H, W, 3) uint8 exposed at `exposure_ns` (CLOCK_MONOTONIC).

        stamped_ns: exposure time stated by a camera with a wrong clock; None: the true one.
        """
        picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        picture = picture.reformat(format="yuv420p")
        picture.pts = round(exposure_ns / _NS_PER_TICK)
        picture.time_base = _CLOCK
        stamp = self._stamp(stamped_ns or exposure_ns) if self._misp else b""
        for encoded in self._encoder.encode(picture):
            packet = av.Packet(stamp + bytes(encoded))
            packet.pts, packet.dts, packet.time_base = encoded.pts, encoded.dts, _CLOCK
            packet.is_keyframe = encoded.is_keyframe
            packet.stream = self._stream
            self._container.mux(packet)
            self._bytes += packet.size

    def close(self) -> None:
        """Ends the stream."""
        self._container.close()

    @staticmethod
    def _stamp(exposure_ns: int) -> bytes:
        system_ns = exposure_ns + system_minus_monotonic()
        return sei_nal(MispTime(system_ns // 1000, locked=True))


def _encoder(width: int, height: int, rate_hz: float, bit_rate: int) -> av.VideoCodecContext:
    encoder = av.CodecContext.create("libx264", "w")
    encoder.width, encoder.height, encoder.pix_fmt = width, height, "yuv420p"
    encoder.time_base = _CLOCK
    encoder.framerate = Fraction(rate_hz).limit_denominator(1000)
    encoder.bit_rate = bit_rate
    # A PES packet with a length holds at most 65,535 bytes: the rate control's buffer keeps every
    # picture below 60 kB.
    rate_control = f"vbv-maxrate={bit_rate // 1000}:vbv-bufsize=480"
    encoder.options = {
        "preset": "ultrafast",
        "tune": "zerolatency",
        "g": str(max(1, round(rate_hz))),
        "x264-params": f"repeat-headers=1:scenecut=0:threads=1:{rate_control}",
    }
    return encoder
