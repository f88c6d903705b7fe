"""Frames out of damaged streams, and signing."""

from __future__ import annotations

import os
import random
import time
from collections import deque
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.errors import SigningKeyError
from mavlink_bridge.link.framing import FrameReader
from mavlink_bridge.link.signing import create_key, load_key, signing_timestamp
from tests.mavlink_bridge.simulated import frame_of

KEY = bytes(range(32))


def frames(count: int, key: bytes | None = None, stamp: int | None = None) -> list[bytes]:
    codec = mavlink.MAVLink(None, 1, 1)
    if key is not None:
        codec.signing.secret_key = key
        codec.signing.sign_outgoing = True
        codec.signing.timestamp = signing_timestamp() if stamp is None else stamp
    result = []
    for i in range(count):
        message = mavlink.MAVLink_attitude_message(1000 + i, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
        result.append(message.pack(codec))
        codec.seq = (codec.seq + 1) % 256
    return result


@given(st.lists(st.integers(1, 40), min_size=1, max_size=60))
def test_fragments_of_any_size(cuts: list[int]) -> None:
    data = b"".join(frames(8))
    reader = FrameReader()
    got, start, i = [], 0, 0
    while start < len(data):
        size = cuts[i % len(cuts)]
        got += reader.feed(data[start : start + size])
        start, i = start + size, i + 1
    assert [m.time_boot_ms for m in got] == list(range(1000, 1008))
    assert reader.counters.bad_bytes == 0


@settings(max_examples=300)
@given(st.binary(max_size=600))
def test_garbage_between_frames_costs_no_frame(noise: bytes) -> None:
    good = frames(20)
    reader = FrameReader()
    got = reader.feed(noise + b"".join(good))
    # A marker in the noise may claim up to 280 bytes that are still to come; they come.
    got += reader.feed(b"\x00" * 300)
    assert [m.time_boot_ms for m in got] == list(range(1000, 1020))


def test_duplicated_and_lost_frames_are_counted() -> None:
    good = frames(10)
    reader = FrameReader()
    reader.feed(b"".join(good[:4] + good[7:]))
    assert reader.counters.lost == 3


def test_any_payload_of_any_message_is_decoded_or_counted() -> None:
    rng = random.Random(2)
    reader = FrameReader()
    for kind in mavlink.mavlink_map.values():
        reader.feed(frame_of(kind, rng.randbytes(kind.unpacker.size)))
    counters = reader.counters
    assert counters.messages + counters.undecodable == len(mavlink.mavlink_map)
    assert counters.messages > 0.9 * len(mavlink.mavlink_map)


def test_unwanted_messages_are_recorded_and_not_decoded() -> None:
    raw, good, reader = deque[bytes](), frames(5), FrameReader(wanted={0})
    assert reader.feed(b"".join(good), raw) == []
    assert reader.counters.skipped_messages == 5
    assert list(raw) == good


def test_only_frames_signed_with_the_key_pass() -> None:
    reader = FrameReader(key=KEY)
    assert reader.feed(b"".join(frames(2))) == []
    assert reader.feed(b"".join(frames(3, bytes(32)))) == []
    assert len(reader.feed(b"".join(frames(4, KEY)))) == 4
    assert reader.counters.unsigned == 2
    assert reader.counters.bad_signatures == 3


def test_neither_a_replay_nor_a_forged_frame_from_the_future_is_taken_or_shuts_out() -> None:
    reader = FrameReader(key=KEY)
    old, future = (signing_timestamp(time.time() + s) for s in (-3600, 86400))
    assert reader.feed(b"".join(frames(3, KEY, stamp=old))) == []
    assert reader.feed(b"".join(frames(1, bytes(32), stamp=future))) == []
    assert len(reader.feed(b"".join(frames(2, KEY)))) == 2


@pytest.mark.parametrize("stamp", [(1 << 48) - 1, 1 << 47])
def test_a_signed_stamp_of_another_age_does_not_run_ours_over(stamp: int) -> None:
    """With the right key, of a sender whose clock is broken: nobody would hear us any more."""
    reader = FrameReader(None, KEY)
    before = reader.signing_timestamp
    assert not reader.feed(frames(1, KEY, stamp)[0])
    assert (reader.signing_timestamp, reader.counters.bad_signatures) == (before, 1)


def test_key_files(tmp_path: Path) -> None:
    path = tmp_path / "key"
    assert create_key(path) == load_key(path)
    path.chmod(0o644)
    with pytest.raises(SigningKeyError, match="chmod 600"):
        load_key(path)
    path.chmod(0o600)
    wrong = {"abc": "64 hexadecimal", "ab" * 31: "31 bytes", "00" * 32: "no signing"}
    for text, why in wrong.items():
        path.write_text(text)
        with pytest.raises(SigningKeyError, match=why):
            load_key(path)
    with pytest.raises(SigningKeyError, match="cannot be read"):
        load_key(tmp_path / "missing")
    os.mkfifo(tmp_path / "pipe")
    for place in (tmp_path / "pipe", tmp_path):
        with pytest.raises(SigningKeyError, match="no file"):
            load_key(place)
