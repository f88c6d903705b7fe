"""A small RTSP server that is a camera: RTP interleaved in the control connection."""

from __future__ import annotations

import contextlib
import re
import socket
import threading
import time
from fractions import Fraction
from typing import Any

import av
import numpy as np

from localizer.geometry.camera import Camera

CAMERA = Camera.from_fov(320, 240, 60.0)
RATE_HZ = 10
STEP = 4  # between the levels of following pictures
SDP = (
    "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=camera\r\nc=IN IP4 0.0.0.0\r\nt=0 0\r\n"
    "m=video 0 RTP/AVP 96\r\na=rtpmap:96 H264/90000\r\na=fmtp:96 packetization-mode=1\r\n"
    "a=control:track1\r\n"
)


class RtspCamera:
    """Serves one client at a time. FFmpeg packs the RTP; this relays it into the TCP connection, or
    by UDP, where it refuses the other with 461.
    """

    def __init__(self, *, by_udp: bool = False) -> None:
        self._by_udp = by_udp
        self._client_port = 0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"rtsp://127.0.0.1:{self._listener.getsockname()[1]}/live"
        self.sent: dict[int, int] = {}
        self._rng = np.random.default_rng(0)
        self._closed = threading.Event()
        self._hang_up = threading.Event()
        threading.Thread(target=self._serve, daemon=True).start()

    def hang_up(self) -> None:
        """Drop the client."""
        self._hang_up.set()

    def close(self) -> None:
        self._closed.set()
        self._hang_up.set()
        self._listener.close()

    def _serve(self) -> None:
        with contextlib.suppress(OSError):
            while not self._closed.is_set():
                client, _ = self._listener.accept()
                self._hang_up.clear()
                with client, contextlib.suppress(OSError):
                    self._answer(client)

    def _answer(self, client: socket.socket) -> None:
        requests = client.makefile("rb")
        while not self._closed.is_set():
            lines: list[Any] = []
            while (line := requests.readline().strip()) or not lines:
                if not line:
                    return
                lines.append(line.decode())
            headers = dict(h.split(": ", 1) for h in lines[1:] if ": " in h)
            method, body, extra = lines[0].split()[0], "", ""
            if method == "DESCRIBE":
                body, extra = (
                    SDP,
                    f"Content-Type: application/sdp\r\nContent-Length: {len(SDP)}\r\n",
                )
            elif method == "SETUP" and self._by_udp:
                port = re.search(r"client_port=(\d+)", headers["Transport"])
                if port is None:
                    refused = (
                        f"RTSP/1.0 461 Unsupported Transport\r\nCSeq: {headers['CSeq']}\r\n\r\n"
                    )
                    client.sendall(refused.encode())
                    continue
                self._client_port = int(port[1])
                extra = f"Transport: {headers['Transport']};server_port=6970-6971\r\nSession: 1\r\n"
            elif method == "SETUP":
                extra = "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 1\r\n"
            elif method in ("PLAY", "OPTIONS"):
                extra = "Session: 1\r\nPublic: DESCRIBE, SETUP, PLAY, TEARDOWN\r\n"
            client.sendall(
                f"RTSP/1.0 200 OK\r\nCSeq: {headers['CSeq']}\r\n{extra}\r\n{body}".encode()
            )
            if method == "PLAY":
                self._play(client)
                return

    def _play(self, client: socket.socket) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as relay:
            relay.bind(("127.0.0.1", 0))
            relay.settimeout(0.01)
            port = relay.getsockname()[1]
            with av.open(f"rtp://127.0.0.1:{port}", "w", format="rtp") as output:
                stream = output.add_stream("libx264", rate=RATE_HZ)
                stream.width, stream.height, stream.pix_fmt = 320, 240, "yuv420p"
                stream.time_base = Fraction(1, 90_000)
                stream.options = {
                    "preset": "ultrafast", "tune": "zerolatency", "g": "10",
                    "x264-params": "repeat-headers=1",
                }  # fmt: skip
                for number in range(2000):
                    if self._hang_up.is_set():
                        return
                    self._send(number, output, stream)
                    self._forward(relay, client)

    def _send(self, number: int, output: object, stream: object) -> None:
        level = STEP * (number % 40 + 5)
        self.sent[level] = time.monotonic_ns()
        image = np.full((240, 320, 3), level, np.uint8)
        # Texture, so that a picture is spread over many RTP packets.
        image[:120] = self._rng.integers(0, 255, (30, 80, 3), np.uint8).repeat(4, 0).repeat(4, 1)
        picture = av.VideoFrame.from_ndarray(image, format="rgb24")
        picture.pts = self.sent[level] * 9 // 100_000
        picture.time_base = Fraction(1, 90_000)
        output.mux(stream.encode(picture))  # type: ignore[attr-defined]

    def _forward(self, relay: socket.socket, client: socket.socket) -> None:
        end = time.monotonic() + 1 / RATE_HZ
        while time.monotonic() < end:
            with contextlib.suppress(TimeoutError):
                packet = relay.recv(65536)
                if self._by_udp:
                    relay.sendto(packet, ("127.0.0.1", self._client_port))
                else:
                    client.sendall(b"$\0" + len(packet).to_bytes(2, "big") + packet)
