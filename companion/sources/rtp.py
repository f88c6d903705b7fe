"""Detects the format of UDP video, and assembles RTP video (RFC 3550, 6184, 7798) into a stream.

FFmpeg reads RTP only from its own sockets, which listen on every interface. Here the datagrams of
one sender are assembled to IVF (H.264) or MPEG-TS (H.265), which keep RTP's times without delay.
"""

from __future__ import annotations

import base64
import binascii
import ipaddress
import re
import struct
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Literal

from companion.errors import StreamOpenError
from localizer.plain_files import plain_text

_CODECS = ("H264", "H265")
_SETS = re.compile(r"sprop-(?:parameter-sets|vps|sps|pps)=([^;\s]+)")
_MOST_BYTES = 1 << 16


@dataclass(frozen=True)
class SdpSession:
    """host: to listen at: a multicast group, loopback or 0.0.0.0. sets: parameter sets (Annex B) or
    b"".
    """

    host: str
    port: int
    sets: bytes

    @classmethod
    def read(cls, path: Path) -> SdpSession:
        """Read a file; `StreamOpenError` if it describes no RTP video of H.264 or H.265."""
        try:
            text = plain_text(path, _MOST_BYTES)
        except (OSError, UnicodeDecodeError) as error:
            raise StreamOpenError(f"{path}: cannot be read: {error}") from error
        media = re.search(r"^m=video (\d+)\S* RTP/\w+ (\d+)", text, re.MULTILINE)
        if media is None or not 0 < int(media[1]) < 1 << 16:
            raise StreamOpenError(f"{path}: no line m=video PORT RTP/AVP TYPE; give the feed's SDP")
        kind = re.search(rf"^a=rtpmap:{media[2]} ([\w-]+)", text, re.MULTILINE)
        codec = kind[1].upper() if kind else f"payload type {media[2]}"
        if codec not in _CODECS:
            raise StreamOpenError(f"{path}: its video is {codec}; have it send H264 or H265")
        try:
            sets = [base64.b64decode(x, validate=True) for m in _SETS.findall(text)
                    for x in m.split(",") if x]  # fmt: skip
        except binascii.Error as error:
            raise StreamOpenError(f"{path}: damaged parameter sets: {error}") from error
        return cls(_host(text), int(media[1]), b"".join(_START + x for x in sets))


def _host(text: str) -> str:
    """The multicast group or loopback address, else 0.0.0.0: another may be the sender's."""
    line = re.search(r"^c=IN IP[46] ([^\s/]+)", text, re.MULTILINE)
    try:
        address = ipaddress.ip_address(line[1] if line else "0.0.0.0")
    except ValueError:
        return "0.0.0.0"
    return str(address) if address.is_multicast or address.is_loopback else "0.0.0.0"


Kind = Literal["mpegts", "rtp h264", "rtp hevc", "rtp mpegts", "h264", "hevc"]
FORMATS: dict[Kind, str] = {
    "mpegts": "mpegts", "rtp mpegts": "mpegts", "rtp h264": "ivf", "rtp hevc": "mpegts",
    "h264": "h264", "hevc": "hevc",
}  # fmt: skip
_PACKET, _SYNC = 188, 0x47  # an MPEG-TS packet's bytes, and the byte that it begins with
_HEADER = 12  # bytes of RTP's
_LEAST_SYNCS = 4  # of MPEG-TS that begins inside a packet: fewer stand in other data, too
_MPEG_TS_TYPE = 33  # payload type; from 96 on they are dynamic
_START = b"\x00\x00\x00\x01"
# NAL unit types, and those of RTP packets that hold several or a part of one.
_H264_TYPES, _H264_MANY, _H264_PART = {1, 2, 5, 6, 7, 8, 9, 12, 24, 28}, 24, 28
_HEVC_TYPES, _HEVC_MANY, _HEVC_PART = {0, 1, 2, *range(4, 10), *range(16, 22), *range(32, 41),
                                       48, 49}, 48, 49  # fmt: skip
_RATE_HZ = 90_000  # of RTP's video times
_WRAP = 1 << 32
_BODY = 184  # bytes of a packet after its header
_PMT, _VIDEO, _HEVC = 0x1000, 0x0100, 0x24  # PIDs; H.265's stream type
_FIRST = 90_000  # the first picture's time: earlier ones may follow
_PES = b"\x00\x00\x01\xe0"


def video_format(data: bytes) -> Kind | None:
    """Video format of a UDP datagram by its first bytes; None if it is no supported video."""
    if data[:1] == bytes([_SYNC]) and _is_transport(data):
        return "mpegts"
    payload = rtp_payload(data)
    if payload:
        if data[1] & 0x7F == _MPEG_TS_TYPE and payload[0] == _SYNC:
            return "rtp mpegts"
        codec = _codec(payload) if data[1] & 0x7F >= 96 else None
        if codec is not None:
            return "rtp h264" if codec == "h264" else "rtp hevc"
    for start in (_START, _START[1:]):
        if data.startswith(start):
            return _codec(data[len(start) :])
    return "mpegts" if _is_transport(data) else None


def describe_unsupported(data: bytes) -> str:
    """Describe a datagram that is no supported video, for the operator."""
    if data[:1] in (b"\xfd", b"\xfe") and len(data) >= 8:
        return "MAVLink: is this the autopilot's port?"
    if rtp_payload(data):
        kind = {26: ", JPEG", 32: ", MPEG-2"}.get(data[1] & 0x7F, "")
        return f"RTP of payload type {data[1] & 0x7F}{kind}: have it send H.264 or H.265"
    return (
        f"datagrams that begin with {data[:4].hex(' ')}: no MPEG-TS, no RTP and no H.264 or H.265"
    )


def _is_transport(data: bytes) -> bool:
    """Whether the datagram holds consecutive MPEG-TS packets; it may begin inside one."""
    begins = 1 if data[:1] == bytes([_SYNC]) else _PACKET
    least = 1 if begins == 1 else _LEAST_SYNCS
    return len(data) >= _PACKET and any(
        len(data[i::_PACKET]) >= least and set(data[i::_PACKET]) == {_SYNC} for i in range(begins)
    )


def rtp_payload(data: bytes) -> bytes:
    """Payload of an RTP packet; b"" for RTCP or any other datagram."""
    if len(data) <= _HEADER or data[0] >> 6 != 2 or 72 <= data[1] & 0x7F <= 76:
        return b""
    begin = _HEADER + 4 * (data[0] & 0x0F)
    if data[0] & 0x10:  # an extension: 4 bytes, the last two its length in words
        begin += 4 + 4 * int.from_bytes(data[begin + 2 : begin + 4], "big")
    end = len(data) - (data[-1] if data[0] & 0x20 else 0)  # padding
    return data[begin:end]


def _codec(unit: bytes) -> Literal["h264", "hevc"] | None:
    """Codec by the header of a NAL unit, or of an RTP packet of NAL units; None for another."""
    if len(unit) < 2 or unit[0] & 0x80:
        return None
    if not unit[0] & 0x01 and unit[1] == 1 and unit[0] >> 1 in _HEVC_TYPES:
        return "hevc"
    return "h264" if unit[0] & 0x1F in _H264_TYPES else None


class TransportStream:
    """Encodes frames of one H.265 stream as MPEG-TS (ISO/IEC 13818-1), with the tables before each,
    because FFmpeg's IVF has no H.265. An empty PES packet follows each frame: FFmpeg outputs a
    frame when the next packet begins.
    """

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


@dataclass
class RtpDepacketizer:
    """Assembles RTP packets of H.264 or H.265 to IVF or MPEG-TS, each frame with its time.

    A frame that lacks a packet, also by reordering, is dropped: a decoder would show the damage for
    seconds. sets: parameter sets of an SDP, put before the first frame.
    """

    codec: Literal["h264", "hevc"]
    sets: bytes = b""
    _begun: bool = False
    _units: list[bytes] = field(default_factory=list)
    _whole: bool = True
    _next: int | None = None  # sequence number
    _time: int | None = None  # RTP's, of the picture under way
    _since: int = 0  # RTP's times since the first picture
    _told: int | None = None  # RTP's time of the picture before
    _transport: TransportStream = field(default_factory=TransportStream)

    def add_packet(self, data: bytes) -> bytes:
        """Add an RTP packet; returns bytes for FFmpeg if it completes a frame, otherwise b""."""
        payload = rtp_payload(data)
        if not payload:
            return b""
        sequence, time = struct.unpack_from(">HI", data, 2)
        done = b"" if self._time in (None, time) else self._picture()
        if self._next not in (None, sequence):
            self._whole = False
        self._next, self._time = (sequence + 1) & 0xFFFF, time
        self._add(payload)
        if data[1] & 0x80:  # the picture's last packet
            done += self._picture()
        return done

    @property
    def is_under_way(self) -> bool:
        """Whether packets of a frame wait for the rest."""
        return self._time is not None

    def _add(self, payload: bytes) -> None:
        head = 1 if self.codec == "h264" else 2
        kind = payload[0] & 0x1F if self.codec == "h264" else payload[0] >> 1 & 0x3F
        if kind == (_H264_MANY if self.codec == "h264" else _HEVC_MANY):
            at = head
            while at + 2 <= len(payload):
                size = int.from_bytes(payload[at : at + 2], "big")
                self._units.append(_START + payload[at + 2 : at + 2 + size])
                at += 2 + size
        elif kind == (_H264_PART if self.codec == "h264" else _HEVC_PART):
            self._add_part(payload, head)
        else:
            self._units.append(_START + payload)

    def _add_part(self, payload: bytes, head: int) -> None:
        """Add a fragment of a NAL unit; its header says the unit's type and whether it is the
        first.
        """
        if len(payload) <= head:
            return
        if payload[head] & 0x80:
            if self.codec == "h264":
                header = bytes([payload[0] & 0xE0 | payload[1] & 0x1F])
            else:
                header = bytes([payload[0] & 0x81 | (payload[2] & 0x3F) << 1, payload[1]])
            self._units.append(_START + header)
        elif not self._units:
            self._whole = False
        self._units.append(payload[head + 1 :])

    def _picture(self) -> bytes:
        units, whole, time = b"".join(self._units), self._whole, self._time
        self._units, self._whole, self._time = [], True, None
        if not units or not whole or time is None:
            return b""
        if self._told is not None:
            step = (time - self._told) % _WRAP
            self._since += step - _WRAP if step > _WRAP // 2 else step
        self._told = time
        begins, self._begun = not self._begun, True
        if begins:
            units = self.sets + units
        if self.codec == "hevc":
            return self._transport.encode_frame(units, self._since)
        return (_ivf_header() if begins else b"") + _ivf_frame(units, self._since)


def _ivf_header() -> bytes:
    return struct.pack("<4sHH4sHHIIII", b"DKIF", 0, 32, b"H264", 16, 16, _RATE_HZ, 1, 0, 0)


def _ivf_frame(data: bytes, time: int) -> bytes:
    return struct.pack("<Iq", len(data), time) + data
