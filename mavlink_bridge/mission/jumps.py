"""Follows DO_JUMP and DO_JUMP_TAG as AP_Mission does, up to a number of repetitions."""

from __future__ import annotations

import math
from collections.abc import Sequence

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.mission.items import MissionItem, UnreadItem

JUMPS = (mavlink.MAV_CMD_DO_JUMP, mavlink.MAV_CMD_DO_JUMP_TAG)
_MOST_REPEATS = 10  # of one jump; every round is alike
_MOST_IN_A_ROW = 64  # without a command between them (AP_Mission::get_next_cmd)
_FOREVER = -1


class Jumps:
    """Follows jumps. notes: differences from the flight, such as limited repetitions."""

    def __init__(self, items: Sequence[MissionItem | UnreadItem]) -> None:
        self._items = items
        self._index_of = {item.number: k for k, item in enumerate(items)}
        self._runs: dict[int, int] = {}
        self._in_a_row: tuple[int, int] = (-1, 0)  # a count of commands, and of jumps since
        self.notes: dict[str, None] = {}

    def following(self, item: MissionItem, index: int, commands: int) -> int | None:
        """Index of the item to continue with after executing the jump `item` at `index`, which is
        counted; None if the mission ends. commands: number of other commands executed so far, to
        detect jumps in a circle.
        """
        last, jumps = self._in_a_row
        self._in_a_row = (commands, jumps + 1 if last == commands else 1)
        target = self._target(item)
        if target is None or self._in_a_row[1] > _MOST_IN_A_ROW:
            self._note(f"{item.label} leads nowhere: the mission ends there.")
            return None
        count, done = item.parameters[1], self._runs.get(index, 0)
        times = int(count) if math.isfinite(count) else 0
        if times == _FOREVER and done:
            self._note(
                f"{item.label} repeats without end: one round more is judged, and what follows the "
                "jump is never reached."
            )
            return None
        if times != _FOREVER and done >= min(times, _MOST_REPEATS):
            if times > _MOST_REPEATS:
                self._note(
                    f"{item.label} repeats {times} times: {_MOST_REPEATS} rounds are counted, all "
                    "are alike."
                )
            self._runs[index] = 0  # AP_Mission begins to count again
            return index + 1
        self._runs[index] = done + 1
        return target

    def _note(self, text: str) -> None:
        self.notes[text] = None

    def _target(self, item: MissionItem) -> int | None:
        number = item.parameters[0]
        if not math.isfinite(number):
            return None
        if item.command == mavlink.MAV_CMD_DO_JUMP_TAG:
            tags = (
                k
                for k, other in enumerate(self._items)
                if isinstance(other, MissionItem)
                and other.command == mavlink.MAV_CMD_JUMP_TAG
                and other.parameters[0] == number
            )
            return next(tags, None)
        return self._index_of.get(int(number))
