"""MISB ST 0601 UAS Datalink Local Set: encodes numbers by tag to bytes and back (SMPTE ST 336 KLV).

Tags and ranges are those of edition 8, which all later ones keep. A value outside its tag's range
is left out, because a limit value would be wrong.

The older metadata of UAV video, the universal set of EG 0104 (Predator), is only read. Each of its
items has a key of 16 bytes; numbers are IEEE floats. It is deprecated, but cameras and archives
still contain it. Keys are in the last column of ST 0601.12, section 8.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

UNIVERSAL_LABEL = bytes.fromhex("060e2b34020b01010e01030101000000")
VERSION = 8

CHECKSUM, TIME, MISSION = 1, 2, 3
PLATFORM_HEADING, PLATFORM_PITCH, PLATFORM_ROLL = 5, 6, 7
IMAGE_SOURCE, COORDINATES = 11, 12
SENSOR_LATITUDE, SENSOR_LONGITUDE, SENSOR_ALTITUDE = 13, 14, 15
HORIZONTAL_FOV, VERTICAL_FOV = 16, 17
RELATIVE_AZIMUTH, RELATIVE_ELEVATION, RELATIVE_ROLL = 18, 19, 20
SLANT_RANGE = 21
CENTRE_LATITUDE, CENTRE_LONGITUDE, CENTRE_ELEVATION = 23, 24, 25
FIRST_CORNER_OFFSET = 26
TARGET_LATITUDE, TARGET_LONGITUDE, TARGET_ELEVATION = 40, 41, 42
TARGET_CE90, TARGET_LE90 = 45, 46
LOCAL_SET_VERSION = 65
SENSOR_HEIGHT, CENTRE_HEIGHT = 75, 78
FIRST_CORNER = 82
PLATFORM_PITCH_FULL, PLATFORM_ROLL_FULL = 90, 91


@dataclass(frozen=True)
class _Mapped:
    """Encoding of a number in `size` bytes from low to high; signed ones leave out the smallest."""

    size: int
    low: float
    high: float

    def encode(self, value: float) -> bytes | None:
        if not (math.isfinite(value) and self.low <= value <= self.high):
            return None
        if self.low < 0 and self.low == -self.high:
            top = (1 << (8 * self.size - 1)) - 1
            return round(value / self.high * top).to_bytes(self.size, "big", signed=True)
        top = (1 << 8 * self.size) - 1
        return round((value - self.low) / (self.high - self.low) * top).to_bytes(self.size, "big")

    def decode(self, data: bytes) -> float | None:
        """The number; None for another length and for the reserved "out of range" value."""
        if len(data) != self.size:
            return None
        if self.low < 0 and self.low == -self.high:
            top = (1 << (8 * self.size - 1)) - 1
            number = int.from_bytes(data, "big", signed=True)
            return None if number < -top else number / top * self.high
        top = (1 << 8 * self.size) - 1
        return self.low + int.from_bytes(data, "big") / top * (self.high - self.low)


_ALTITUDE, _ANGLE, _ERROR = _Mapped(2, -900, 19000), _Mapped(4, 0, 360), _Mapped(2, 0, 4095)
_LATITUDE, _LONGITUDE = _Mapped(4, -90, 90), _Mapped(4, -180, 180)
_MAPPED = {
    PLATFORM_HEADING: _Mapped(2, 0, 360),
    PLATFORM_PITCH: _Mapped(2, -20, 20),
    PLATFORM_ROLL: _Mapped(2, -50, 50),
    SENSOR_LATITUDE: _LATITUDE,
    SENSOR_LONGITUDE: _LONGITUDE,
    SENSOR_ALTITUDE: _ALTITUDE,
    HORIZONTAL_FOV: _Mapped(2, 0, 180),
    VERTICAL_FOV: _Mapped(2, 0, 180),
    RELATIVE_AZIMUTH: _ANGLE,
    RELATIVE_ELEVATION: _Mapped(4, -180, 180),
    RELATIVE_ROLL: _ANGLE,
    SLANT_RANGE: _Mapped(4, 0, 5e6),
    CENTRE_LATITUDE: _LATITUDE,
    CENTRE_LONGITUDE: _LONGITUDE,
    CENTRE_ELEVATION: _ALTITUDE,
    **dict.fromkeys(range(FIRST_CORNER_OFFSET, FIRST_CORNER_OFFSET + 8), _Mapped(2, -0.075, 0.075)),
    TARGET_LATITUDE: _LATITUDE,
    TARGET_LONGITUDE: _LONGITUDE,
    TARGET_ELEVATION: _ALTITUDE,
    TARGET_CE90: _ERROR,
    TARGET_LE90: _ERROR,
    SENSOR_HEIGHT: _ALTITUDE,
    CENTRE_HEIGHT: _ALTITUDE,
    **{FIRST_CORNER + k: (_LATITUDE, _LONGITUDE)[k % 2] for k in range(8)},
    PLATFORM_PITCH_FULL: _Mapped(4, -90, 90),
    PLATFORM_ROLL_FULL: _Mapped(4, -90, 90),
}
_TEXTS = frozenset((MISSION, IMAGE_SOURCE, COORDINATES))
_LONGEST_TEXT = 127


def encode(time_us: int, fields: Mapping[int, float | str]) -> bytes:
    """Encode one packet: universal label, length, time, the fields by tag, checksum.

    time_us: microseconds since 1970-01-01. fields: values by tag in ST 0601's units; one out of its
    tag's range is left out. ValueError for a tag that is not known here.
    """
    body = _item(TIME, time_us.to_bytes(8, "big"))
    for tag, value in sorted({**fields, LOCAL_SET_VERSION: VERSION}.items()):
        encoded = _encoded(tag, value)
        if encoded is not None:
            body += _item(tag, encoded)
    length = len(body) + 4  # the checksum's own item
    packet = UNIVERSAL_LABEL + _length(length) + body + bytes((CHECKSUM, 2))
    return packet + checksum(packet).to_bytes(2, "big")


def decode(packet: bytes) -> dict[int, float | str | int]:
    """Decode a packet to values by tag, `TIME` in microseconds; unknown tags are left out.

    ValueError for another label, a packet that is cut short, or a wrong checksum; a packet without
    a checksum is read.
    """
    if packet[:16] != UNIVERSAL_LABEL:
        raise ValueError("not a local set of ST 0601")
    length, at = read_length(packet, 16)
    end = at + length
    if end > len(packet):
        raise ValueError("the local set is cut short")
    fields: dict[int, float | str | int] = {}
    while at < end:
        number, at = _read_tag(packet, at)
        size, at = read_length(packet, at)
        value = packet[at : at + size]
        if number == CHECKSUM and checksum(packet[:at]) != int.from_bytes(value, "big"):
            raise ValueError("the local set's checksum is wrong")
        decoded = _decoded(number, value)
        if decoded is not None:
            fields[number] = decoded
        at += size
    return fields


def read_length(data: bytes, at: int) -> tuple[int, int]:
    """Decode a BER length at index `at`; returns it and the index after it. ValueError if it is cut
    short.
    """
    if at >= len(data):
        raise ValueError("a length is missing")
    first = data[at]
    if first < 0x80:
        return first, at + 1
    size = first & 0x7F
    if at + 1 + size > len(data):
        raise ValueError("a length is cut short")
    return int.from_bytes(data[at + 1 : at + 1 + size], "big"), at + 1 + size


def _read_tag(data: bytes, at: int) -> tuple[int, int]:
    """Decode a BER-OID tag; returns it and the index after it."""
    number = 0
    while at < len(data):
        number = number << 7 | data[at] & 0x7F
        at += 1
        if data[at - 1] < 0x80:
            return number, at
    raise ValueError("a tag is cut short")


def _decoded(number: int, value: bytes) -> float | str | int | None:
    if number == TIME:
        return int.from_bytes(value, "big") if len(value) == 8 else None
    if number in _TEXTS:
        return value.decode("utf-8", "replace")
    if number == LOCAL_SET_VERSION:
        return int.from_bytes(value, "big")
    return _MAPPED[number].decode(value) if number in _MAPPED else None


def checksum(data: bytes) -> int:
    """The 16-bit running sum over a packet from its label to the checksum's length (ST 0601, tag
    1).
    """
    return (sum(data[0::2]) * 256 + sum(data[1::2])) & 0xFFFF


def _encoded(tag: int, value: float | str) -> bytes | None:
    if isinstance(value, str):
        if tag not in _TEXTS:
            raise ValueError(f"ST 0601 tag {tag} is no text here")
        return value.encode("utf-8")[:_LONGEST_TEXT] or None
    if tag == LOCAL_SET_VERSION:
        return bytes((int(value),))
    if tag not in _MAPPED:
        raise ValueError(f"ST 0601 tag {tag} is not known here")
    return _MAPPED[tag].encode(value)


def _item(tag: int, value: bytes) -> bytes:
    """Encode tag, length and value; tags up to 127 are one byte (BER-OID)."""
    return bytes((tag,)) + _length(len(value)) + value


def _length(n: int) -> bytes:
    """Encode a BER length: short form up to 127, else the number of bytes and then these."""
    if n < 128:
        return bytes((n,))
    size = (n.bit_length() + 7) // 8
    return bytes((0x80 | size,)) + n.to_bytes(size, "big")


UNIVERSAL_SET_LABEL = bytes.fromhex("060e2b34020101010e01010201010000")
ANGLE_TO_NORTH, OBLIQUITY = -1, -2  # have no tag in ST 0601
_PREFIX = bytes.fromhex("060e2b34010101")
_COMPARED = slice(8, 16)  # byte 8 is the registry's version, which programs write differently

# The second half of the key: tags of ST 0601 for the same quantity.
_FIELDS = {
    "0702010101050000": TIME,
    "0105050000000000": MISSION,
    "0701100106000000": PLATFORM_HEADING,
    "0701100105000000": PLATFORM_PITCH,
    "0701100104000000": PLATFORM_ROLL,
    "0420010201010000": IMAGE_SOURCE,
    "0701010100000000": COORDINATES,
    "0701010101000000": COORDINATES,
    "0701020102040200": SENSOR_LATITUDE,
    "0701020102060200": SENSOR_LONGITUDE,
    "0701020102020000": SENSOR_ALTITUDE,
    "0420020101080000": HORIZONTAL_FOV,
    "04200201010a0100": VERTICAL_FOV,
    "0701080101000000": SLANT_RANGE,
    "0701020103020000": CENTRE_LATITUDE,
    "0701020103040000": CENTRE_LONGITUDE,
    "0701020103160000": CENTRE_ELEVATION,
    "0701100101000000": RELATIVE_ROLL,
    "0701100102000000": ANGLE_TO_NORTH,
    "0701100103000000": OBLIQUITY,
}
_BY_KEY = {bytes.fromhex(key): number for key, number in _FIELDS.items()}


def decode_universal(packet: bytes) -> dict[int, float | str | int]:
    """Values of a packet by ST 0601 tag (plus `ANGLE_TO_NORTH`, `OBLIQUITY`), degrees and metres.

    Unknown items are left out. ValueError for another label or a packet that is cut short.
    """
    if packet[:16] != UNIVERSAL_SET_LABEL:
        raise ValueError("not a universal set of EG 0104")
    length, begin = read_length(packet, 16)
    if begin + length > len(packet):
        raise ValueError("the universal set is cut short")
    fields: dict[int, float | str | int] = {}
    for key, value in _items(packet[begin : begin + length]):
        number = _BY_KEY.get(key[_COMPARED]) if key.startswith(_PREFIX) else None
        decoded = None if number is None else _value(number, value)
        if number is not None and decoded is not None:
            fields[number] = decoded
    return fields


def _items(body: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = 0
    while at + 17 <= len(body):
        length, begin = read_length(body, at + 16)
        if begin + length > len(body):
            raise ValueError("an item of the universal set is cut short")
        yield body[at : at + 16], body[begin : begin + length]
        at = begin + length


def _value(number: int, value: bytes) -> float | str | int | None:
    if number == TIME:
        return int.from_bytes(value, "big") if len(value) == 8 else None
    if number in _TEXTS:
        return value.decode("utf-8", "replace").strip("\x00 ")
    kind = {4: ">f", 8: ">d"}.get(len(value))
    if kind is None:
        return None
    (decoded,) = struct.unpack(kind, value)
    return float(decoded) if abs(decoded) < 1e9 else None  # NaN and fillers are no measurement
