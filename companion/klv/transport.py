"""Writes a video's packets with metadata as MPEG-TS, without encoding them again.

The muxer is FFmpeg's (PyAV); the metadata is a KLV stream (stream type 0x06, registration "KLVA")
whose packets carry the presentation time of their frame.
"""

from __future__ import annotations

import heapq
from fractions import Fraction

import av

from companion.errors import StreamOpenError

_CLOCK = Fraction(1, 90_000)  # of MPEG-TS
_OPTIONS = {
    # Nothing waits for the other stream: metadata may be missing for a while.
    "max_interleave_delta": "1",
    "flush_packets": "1",
    "muxdelay": "0",
    "muxpreload": "0",
}


class TransportWriter:
    """Writes a video stream and its metadata. Not thread-safe.

    output: a file or ``udp://HOST:PORT``; template: the stream from which the packets come. Raises
    `StreamOpenError`.
    """

    def __init__(self, output: str, template: av.VideoStream) -> None:
        target = output
        if output.startswith("udp://") and "?" not in output:
            target = f"{output}?pkt_size=1316"  # seven whole packets of MPEG-TS
        try:
            self._container = av.open(target, "w", format="mpegts", container_options=_OPTIONS)
            self._video = self._container.add_stream_from_template(template)
            self._data = self._container.add_mux_stream("klv", time_base=_CLOCK)
        except (OSError, ValueError, AttributeError) as error:
            raise StreamOpenError(f"{output}: cannot be written as MPEG-TS: {error}") from error
        self._pending: list[tuple[int, bytes]] = []
        self._last_data = -1
        self.late = 0

    def describe(self, pts: Fraction, metadata: bytes) -> None:
        """Add metadata of the frame with that presentation time (s); call before its packet."""
        heapq.heappush(self._pending, (round(pts / _CLOCK), metadata))

    def write(self, packet: av.Packet) -> None:
        """Write a video packet and the metadata of frames up to its decoding time.

        Frames are stored in decoding order; their metadata must be in presentation order. Raises
        OSError.
        """
        stamp = packet.dts if packet.dts is not None else packet.pts
        until = None if stamp is None else round(stamp * packet.time_base / _CLOCK)
        self._flush(until)
        packet.stream = self._video
        self._container.mux(packet)

    def close(self) -> None:
        """Write the remaining metadata and close the output. Raises OSError."""
        self._flush(1 << 62)
        self._container.close()

    def _flush(self, until: int | None) -> None:
        while self._pending and (until is None or self._pending[0][0] <= until):
            pts, metadata = heapq.heappop(self._pending)
            if pts <= self._last_data:
                self.late += 1
                continue
            self._last_data = pts
            packet = av.Packet(metadata)
            packet.stream, packet.time_base = self._data, _CLOCK
            packet.pts = packet.dts = pts
            self._container.mux(packet)
