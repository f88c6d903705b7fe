"""Gives targets of different detectors different names."""

from __future__ import annotations

import logging
from collections import OrderedDict
from dataclasses import dataclass, field

_log = logging.getLogger(__name__)
_SILENT_NS = 10_000_000_000  # a sender unheard for so long is gone; its name is free
_NAMES, _SENDERS = 256, 8  # remembered: of one name, so many senders
_LONGEST = 58  # of a name, before what tells the sender

Address = tuple[str, int]


@dataclass
class _Named:
    """Senders of a name. numbers: of their targets, from 1; heard_ns: when each was heard last."""

    numbers: dict[Address, int] = field(default_factory=dict)
    heard_ns: dict[Address, int] = field(default_factory=dict)
    newest: Address | None = None
    count: int = 1


class Senders:
    """Gives targets of several senders different names. Not thread-safe.

    A new sender takes a name over: it may be a detector that was restarted, or one that opens a
    socket for each datagram. If the earlier sender sends this name again, there are two senders.
    The targets of the later one then get its number: "car #2".
    """

    def __init__(self) -> None:
        self._names: OrderedDict[str, _Named] = OrderedDict()

    def name_of(self, target_id: str, sender: Address, now_ns: int) -> str:
        """The name of a detection's target; to be called for each detection. If several senders use
        the same target_id, each gets a target of its own, whose name has a number. now_ns:
        CLOCK_MONOTONIC.
        """
        named = self._names.setdefault(target_id, _Named())
        self._names.move_to_end(target_id)
        if len(self._names) > _NAMES:
            self._names.popitem(last=False)
        self._forget(named, now_ns)
        newest = named.newest
        if sender not in named.numbers:
            named.numbers[sender] = named.numbers.get(newest, 1) if newest is not None else 1
        elif newest is not None and newest != sender:
            self._split(target_id, named, newest, named.numbers[sender])
        named.heard_ns[sender], named.newest = now_ns, sender
        number = named.numbers[sender]
        return target_id if number == 1 else f"{target_id[:_LONGEST]} #{number}"

    @staticmethod
    def _split(target_id: str, named: _Named, other: Address, number: int) -> None:
        """Give the `other` sender its own number, because both use the name in turn."""
        if named.numbers.get(other) != number:
            return
        named.count += 1
        named.numbers[other] = named.count
        if named.count == 2:
            _log.warning(
                "targets.detections: %s:%d and another name a target %r: its is %r from now on",
                *other, target_id, f"{target_id[:_LONGEST]} #2",
            )  # fmt: skip

    @staticmethod
    def _forget(named: _Named, now_ns: int) -> None:
        """Remove the senders that are silent for 10 s, and the oldest of more than 8."""
        by_age = sorted(named.heard_ns, key=lambda a: -named.heard_ns[a])
        for k, sender in enumerate(by_age):
            if k >= _SENDERS or now_ns - named.heard_ns[sender] > _SILENT_NS:
                del named.heard_ns[sender], named.numbers[sender]
                named.newest = None if named.newest == sender else named.newest
        if not named.numbers:
            named.count = 1
