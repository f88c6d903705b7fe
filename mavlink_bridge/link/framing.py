"""Extracts MAVLink frames from a byte stream and decodes them.

pymavlink's parser drops all bytes that a corrupted length field claims, and the good frames among
them. Here a frame must pass its checksum before its bytes are consumed, so only the damaged frame
is lost. Frames of messages that nobody requested are not decoded.
https://mavlink.io/en/guide/serialization.html
"""

from __future__ import annotations

import hashlib
import struct
from collections import deque
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink
from pymavlink.generator.mavcrc import x25crc

from mavlink_bridge.link import signing
from mavlink_bridge.link.signing import NO_STAMP, ReplayWindow

_V1, _V2 = 0xFE, 0xFD
_SIGNED = 0x01
_SIGNATURE_LENGTH = 13
_MAX_PENDING = 64 * 1024
_NEW_STREAM_SLACK = 60 * 100_000  # a new signing stream may lag by one minute (10 us ticks)


@dataclass
class FramingCounters:
    """Counters of one stream. skipped_messages: not in `wanted`; lost: by sequence numbers."""

    messages: int = 0
    skipped_messages: int = 0
    bad_bytes: int = 0
    bad_checksums: int = 0
    unsigned: int = 0
    bad_signatures: int = 0
    undecodable: int = 0
    lost: int = 0


class VerifyingMavlink(mavlink.MAVLink):
    """pymavlink's codec, changed to verify the signature before it uses the timestamp.

    pymavlink stores the timestamp of a frame before it checks the signature, so one forged frame
    from the future would block the real sender. window: remembers over restarts the newest
    timestamp of each stream.
    """

    window: ReplayWindow | None = None

    def check_signature(self, msgbuf: bytearray, srcSystem: int, srcComponent: int) -> bool:
        """Whether the frame is signed with our key and newer than the last accepted frame of its
        stream (link id, system, component). An accepted frame's timestamp is stored, so that the
        frame cannot be replayed.
        """
        digest = hashlib.sha256(self.signing.secret_key + bytes(msgbuf[:-6])).digest()[:6]
        if digest != bytes(msgbuf[-6:]):
            return False
        stamp = int.from_bytes(msgbuf[-12:-6], "little")
        if stamp >= NO_STAMP:
            return False  # ours begin beyond it: they would run over, and nobody would hear us
        stream = (msgbuf[-13], srcSystem, srcComponent)
        newest = self.signing.stream_timestamps.get(stream)
        if newest is None:
            newest = self.signing.timestamp - _NEW_STREAM_SLACK - 1
        if stamp <= newest:
            return False
        self.signing.stream_timestamps[stream] = stamp
        self.signing.timestamp = max(self.signing.timestamp, stamp)
        if self.window is not None:
            self.window.add_accepted(stream, stamp)
        return True


class FrameReader:
    """Decodes MAVLink messages from byte fragments of any size.

    wanted: message ids to decode; None: all. key: signing key (32 bytes), None: unsigned frames are
    accepted. window: newest timestamps of the key's streams; frames that are not newer are refused.
    """

    def __init__(
        self,
        wanted: Collection[int] | None = None,
        key: bytes | None = None,
        window: ReplayWindow | None = None,
    ) -> None:
        self.counters = FramingCounters()
        self._codec = VerifyingMavlink(None)
        self._signed = key is not None
        if key is not None:
            signing.enable(self._codec, key, 0)
        if key is not None and window is not None:
            state = self._codec.signing
            state.stream_timestamps.update(window.streams)
            # With an unset clock, too, a new stream begins where the old ones were, or later.
            state.timestamp = max(state.timestamp, window.newest)
            self._codec.window = window
        self._wanted = None if wanted is None else frozenset(wanted)
        self._buffer = bytearray()
        self._sequences: dict[tuple[int, int], int] = {}

    @property
    def signing_timestamp(self) -> int:
        """The newest time stamp of a correctly signed frame, 10 us ticks; 0 without a key."""
        return int(self._codec.signing.timestamp) if self._signed else 0

    def reset(self) -> None:
        """Drop incomplete frame and sequence numbers (transport reopened), not signing streams."""
        self._buffer.clear()
        self._sequences.clear()

    def feed(self, data: bytes, raw: deque[bytes] | None = None) -> list[Any]:
        """The wanted messages that `data` completes, without those that fail signing. All frames of
        right checksum, these too, are appended to `raw`.
        """
        buffer = self._buffer
        buffer += data
        messages: list[Any] = []
        start, size = 0, len(buffer)
        while start < size:
            magic = buffer[start]
            if magic not in (_V1, _V2):
                start += 1
                self.counters.bad_bytes += 1
                continue
            length = _frame_length(buffer, start, size)
            if length is None or start + length > size:
                break
            frame = buffer[start : start + length]
            verdict = self._check(frame)
            if not verdict:
                # Not a frame, or a damaged one: the next may begin inside it.
                self.counters.bad_bytes += 1
                start += 1
                continue
            start += length
            if raw is not None:
                raw.append(bytes(frame))
            message = self._decode(frame)
            if message is not None:
                messages.append(message)
        del buffer[:start]
        if len(buffer) > _MAX_PENDING:
            buffer.clear()
        return messages

    def _check(self, frame: bytearray) -> bool:
        """Whether the checksum is right; False for an unknown id, which cannot be checked."""
        version2 = frame[0] == _V2
        header = 10 if version2 else 6
        if version2 and frame[2] & ~_SIGNED:
            return False
        known = mavlink.mavlink_map.get(_message_id(frame))
        if known is None:
            return False
        end = header + frame[1]
        crc = x25crc(frame[1:end])
        crc.accumulate(bytes((known.crc_extra,)))
        good = frame[end] | frame[end + 1] << 8
        if crc.crc != good:
            self.counters.bad_checksums += 1
            return False
        return True

    def _decode(self, frame: bytearray) -> Any | None:
        self._count_lost(frame)
        if self._wanted is not None and _message_id(frame) not in self._wanted:
            self.counters.skipped_messages += 1
            return None
        if self._signed and not (frame[0] == _V2 and frame[2] & _SIGNED):
            self.counters.unsigned += 1
            return None
        try:
            message = self._codec.decode(frame)
        except (mavlink.MAVError, ValueError, struct.error) as error:
            if "signature" in str(error):
                self.counters.bad_signatures += 1
            else:
                self.counters.undecodable += 1
            return None
        self.counters.messages += 1
        return message

    def _count_lost(self, frame: bytearray) -> None:
        if frame[0] == _V2:
            sequence, source = frame[4], (frame[5], frame[6])
        else:
            sequence, source = frame[2], (frame[3], frame[4])
        last = self._sequences.get(source)
        if last is not None:
            self.counters.lost += (sequence - last - 1) % 256
        elif len(self._sequences) >= 256:
            self._sequences.clear()
        self._sequences[source] = sequence


def _frame_length(buffer: bytearray, start: int, size: int) -> int | None:
    """Length of the frame that begins at start; None while the bytes that state it are missing."""
    if start + 3 > size:
        return None
    if buffer[start] == _V1:
        return 8 + buffer[start + 1]
    signature = _SIGNATURE_LENGTH if buffer[start + 2] & _SIGNED else 0
    return 12 + buffer[start + 1] + signature


def _message_id(frame: bytearray) -> int:
    if frame[0] == _V2:
        return frame[7] | frame[8] << 8 | frame[9] << 16
    return frame[5]
