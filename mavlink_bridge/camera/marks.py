"""Markers on the ground station's map: one for each target when it is confirmed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from mavlink_bridge.camera.targets import is_confirmed
from mavlink_bridge.messages import TargetReport

_AGAIN_NS = 2_000_000_000  # a mark is said three times: it may be lost, and no one asks again
_MOST = 256  # remembered of targets that are gone, so that none that comes back is marked twice


@dataclass
class TargetMark:
    """Position of a confirmed target. left: number of times it is still to be sent."""

    report: TargetReport
    index: int
    left: int = 3
    sent_ns: int = -_AGAIN_NS


class Marks:
    """Selects the next marker to send. Of ended targets only the newest 256 are kept, because a
    detector may name any number of targets.
    """

    def __init__(self, sigma_m: float) -> None:
        self._sigma_m = sigma_m
        self._marks: dict[int, TargetMark] = {}
        self._next = 0

    def __len__(self) -> int:
        return len(self._marks)

    def due(self, targets: Mapping[int, TargetReport], now_ns: int) -> TargetMark | None:
        """The target marker to send at now_ns, or None; the marker counts as sent. A marker is made
        once a target's sigma is small enough, and is sent three times. At most one is returned, so
        that a slow port still carries the positions.
        """
        for number, report in targets.items():
            if number not in self._marks and is_confirmed(report, self._sigma_m):
                self._marks[number] = TargetMark(report, self._next)
                self._next += 1
        gone = [number for number in self._marks if number not in targets]
        for number in gone[: max(0, len(self._marks) - _MOST)]:
            del self._marks[number]
        for mark in self._marks.values():
            if mark.left and now_ns - mark.sent_ns >= _AGAIN_NS:
                mark.left, mark.sent_ns = mark.left - 1, now_ns
                return mark
        return None
