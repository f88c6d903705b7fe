"""Receives pixel detections of an external object detector or click, as JSON over UDP.

One datagram is one detection: ``{"target_id": "car", "time_ns": 123, "u": 320.5, "v": 240.5}``;
time_ns is the frame's exposure on CLOCK_MONOTONIC, (u, v) the pixel in the streamed video. Instead
of time_ns a detector may give the frame: ``"sequence"`` is its number, ``"pts_s"`` its presentation
time in the stream, seconds.
"""

from __future__ import annotations

import json
import logging
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import isfinite

from companion.ending import wait_for_end
from companion.errors import ConfigError, DetectionError
from companion.targets.senders import Senders

_log = logging.getLogger(__name__)
_MAX_DATAGRAM = 2048
_MAX_NAME = 64
GROUND_STATION, CONSOLE = "ground station", "console"
# What the targets that the operator clicked at are called: by where he did it, a number follows.
CLICKED = (f"{GROUND_STATION} ", f"{CONSOLE} ")
# And what the detector in the companion's own process calls things: another detector's "car 1" is
# another car.
DETECTED = "detector "
_PAUSE_S = 0.001  # at most a thousand detections a second: a flood must not take the interpreter


def clicked_name(number: int, asked_by: str = GROUND_STATION) -> str:
    """Target name of the click with that number. asked_by: GROUND_STATION or CONSOLE."""
    return f"{asked_by} {number}"


def clicked_number(name: str) -> int | None:
    """Number of the click in a target's name; None for a detector's target."""
    return int(name.rpartition(" ")[2]) if name.startswith(CLICKED) else None


@dataclass(frozen=True)
class Detection:
    """A target's pixel (u, v) in the frame that was exposed at time_ns, CLOCK_MONOTONIC."""

    target_id: str
    time_ns: int
    u: float
    v: float


@dataclass(frozen=True)
class FrameName:
    """Identifies a frame by its number or presentation time (s); exactly one is set."""

    sequence: int | None = None
    pts_s: float | None = None


def parse_detection(data: bytes) -> tuple[Detection, FrameName | None]:
    """Decode one datagram; `DetectionError` for an invalid one.

    The second value is None if the datagram has the exposure time. Otherwise it names the frame,
    and the detection's time is 0.
    """
    try:
        message = json.loads(data)
        given = [key for key in ("time_ns", "sequence", "pts_s") if key in message]
        if len(given) != 1:
            raise ValueError("one of time_ns, sequence and pts_s says which frame")
        detection = Detection(
            str(message["target_id"]),
            int(message["time_ns"]) if given == ["time_ns"] else 0,
            float(message["u"]),
            float(message["v"]),
        )
        name = None
        if given == ["sequence"]:
            name = FrameName(sequence=int(message["sequence"]))
        elif given == ["pts_s"]:
            name = FrameName(pts_s=float(message["pts_s"]))
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise DetectionError(f"not a detection: {type(error).__name__} {error}") from error
    if not (isfinite(detection.u) and isfinite(detection.v)):
        raise DetectionError("pixel must be finite")
    if name is not None and name.pts_s is not None and not isfinite(name.pts_s):
        raise DetectionError("pts_s must be finite")
    target = detection.target_id
    if not 0 < len(target) <= _MAX_NAME or not target.isprintable():
        raise DetectionError(f"target_id must have 1 to {_MAX_NAME} printable characters")
    if target.startswith(CLICKED):
        raise DetectionError(f"target_id {target!r}: names that begin so are the operator's clicks")
    if target.startswith(DETECTED):
        raise DetectionError(f"target_id {target!r}: `targets.detector` gives names that begin so")
    return detection, name


def encode_detection(detection: Detection) -> bytes:
    """Encode a detection with known exposure time as a datagram."""
    return json.dumps(detection.__dict__).encode()


def parse_host_port(text: str) -> tuple[str, int]:
    """``host:port`` as a socket address; `ConfigError` for other texts."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise ConfigError(f"expected host:port, got {text!r}")
    return host, int(port)


class DetectionListener:
    """Receives detections over UDP on a thread, from its construction on. Invalid datagrams are
    counted and ignored. Targets of two senders with the same name are kept apart (`Senders`).

    address: host:port to listen at; `ConfigError` if it cannot be used. on_detection: called on
    that thread.
    """

    def __init__(
        self, address: str, on_detection: Callable[[Detection, FrameName | None], None]
    ) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(parse_host_port(address))
        except OSError as error:
            self._socket.close()
            raise ConfigError(f"targets.detections {address}: cannot listen: {error}") from error
        self._socket.settimeout(0.3)
        self._on_detection = on_detection
        self._senders = Senders()
        self._stop = threading.Event()
        self.received = 0
        self.rejected = self.failed = 0
        self._thread = threading.Thread(target=self._run, name="detections", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop listening, wait for the thread, and free the port."""
        self._stop.set()
        wait_for_end(self._thread)
        self._socket.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                data, sender = self._socket.recvfrom(_MAX_DATAGRAM)
            except TimeoutError:
                continue
            self._stop.wait(_PAUSE_S)
            try:
                detection, name = parse_detection(data)
                whose = self._senders.name_of(detection.target_id, sender, time.monotonic_ns())
                detection = replace(detection, target_id=whose)
            except DetectionError as error:
                self.rejected += 1
                if self.rejected == 1:
                    _log.warning("targets.detections: %s", error)
                continue
            self.received += 1
            try:
                self._on_detection(detection, name)
            except Exception:  # one detection's fault; the door stays open for the others
                self.failed += 1
                if self.failed == 1:
                    _log.exception("targets.detections: a detection could not be taken")
