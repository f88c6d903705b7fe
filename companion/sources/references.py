"""Detects frames that were predicted from a lost or damaged frame.

A decoder marks a frame of which a part is missing and fills the part from the frame before. Frames
predicted from it repeat the fault without a mark (`DamageTracker`, any codec). If a whole frame is
missing, the decoder repeats the frame before and continues: what follows is sharp and unmarked, and
shows the ground as it was one frame earlier until the next key frame. H.264's `frame_num` counts
reference frames, so a gap in it shows the loss (`ReferenceTracker`; ITU-T H.264, 7.3 and 7.4.3).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

_SLICE, _IDR_SLICE, _SEI, _SPS, _PPS = 1, 5, 6, 7, 8
_INTRA = (2, 4)  # slice_type modulo 5: I and SI
_RECOVERY_POINT = 6  # SEI payload type
_HEADER = 64  # bytes of a slice that certainly hold its header up to frame_num
_START = b"\x00\x00\x01"
# With these, profile_idc says that the SPS has a chroma format and perhaps scaling lists.
_HIGH_PROFILES = frozenset({100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135})
_LONGEST_NS = 5_000_000_000
_GAPS_IN_A_ROW = 10  # no link loses every second picture for long; an encoder may count otherwise
_REGULAR_IN_A_ROW = 30  # pictures without a gap, after which it was the link


class _EndOfDataError(Exception):
    """A header that is shorter than it says."""


class _Bits:
    """Reads bits of a NAL unit's payload, whose emulation prevention bytes are taken out."""

    def __init__(self, payload: bytes) -> None:
        raw = payload.replace(b"\x00\x00\x03", b"\x00\x00")
        self._value, self._left = int.from_bytes(raw, "big"), 8 * len(raw)

    def take(self, count: int) -> int:
        """Read `count` bits as an unsigned number, u(n)."""
        if count > self._left:
            raise _EndOfDataError
        self._left -= count
        return (self._value >> self._left) & ((1 << count) - 1)

    def unsigned(self) -> int:
        """Read an Exp-Golomb number, ue(v) (9.1)."""
        zeros = 0
        while not self.take(1):
            zeros += 1
            if zeros > 32:
                raise _EndOfDataError
        return (1 << zeros) - 1 + self.take(zeros)

    def signed(self) -> int:
        """Read a signed Exp-Golomb number, se(v) (9.1.1)."""
        k = self.unsigned()
        return (k + 1) // 2 if k % 2 else -(k // 2)


@dataclass(frozen=True)
class _Sequence:
    """Fields of an SPS: size of `frame_num` in bits, and whether gaps in it are intended."""

    bits: int
    gaps_allowed: bool
    separate_planes: bool


@dataclass(frozen=True)
class _Slice:
    """Begin of a slice header. reference: other frames may be predicted from this frame."""

    frame_num: int
    intra: bool
    idr: bool
    reference: bool
    sequence: _Sequence


class DamageTracker:
    """Tracks damage from frame to frame of any codec: it spreads by prediction."""

    def __init__(self) -> None:
        self._since_ns: int | None = None
        self._has_begun = False

    def is_damaged(self, arrival_ns: int, *, marked: bool, clean: bool) -> bool:
        """Add the next decoded frame; whether it is damaged or predicted from a damaged one.

        arrival_ns: CLOCK_MONOTONIC. marked: the decoder marked the frame as damaged. clean: the
        frame is predicted from no other. After 5 s the stream counts as undamaged, because an
        encoder without key frames has refreshed all parts of the image by then.
        """
        self._has_begun = True
        waited = self._since_ns is not None and arrival_ns - self._since_ns > _LONGEST_NS
        if clean or waited:
            self._since_ns = None
        if marked and self._since_ns is None:
            self._since_ns = arrival_ns
        return marked or self._since_ns is not None

    def add_undecodable(self, arrival_ns: int) -> None:
        """A packet gave no frame: the next ones are damaged. No effect before the first frame."""
        if self._has_begun:
            self.is_damaged(arrival_ns, marked=True, clean=False)


class ReferenceTracker:
    """Follows the `frame_num` of an H.264 stream to detect lost frames; call `is_broken` for each
    packet (one frame), in order.

    extradata: SPS and PPS of the container, or b"". A stream without H.264 start codes never counts
    as broken, nor one whose encoder does not count `frame_num` as the standard demands.
    """

    def __init__(self, extradata: bytes = b"") -> None:
        self._sequences: dict[int, _Sequence] = {}
        self._sequence_of: dict[int, int] = {}
        self._last: int | None = None
        self._broken_ns: int | None = None
        self._recovers_in: int | None = None
        self._gaps_in_a_row = self._regular_in_a_row = 0
        for nal in _nal_units(extradata):
            self._learn(nal)

    def is_broken(self, packet: bytes, arrival_ns: int) -> bool:
        """Add the next packet; whether its frame is predicted from a frame that was lost.

        The damage ends with a frame that is predicted from none, after the number of frames that a
        recovery point states, and after 5 s at the latest (a stream without key frames).
        """
        slices = []
        for nal in _nal_units(packet):
            self._learn(nal)
            found = self._slice(nal)
            if found is not None:
                slices.append(found)
        if slices:
            self._follow(slices, arrival_ns)
        return self._broken_ns is not None

    def _follow(self, slices: list[_Slice], arrival_ns: int) -> None:
        first = slices[0]
        gap = self._is_gap(first)
        if self._is_numbering_unusable(gap and not first.idr):
            self._broken_ns = None
        else:
            self._update_broken(first, slices, arrival_ns, gap=gap)
        if first.reference or self._last is None:
            self._last = first.frame_num

    def _is_numbering_unusable(self, gap: bool) -> bool:
        """Whether the numbers show nothing, because 10 frames in a row were gaps."""
        if self._gaps_in_a_row < _GAPS_IN_A_ROW:
            self._gaps_in_a_row = self._gaps_in_a_row + 1 if gap else 0
            self._regular_in_a_row = 0
        else:
            self._regular_in_a_row = 0 if gap else self._regular_in_a_row + 1
            if self._regular_in_a_row >= _REGULAR_IN_A_ROW:
                self._gaps_in_a_row = 0
        return self._gaps_in_a_row >= _GAPS_IN_A_ROW

    def _update_broken(
        self, first: _Slice, slices: list[_Slice], arrival_ns: int, *, gap: bool
    ) -> None:
        if first.idr or all(s.intra for s in slices) or self._has_waited(arrival_ns):
            self._broken_ns = self._recovers_in = None
        elif gap:
            self._broken_ns, self._recovers_in = arrival_ns, None
        elif self._recovers_in is not None:
            self._recovers_in -= 1

    def _has_waited(self, arrival_ns: int) -> bool:
        if self._broken_ns is None:
            return False
        recovered = self._recovers_in is not None and self._recovers_in <= 0
        return recovered or arrival_ns - self._broken_ns > _LONGEST_NS

    def _is_gap(self, found: _Slice) -> bool:
        """Whether `frame_num` is neither the last reference frame's nor one more (7.4.3)."""
        if self._last is None or found.sequence.gaps_allowed:
            return False
        following = (self._last + 1) % (1 << found.sequence.bits)
        return found.frame_num not in (self._last, following)

    def _learn(self, nal: bytes) -> None:
        """Store the content of a parameter set or recovery point; ignore a damaged one."""
        if not nal:
            return
        kind = nal[0] & 0x1F
        try:
            if kind == _SPS:
                number, sequence = _sequence(_Bits(nal[1:]))
                self._sequences[number] = sequence
            elif kind == _PPS:
                bits = _Bits(nal[1:])
                number = bits.unsigned()
                self._sequence_of[number] = bits.unsigned()
            elif kind == _SEI and self._broken_ns is not None:
                count = _recovery_count(nal[1:])
                if count is not None and self._recovers_in is None:
                    self._recovers_in = count + 1
        except _EndOfDataError:
            return

    def _slice(self, nal: bytes) -> _Slice | None:
        kind = nal[0] & 0x1F if nal else 0
        if kind not in (_SLICE, _IDR_SLICE):
            return None
        bits = _Bits(nal[1:_HEADER])
        try:
            bits.unsigned()  # first_mb_in_slice
            slice_type = bits.unsigned() % 5
            sequence = self._sequences.get(self._sequence_of.get(bits.unsigned(), -1))
            if sequence is None:
                return None
            if sequence.separate_planes:
                bits.take(2)
            number = bits.take(sequence.bits)
        except _EndOfDataError:
            return None
        reference = bool(nal[0] & 0x60)
        return _Slice(number, slice_type in _INTRA, kind == _IDR_SLICE, reference, sequence)


def _nal_units(stream: bytes) -> Iterator[bytes]:
    """The NAL units between start codes (annex B)."""
    at = stream.find(_START)
    while at >= 0:
        begin = at + len(_START)
        at = stream.find(_START, begin)
        yield stream[begin:] if at < 0 else stream[begin:at]


def _sequence(bits: _Bits) -> tuple[int, _Sequence]:
    """Number and content of a sequence parameter set (7.3.2.1.1), up to its gap flag."""
    profile = bits.take(8)
    bits.take(16)  # constraints, level
    number = bits.unsigned()
    separate = False
    if profile in _HIGH_PROFILES:
        chroma = bits.unsigned()
        separate = chroma == 3 and bool(bits.take(1))
        bits.unsigned(), bits.unsigned(), bits.take(1)
        if bits.take(1):
            _skip_scaling(bits, 8 if chroma != 3 else 12)
    size = bits.unsigned() + 4
    order = bits.unsigned()
    if order == 0:
        bits.unsigned()
    elif order == 1:
        bits.take(1), bits.signed(), bits.signed()
        for _ in range(min(bits.unsigned(), 255)):
            bits.signed()
    bits.unsigned()  # max_num_ref_frames
    return number, _Sequence(size, bool(bits.take(1)), separate)


def _skip_scaling(bits: _Bits, lists: int) -> None:
    """Pass over scaling lists (7.3.2.1.1.1)."""
    for i in range(lists):
        if not bits.take(1):
            continue
        last = following = 8
        for _ in range(16 if i < 6 else 64):
            if following:
                following = (last + bits.signed()) % 256
            last = following or last


def _recovery_count(payload: bytes) -> int | None:
    """`recovery_frame_cnt` of the SEI messages in a NAL unit (D.1.8); None without one."""
    raw, at = payload.replace(b"\x00\x00\x03", b"\x00\x00"), 0
    while at + 2 < len(raw):
        kind, at = _extended(raw, at)
        size, at = _extended(raw, at)
        if kind == _RECOVERY_POINT:
            return _Bits(raw[at : at + size]).unsigned()
        at += size
    return None


def _extended(raw: bytes, at: int) -> tuple[int, int]:
    """Read a number that continues after each 0xFF (7.3.2.3.1); (number, index after it)."""
    value = 0
    while at < len(raw) and raw[at] == 0xFF:
        value, at = value + 255, at + 1
    if at >= len(raw):
        raise _EndOfDataError
    return value + raw[at], at + 1
