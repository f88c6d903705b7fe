"""Reads the older metadata of UAV video: the universal set of EG 0104 (Predator).

Each item has a key of 16 bytes; numbers are IEEE floats. The set is deprecated, but cameras and
archives still contain it. Keys are in the last column of ST 0601.12, section 8.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

from companion.klv import local_set as tag

UNIVERSAL_SET_LABEL = bytes.fromhex("060e2b34020101010e01010201010000")
ANGLE_TO_NORTH, OBLIQUITY = -1, -2  # have no tag in ST 0601
_PREFIX = bytes.fromhex("060e2b34010101")
_COMPARED = slice(8, 16)  # byte 8 is the registry's version, which programs write differently

# The second half of the key: tags of ST 0601 for the same quantity.
_FIELDS = {
    "0702010101050000": tag.TIME,
    "0105050000000000": tag.MISSION,
    "0701100106000000": tag.PLATFORM_HEADING,
    "0701100105000000": tag.PLATFORM_PITCH,
    "0701100104000000": tag.PLATFORM_ROLL,
    "0420010201010000": tag.IMAGE_SOURCE,
    "0701010100000000": tag.COORDINATES,
    "0701010101000000": tag.COORDINATES,
    "0701020102040200": tag.SENSOR_LATITUDE,
    "0701020102060200": tag.SENSOR_LONGITUDE,
    "0701020102020000": tag.SENSOR_ALTITUDE,
    "0420020101080000": tag.HORIZONTAL_FOV,
    "04200201010a0100": tag.VERTICAL_FOV,
    "0701080101000000": tag.SLANT_RANGE,
    "0701020103020000": tag.CENTRE_LATITUDE,
    "0701020103040000": tag.CENTRE_LONGITUDE,
    "0701020103160000": tag.CENTRE_ELEVATION,
    "0701100101000000": tag.RELATIVE_ROLL,
    "0701100102000000": ANGLE_TO_NORTH,
    "0701100103000000": OBLIQUITY,
}
_BY_KEY = {bytes.fromhex(key): number for key, number in _FIELDS.items()}
_TEXTS = frozenset((tag.MISSION, tag.IMAGE_SOURCE, tag.COORDINATES))


def decode_universal(packet: bytes) -> dict[int, float | str | int]:
    """Values of a packet by ST 0601 tag (plus `ANGLE_TO_NORTH`, `OBLIQUITY`), degrees and metres.

    Unknown items are left out. ValueError for another label or a packet that is cut short.
    """
    if packet[:16] != UNIVERSAL_SET_LABEL:
        raise ValueError("not a universal set of EG 0104")
    length, begin = tag.read_length(packet, 16)
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
        length, begin = tag.read_length(body, at + 16)
        if begin + length > len(body):
            raise ValueError("an item of the universal set is cut short")
        yield body[at : at + 16], body[begin : begin + length]
        at = begin + length


def _value(number: int, value: bytes) -> float | str | int | None:
    if number == tag.TIME:
        return int.from_bytes(value, "big") if len(value) == 8 else None
    if number in _TEXTS:
        return value.decode("utf-8", "replace").strip("\x00 ")
    kind = {4: ">f", 8: ">d"}.get(len(value))
    if kind is None:
        return None
    (decoded,) = struct.unpack(kind, value)
    return float(decoded) if abs(decoded) < 1e9 else None  # NaN and fillers are no measurement
