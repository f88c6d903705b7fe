"""Converts a stream's time stamps to exposure times on CLOCK_MONOTONIC.

Three sources, best first: 1. A device's monotonic time stamp (V4L2 on Linux): used as it is. 2.
MISP stamps of a camera whose clock is synchronized with the companion's (NTP, PTP): exact. 3.
Presentation times, or MISP stamps of a free-running clock: only their differences are used. The
smallest lag seen gives the clock offset (as ArduPilot's JitterCorrection does for MAVLink), minus a
fixed latency that must be measured once per camera.

MISP's precision time stamp in H.264 (MISB ST 0604) is an SEI message "user data unregistered"
(ITU-T H.264, D.1.7) whose UUID is the ASCII text ``MISPmicrosectime``. Its payload is a status byte
and eight bytes of microseconds since 1970-01-01 (the MISP time system; a POSIX clock's value here),
with 0xFF after every second byte so that no start code can appear in it.
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, field
from typing import Literal

import av
from av.sidedata.sidedata import Type as SideDataType

UUID = b"MISPmicrosectime"
_NOT_LOCKED = 0x80  # status bit 7: 0 = the clock is locked to an absolute reference
_STATUS_RESERVED = 0x1F  # status bits 0 to 4 are reserved and always 1
_MESSAGE_SIZE = len(UUID) + 1 + 8 + 3
_FILLER = slice(3, None, 3)  # of the 12 bytes from the status on: 0xFF at 3, 6 and 9


@dataclass(frozen=True)
class MispTime:
    """time_us: microseconds since 1970-01-01; locked: the clock has an absolute reference."""

    time_us: int
    locked: bool


def sei_nal(stamp: MispTime) -> bytes:
    """Encode the stamp as a NAL unit with start code, to precede a frame's slices."""
    t = stamp.time_us.to_bytes(8, "big")
    status = _STATUS_RESERVED | (0 if stamp.locked else _NOT_LOCKED)
    message = UUID + bytes([status]) + b"\xff".join((t[0:2], t[2:4], t[4:6], t[6:8]))
    header = bytes([0x06, 0x05, len(message)])  # NAL type 6 (SEI), payload type 5, payload size
    return b"\x00\x00\x00\x01" + header + message + b"\x80"


def parse_message(message: bytes) -> MispTime | None:
    """The stamp in an SEI message (UUID and payload); None for other messages."""
    if len(message) < _MESSAGE_SIZE or not message.startswith(UUID):
        return None
    body = message[len(UUID) : _MESSAGE_SIZE]
    if any(byte != 0xFF for byte in body[_FILLER]):
        return None
    t = body[1:3] + body[4:6] + body[7:9] + body[10:12]
    return MispTime(int.from_bytes(t, "big"), locked=not body[0] & _NOT_LOCKED)


def misp_time(picture: av.VideoFrame) -> MispTime | None:
    """The time stamp in a decoded frame; None without one."""
    messages = (d for d in picture.side_data if d.type == SideDataType.SEI_UNREGISTERED)
    return next(filter(None, (parse_message(bytes(data)) for data in messages)), None)


_log = logging.getLogger(__name__)

Timing = Literal["auto", "pts"]

_WINDOW_NS = 10_000_000_000  # the smallest lag is forgotten after one to two windows: clocks drift
_DISCONTINUITY_NS = 2_000_000_000
_MAX_AGE_NS = 500_000_000  # no absolute stamp is believed that makes a frame older than this
_MAX_AHEAD_NS = 5_000_000  # nor one this far in the future
_READINGS, _CLOSE_NS = 5, 100_000
_STEP_NS = 20_000_000  # what a clock that is only slewed does not do between two frames


@dataclass
class MinimumLag:
    """Converts a sender's clock of unknown epoch to CLOCK_MONOTONIC by the smallest lag seen.

    If arrival times do not decrease, the results do not: a new smallest lag gives the arrival time
    itself. latency_ns: the part of the lag that every frame has.
    """

    latency_ns: int = 0
    _current: int | None = None
    _previous: int | None = None
    _window_start: int = 0
    _last_sender: int = field(default=-(2**63))

    def map(self, sender_ns: int, arrival_ns: int) -> int:
        """`sender_ns` as CLOCK_MONOTONIC (ns), of a message that arrived at `arrival_ns`. Call it
        in order of arrival; a sender's clock that goes back or jumps by 2 s is learned anew.
        """
        lag = arrival_ns - sender_ns
        if self._is_discontinuity(lag, sender_ns):
            self._current = self._previous = None
        self._last_sender = sender_ns
        if self._current is None:
            self._current, self._window_start = lag, arrival_ns
        elif arrival_ns - self._window_start > _WINDOW_NS:
            self._previous, self._current = self._current, lag
            self._window_start = arrival_ns
        self._current = min(self._current, lag)
        smallest = self._current if self._previous is None else min(self._current, self._previous)
        return sender_ns + smallest - self.latency_ns

    def _is_discontinuity(self, lag: int, sender_ns: int) -> bool:
        known = self._current if self._current is not None else lag
        return sender_ns < self._last_sender or abs(lag - known) > _DISCONTINUITY_NS


class ExposureClock:
    """Computes exposure times; a new one for each connection. device: a V4L2 device, whose
    presentation times are CLOCK_MONOTONIC.
    """

    def __init__(self, latency_ns: int, timing: Timing = "auto", *, device: bool = False) -> None:
        self._timing = timing
        self._device = device
        self._by_pts = MinimumLag(latency_ns)
        self._by_misp = MinimumLag(latency_ns)
        self._warned = False
        self._wall_clock_ns: int | None = None
        self._excess_ns: int | None = None  # of the smallest lag's times over the exact ones
        self._held = False

    def exposure_time(self, pts_ns: int | None, misp: MispTime | None, arrival_ns: int) -> int:
        """CLOCK_MONOTONIC ns of the exposure of the next frame, which arrived at `arrival_ns`.
        pts_ns: presentation time, of unknown epoch; None without, as misp.
        """
        if self._device and pts_ns is not None and _plausible(pts_ns, arrival_ns):
            return pts_ns
        if misp is not None and self._timing == "auto":
            return self._from_misp(misp, arrival_ns)
        if pts_ns is not None:
            return self._by_pts.map(pts_ns, arrival_ns)
        return arrival_ns - self._by_pts.latency_ns

    def _from_misp(self, misp: MispTime, arrival_ns: int) -> int:
        # Both clocks are read again for each frame, because NTP may step the system's clock.
        offset_ns = system_minus_monotonic()
        monotonic = misp.time_us * 1000 - offset_ns
        relative = self._by_misp.map(misp.time_us * 1000, arrival_ns)
        exact = misp.locked and _plausible(monotonic, arrival_ns)
        self._watch_wall_clock(offset_ns)
        if exact and self._agrees(relative - monotonic):
            self._excess_ns, self._held = relative - monotonic, False
            return monotonic
        if not exact and not self._warned:
            self._warned = True
            _log.warning(
                "the camera's MISP clock is not the companion's (locked: %s, age %.3f s): using "
                "the smallest lag instead; synchronise the camera by NTP or PTP for exact times",
                misp.locked,
                (arrival_ns - monotonic) / 1e9,
            )
        # With what is known of the lag from the stamps that were exact before.
        known = relative - (self._excess_ns or 0)
        return known if _plausible(known, arrival_ns) else relative

    def _agrees(self, excess_ns: int) -> bool:
        """Whether a MISP stamp is used as it is. After a step of this computer's clock, the stamp
        must give the lag that the stamps before the step gave.
        """
        if not self._held or self._excess_ns is None:
            return True
        return abs(excess_ns - self._excess_ns) <= _STEP_NS

    def _watch_wall_clock(self, offset_ns: int) -> None:
        """Detect a step of this computer's clock, so that exposure times do not step with it."""
        before, self._wall_clock_ns = self._wall_clock_ns, offset_ns
        if before is not None and abs(offset_ns - before) > _STEP_NS:
            self._held = True
            _log.warning(
                "this computer's clock was stepped by %+.3f s: the exposure times of the camera's "
                "MISP clock are kept as they were, by the lag known before; let NTP slew, not step",
                (offset_ns - before) / 1e9,
            )


def system_minus_monotonic() -> int:
    """The system clock minus CLOCK_MONOTONIC, ns.

    Taken from the closest of up to 5 pairs of readings, because another thread may run between two
    readings.
    """
    pairs = []
    for _ in range(_READINGS):
        before, system, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        pairs.append((after - before, system - (before + after) // 2))
        if after - before < _CLOSE_NS:
            break
    return min(pairs)[1]


def _plausible(stamp_ns: int, arrival_ns: int) -> bool:
    return -_MAX_AHEAD_NS <= arrival_ns - stamp_ns <= _MAX_AGE_NS
