"""Pixel detections from outside: an operator's click or an object detector, as JSON over UDP.

One datagram is one detection: ``{"target_id": "car", "time_ns": 123, "u": 320.5, "v": 240.5}``;
time_ns is the frame's exposure on CLOCK_MONOTONIC, (u, v) the pixel in the video as streamed.
"""

from __future__ import annotations

import json
import logging
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite

from companion.errors import ConfigError, DetectionError

_log = logging.getLogger(__name__)
_MAX_DATAGRAM = 2048
_MAX_NAME = 64
# What the targets that the operator clicked at are called: a number follows.
CLICKED = "ground station "
_PAUSE_S = 0.001  # at most a thousand detections a second: a flood must not take the interpreter


@dataclass(frozen=True)
class Detection:
    """A target's pixel in one frame."""

    target_id: str
    time_ns: int
    u: float
    v: float


def parse_detection(data: bytes) -> Detection:
    """Decode one datagram; `DetectionError` says what is wrong with it."""
    try:
        message = json.loads(data)
        detection = Detection(
            str(message["target_id"]),
            int(message["time_ns"]),
            float(message["u"]),
            float(message["v"]),
        )
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise DetectionError(f"not a detection: {type(error).__name__} {error}") from error
    if not (isfinite(detection.u) and isfinite(detection.v)):
        raise DetectionError("pixel must be finite")
    name = detection.target_id
    if not 0 < len(name) <= _MAX_NAME or not name.isprintable():
        raise DetectionError(f"target_id must have 1 to {_MAX_NAME} printable characters")
    if name.startswith(CLICKED):
        raise DetectionError(f"target_id {name!r}: names that begin so are the operator's clicks")
    return detection


def encode_detection(detection: Detection) -> bytes:
    """Inverse of `parse_detection`."""
    return json.dumps(detection.__dict__).encode()


def parse_host_port(text: str) -> tuple[str, int]:
    """``host:port`` as a socket address."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise ConfigError(f"expected host:port, got {text!r}")
    return host, int(port)


class DetectionListener:
    """Receives detections on a thread; bad datagrams are counted and ignored."""

    def __init__(self, address: str, on_detection: Callable[[Detection], None]) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(parse_host_port(address))
        except OSError as error:
            self._socket.close()
            raise ConfigError(f"targets.detections {address}: cannot listen: {error}") from error
        self._socket.settimeout(0.3)
        self._on_detection = on_detection
        self._stop = threading.Event()
        self.received = 0
        self.rejected = 0
        self._thread = threading.Thread(target=self._run, name="detections")
        self._thread.start()

    def close(self) -> None:
        """Stop listening."""
        self._stop.set()
        self._thread.join()
        self._socket.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                data = self._socket.recv(_MAX_DATAGRAM)
            except TimeoutError:
                continue
            self._stop.wait(_PAUSE_S)
            try:
                detection = parse_detection(data)
            except DetectionError as error:
                self.rejected += 1
                if self.rejected == 1:
                    _log.warning("targets.detections: %s", error)
                continue
            self.received += 1
            self._on_detection(detection)
