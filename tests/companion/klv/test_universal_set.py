"""EG 0104's universal set, and ST 0601 read back, against other ways to read the same bytes."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from klvdata.misb0601 import UASLocalMetadataSet
from stanag4609.klv.local_set import parse_local_set
from stanag4609.st0601 import decode_uas_local_set

from companion.klv import local_set as tag
from companion.klv.local_set import (
    ANGLE_TO_NORTH,
    OBLIQUITY,
    UNIVERSAL_SET_LABEL,
    checksum,
    decode_universal,
    encode,
)
from companion.recorded.klv_video import decode, read_klv, read_klv_packets

_SHARED = {5, 13, 14, 15, 16, 17, 21, 23, 24}
_KEYS = {  # by hand, from ST 0601.12 section 8: name, whole key, format
    tag.TIME: ("060e2b34010101010702010101050000", ">Q"),
    tag.SENSOR_LATITUDE: ("060e2b34010101030701020102040200", ">d"),
    tag.SENSOR_LONGITUDE: ("060e2b34010101030701020102060200", ">d"),
    tag.SENSOR_ALTITUDE: ("060e2b34010101010701020102020000", ">f"),
    tag.PLATFORM_HEADING: ("060e2b34010101070701100106000000", ">f"),
    tag.PLATFORM_PITCH: ("060e2b34010101070701100105000000", ">f"),
    tag.PLATFORM_ROLL: ("060e2b34010101070701100104000000", ">f"),
    tag.CENTRE_LATITUDE: ("060e2b34010101010701020103020000", ">d"),
    tag.CENTRE_LONGITUDE: ("060e2b34010101010701020103040000", ">d"),
    tag.HORIZONTAL_FOV: ("060e2b34010101020420020101080000", ">f"),
    tag.VERTICAL_FOV: ("060e2b340101010704200201010a0100", ">f"),
    tag.SLANT_RANGE: ("060e2b34010101010701080101000000", ">f"),
    ANGLE_TO_NORTH: ("060e2b34010101010701100102000000", ">f"),
    OBLIQUITY: ("060e2b34010101010701100103000000", ">f"),
}


def _by_search(packet):
    """Each key looked for in the bytes without its version, its value behind a byte of length."""
    found = {}
    for number, (key, kind) in _KEYS.items():
        at = packet.find(bytes.fromhex(key)[8:])
        if at >= 0:
            (found[number],) = struct.unpack_from(kind, packet, at + 9)
    return found


def _packet(fields):
    body = b""
    for number, value in fields.items():
        key, kind = _KEYS[number]
        packed = struct.pack(kind, value)
        body += bytes.fromhex(key) + bytes((len(packed),)) + packed
    return UNIVERSAL_SET_LABEL + b"\x82" + len(body).to_bytes(2, "big") + body


def test_a_universal_set_is_read_item_by_item():
    fields = {tag.TIME: 1_221_665_012_027_000, tag.SENSOR_LATITUDE: 38.16, OBLIQUITY: -35.25}
    assert decode_universal(_packet(fields)) == fields


@given(st.integers(min_value=0, max_value=200))
def test_a_universal_set_that_is_cut_short_is_refused(size):
    packet = _packet({tag.SENSOR_LATITUDE: 38.16, tag.SENSOR_LONGITUDE: -77.36, OBLIQUITY: -35.0})
    if size < len(packet):
        with pytest.raises(ValueError, match=r"cut short|missing|not a universal"):
            decode_universal(packet[:size])


@given(
    st.dictionaries(
        st.sampled_from([13, 15, 16, 18, 21, 75, 90]), st.floats(min_value=0.0, max_value=80.0)
    )
)
def test_a_local_set_is_read_as_it_was_written(fields):
    packet = tag.encode(1_700_000_000_000_000, fields)
    read = tag.decode(packet)
    assert read[tag.TIME] == 1_700_000_000_000_000
    for number, value in fields.items():
        assert read[number] == pytest.approx(value, abs=0.2)
    with pytest.raises(ValueError, match="checksum"):
        tag.decode(packet[:-1] + bytes((packet[-1] ^ 1,)))


@pytest.mark.real
@pytest.mark.parametrize(("clip", "count"), [("aphill_klv_10s.ts", 300), ("aphill_short.ts", 48)])
def test_a_real_flights_universal_sets(real_data, clip, count):
    packets = read_klv_packets(real_data("clips") / clip)
    assert len(packets) == count
    for _, packet in packets:
        read, expected = decode(packet), _by_search(packet)
        assert expected.keys() == _KEYS.keys()
        assert {k: read.get(k) for k in expected} == pytest.approx(expected)
    track = read_klv(real_data("clips") / clip)
    assert (len(track.samples), track.damaged) == (count, 0)
    # The ground in the image's middle lies where range and angles put it: 1 % of the range.
    fields = decode(packets[0][1])
    down = track.samples[0].view.ned_from_camera[2, 2]
    height = float(fields[tag.SENSOR_ALTITUDE]) - 0.5 * 60.0  # the ground there is at 0 to 60 m
    assert float(fields[tag.SLANT_RANGE]) * down == pytest.approx(height, rel=0.05)


@pytest.mark.real
@pytest.mark.parametrize("clip", ["h264_klv.ts", "h265_klv.ts", "mpeg2_klv.ts"])
def test_local_sets_of_other_writers(real_data, clip):
    packets = read_klv_packets(real_data("clips") / clip)
    assert len(packets) == 30
    for _, packet in packets:
        # Split by one parser, its numbers by the other: neither takes the nested sets as a whole.
        body = packet[16 + 1 + (packet[16] & 0x7F) :]
        parsers = UASLocalMetadataSet.parsers
        told = {
            item.tag: parsers[bytes((item.tag,))](bytes(item.value)).value.value
            for item in parse_local_set(body).items
            if item.tag in _SHARED
        }
        read = decode(packet)
        assert told.keys() == _SHARED
        for number in _SHARED:
            assert read[number] == pytest.approx(float(told[number]), rel=1e-4, abs=1e-3), number


# --- The encoder against an independent parser, stanag4609, field by field ----------------------


TIME_US = 1_790_000_000_123_456
FIELDS = {
    tag.MISSION: "survey 7", tag.IMAGE_SOURCE: "EO", tag.COORDINATES: "WGS-84",
    tag.PLATFORM_HEADING: 359.5, tag.PLATFORM_PITCH: -12.25, tag.PLATFORM_ROLL: 33.0,
    tag.SENSOR_LATITUDE: -33.8765432, tag.SENSOR_LONGITUDE: 151.2109876, tag.SENSOR_ALTITUDE: 612.3,
    tag.HORIZONTAL_FOV: 64.55, tag.VERTICAL_FOV: 39.2, tag.RELATIVE_AZIMUTH: 271.123456,
    tag.RELATIVE_ELEVATION: -44.987654, tag.RELATIVE_ROLL: 359.9, tag.SLANT_RANGE: 321.654,
    tag.CENTRE_LATITUDE: -33.8755, tag.CENTRE_LONGITUDE: 151.212, tag.CENTRE_ELEVATION: 455.0,
    **{tag.FIRST_CORNER_OFFSET + k: (-1) ** k * 0.00123 * (k + 1) for k in range(8)},
    tag.TARGET_LATITUDE: -33.87551, tag.TARGET_LONGITUDE: 151.21201, tag.TARGET_ELEVATION: 456.0,
    tag.TARGET_CE90: 1.5, tag.TARGET_LE90: 2.25, tag.SENSOR_HEIGHT: 660.0, tag.CENTRE_HEIGHT: 502.0,
    **{tag.FIRST_CORNER + k: (-33.8 - 0.01 * k, 151.0 + 0.01 * k)[k % 2] for k in range(8)},
    tag.PLATFORM_PITCH_FULL: -81.5, tag.PLATFORM_ROLL_FULL: 66.6,
}  # fmt: skip
COARSE = {  # half a step
    **dict.fromkeys((tag.SENSOR_LATITUDE, tag.CENTRE_LATITUDE, tag.TARGET_LATITUDE), 2.2e-8),
    **dict.fromkeys((tag.SENSOR_LONGITUDE, tag.CENTRE_LONGITUDE, tag.TARGET_LONGITUDE), 4.3e-8),
    tag.PLATFORM_HEADING: 0.003, tag.PLATFORM_PITCH: 0.0004, tag.PLATFORM_ROLL: 0.0008,
    tag.SENSOR_ALTITUDE: 0.16, tag.HORIZONTAL_FOV: 0.0014, tag.VERTICAL_FOV: 0.0014,
    tag.CENTRE_ELEVATION: 0.16, tag.TARGET_ELEVATION: 0.16, tag.SENSOR_HEIGHT: 0.16,
    tag.CENTRE_HEIGHT: 0.16, tag.TARGET_CE90: 0.032, tag.TARGET_LE90: 0.032, tag.SLANT_RANGE: 6e-4,
    **dict.fromkeys(range(26, 34), 1.2e-6),
}  # fmt: skip


def _stanag(packet):
    return {f.definition.tag: f.value for f in decode_uas_local_set(packet).fields}


def test_an_independent_parser_reads_every_field_back():
    read = _stanag(encode(TIME_US, FIELDS))
    for number, value in FIELDS.items():
        if isinstance(value, str):
            assert read[number] == value, number
        else:
            assert float(read[number]) == pytest.approx(value, abs=COARSE.get(number, 1e-7)), number
    assert set(FIELDS) <= set(read)


def test_time_version_and_checksum_as_the_parsers_check_them():
    packet = encode(TIME_US, FIELDS)
    assert round(_stanag(packet)[tag.TIME].timestamp() * 1e6) == TIME_US
    assert _stanag(packet)[tag.LOCAL_SET_VERSION] == 8
    assert packet[16] & 0x80  # long form: more than 127 bytes
    assert packet.endswith(checksum(packet[:-2]).to_bytes(2, "big"))
    broken = packet[:40] + bytes((packet[40] ^ 1,)) + packet[41:]
    with pytest.raises(Exception, match=r"(?i)checksum"):
        decode_uas_local_set(broken)


def test_what_its_tag_cannot_hold_is_left_out_and_a_wrong_tag_is_an_error():
    outside = {
        tag.SENSOR_ALTITUDE: 19000.5, tag.PLATFORM_PITCH: 20.5, tag.CENTRE_LATITUDE: float("nan"),
        tag.FIRST_CORNER_OFFSET: 0.0751, tag.MISSION: "",
    }  # fmt: skip
    assert set(_stanag(encode(TIME_US, outside))) == {1, 2, 65}
    for wrong in ({99: 1.0}, {tag.SENSOR_LATITUDE: "47"}):
        with pytest.raises(ValueError, match="ST 0601 tag"):
            encode(TIME_US, wrong)
