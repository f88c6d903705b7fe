"""Writes MPEG-TS (ISO/IEC 13818-1) of one H.265 stream, because FFmpeg's IVF has no H.265.

An empty PES packet follows each frame: FFmpeg outputs a frame when the next packet begins.
"""

from __future__ import annotations

import struct
from functools import cache

_BODY = 184  # bytes of a packet after its header
_PMT, _VIDEO, _HEVC = 0x1000, 0x0100, 0x24  # PIDs; H.265's stream type
_FIRST = 90_000  # the first picture's time: earlier ones may follow
_PES = b"\x00\x00\x01\xe0"


class TransportStream:
    """Encodes frames as MPEG-TS, with the tables before each."""

    def __init__(self) -> None:
        self._counts = {0: 0, _PMT: 0, _VIDEO: 0}

    def encode_frame(self, data: bytes, time: int) -> bytes:
        """The next frame as MPEG-TS packets. data: its H.265, Annex B; time: its presentation time,
        in 1/90000 s since the first frame.
        """
        video = 0xE000 | _VIDEO
        pat = struct.pack(">HBBBHH", 1, 0xC1, 0, 0, 1, 0xE000 | _PMT)
        pmt = struct.pack(">HBBBHHBHH", 1, 0xC1, 0, 0, video, 0xF000, _HEVC, video, 0xF000)
        stamp = _stamp(time + _FIRST)
        return b"".join((
            self._packets(0, _section(0, pat)),
            self._packets(_PMT, _section(2, pmt)),
            self._packets(_VIDEO, _PES + b"\0\0" + stamp + data),
            self._packets(_VIDEO, _PES + struct.pack(">H", len(stamp)) + stamp),
        ))  # fmt: skip

    def _packets(self, pid: int, payload: bytes) -> bytes:
        made = []
        for at in range(0, len(payload), _BODY):
            part, count = payload[at : at + _BODY], self._counts[pid]
            self._counts[pid] = (count + 1) & 0x0F
            head = pid | (0x4000 if at == 0 else 0)
            stuffing = b""
            if len(part) < _BODY:  # an adaptation field: its length, its flags, filling
                left = _BODY - 1 - len(part)
                stuffing = bytes([left]) + (b"\0" + b"\xff" * (left - 1) if left else b"")
            control = (0x30 if stuffing else 0x10) | count
            made.append(struct.pack(">BHB", 0x47, head, control) + stuffing + part)
        return b"".join(made)


def _stamp(time: int) -> bytes:
    """Flags and presentation time (33 bits) of a PES packet; time in 1/90000 s."""
    t = time & 0x1_FFFF_FFFF
    high, middle, low = t >> 30, t >> 15 & 0x7FFF, t & 0x7FFF
    return b"\x80\x80\x05" + struct.pack(">BHH", 0x21 | high << 1, middle << 1 | 1, low << 1 | 1)


def _section(table: int, body: bytes) -> bytes:
    """A table's section with its checksum, after the pointer to it."""
    data = struct.pack(">BH", table, 0xB000 | len(body) + 4) + body
    crc = 0xFFFF_FFFF
    for byte in data:
        crc = (crc << 8 & 0xFFFF_FFFF) ^ _crc_of((crc >> 24) ^ byte)
    return b"\0" + data + struct.pack(">I", crc)


@cache
def _crc_of(byte: int) -> int:
    crc = byte << 24
    for _ in range(8):
        crc = (crc << 1 & 0xFFFF_FFFF) ^ (0x04C1_1DB7 if crc & 0x8000_0000 else 0)
    return crc
