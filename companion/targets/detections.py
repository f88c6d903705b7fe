"""Receives pixel detections of an external object detector or click, as JSON over UDP.

One datagram is one detection: ``{"target_id": "car", "time_ns": 123, "u": 320.5, "v": 240.5}``;
time_ns is the frame's exposure on CLOCK_MONOTONIC, (u, v) the pixel in the streamed video. Instead
of time_ns a detector may give the frame: ``"sequence"`` is its number, ``"pts_s"`` its presentation
time in the stream, seconds.

Targets of different detectors get different names, and each target a number in MAVLink.
"""

from __future__ import annotations

import json
import logging
import socket
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import cycle
from math import isfinite

from companion.ending import wait_for_end
from companion.errors import ConfigError, DetectionError
from mavlink_bridge import shared

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


_SILENT_NS = 10_000_000_000  # a sender unheard for so long is gone; its name is free
_NAMES, _SENDERS = 256, 8  # remembered: of one name, so many senders
_LONGEST = 58  # of a name, before what tells the sender

Address = tuple[str, int]


@dataclass
class _Named:
    """Senders of a name. numbers: of their targets, from 1; heard_ns: when each was heard last."""

    numbers: dict[Address, int] = field(default_factory=dict)
    heard_ns: dict[Address, int] = field(default_factory=dict)
    newest: Address | None = None
    count: int = 1


class Senders:
    """Gives targets of several senders different names. Not thread-safe.

    A new sender takes a name over: it may be a detector that was restarted, or one that opens a
    socket for each datagram. If the earlier sender sends this name again, there are two senders.
    The targets of the later one then get its number: "car #2".
    """

    def __init__(self) -> None:
        self._names: OrderedDict[str, _Named] = OrderedDict()

    def name_of(self, target_id: str, sender: Address, now_ns: int) -> str:
        """The name of a detection's target; to be called for each detection. If several senders use
        the same target_id, each gets a target of its own, whose name has a number. now_ns:
        CLOCK_MONOTONIC.
        """
        named = self._names.setdefault(target_id, _Named())
        self._names.move_to_end(target_id)
        if len(self._names) > _NAMES:
            self._names.popitem(last=False)
        self._forget(named, now_ns)
        newest = named.newest
        if sender not in named.numbers:
            named.numbers[sender] = named.numbers.get(newest, 1) if newest is not None else 1
        elif newest is not None and newest != sender:
            self._split(target_id, named, newest, named.numbers[sender])
        named.heard_ns[sender], named.newest = now_ns, sender
        number = named.numbers[sender]
        return target_id if number == 1 else f"{target_id[:_LONGEST]} #{number}"

    @staticmethod
    def _split(target_id: str, named: _Named, other: Address, number: int) -> None:
        """Give the `other` sender its own number, because both use the name in turn."""
        if named.numbers.get(other) != number:
            return
        named.count += 1
        named.numbers[other] = named.count
        if named.count == 2:
            _log.warning(
                "targets.detections: %s:%d and another name a target %r: its is %r from now on",
                *other, target_id, f"{target_id[:_LONGEST]} #2",
            )  # fmt: skip

    @staticmethod
    def _forget(named: _Named, now_ns: int) -> None:
        """Remove the senders that are silent for 10 s, and the oldest of more than 8."""
        by_age = sorted(named.heard_ns, key=lambda a: -named.heard_ns[a])
        for k, sender in enumerate(by_age):
            if k >= _SENDERS or now_ns - named.heard_ns[sender] > _SILENT_NS:
                del named.heard_ns[sender], named.numbers[sender]
                named.newest = None if named.newest == sender else named.newest
        if not named.numbers:
            named.count = 1


# Below and above are the clicks, which bring their numbers with them.
_DETECTED = range(shared.CLICKED.stop, shared.FURTHER_CLICKS)
_MOST = 256  # names; many times as many as are followed at a time


class TargetNumbers:
    """Gives each target's name a number: that of its click, or the next free one for detections.

    Numbers are unique; one is reused only after a million others. The 256 newest names are
    remembered.
    """

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}
        self._free = cycle(_DETECTED)
        self._lock = threading.Lock()

    def number_of(self, name: str) -> int:
        """The number of the target of that name; a new name gets the next free one."""
        if (clicked := clicked_number(name)) is not None:
            return clicked
        with self._lock:
            number = self._numbers.pop(name, None)
            if number is None:
                taken = self._numbers.values()
                number = next(n for n in self._free if n not in taken)
                if len(self._numbers) >= _MOST:
                    del self._numbers[next(iter(self._numbers))]
            self._numbers[name] = number  # at the end: the newest
            return number
