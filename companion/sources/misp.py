"""MISP precision time stamps in H.264 (MISB ST 0604): the exposure time inside the frame.

The stamp is an SEI message "user data unregistered" (ITU-T H.264, D.1.7) whose UUID is the ASCII
text ``MISPmicrosectime``. Its payload is a status byte and eight bytes of microseconds since
1970-01-01 (the MISP time system; a POSIX clock's value here), with 0xFF after every second byte so
that no start code can appear in it.
"""

from __future__ import annotations

from dataclasses import dataclass

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
