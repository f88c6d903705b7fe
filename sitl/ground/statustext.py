"""Assembles STATUSTEXT (253): texts longer than 50 characters come in chunks with one id."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any


@dataclass(frozen=True)
class StatusText:
    """A status text of any component, as far as its chunks have arrived."""

    time_ns: int
    severity: int
    text: str
    component: int


class TextLog:
    """Status texts in order of their first chunks; one thread fills it, any may read `lines`.

    A missing chunk is shown as three dots. An id may be used again for another text.
    """

    def __init__(self) -> None:
        self.lines: list[StatusText] = []
        self._open: dict[tuple[int, int], tuple[int, int, int]] = {}

    def add(self, message: Any, received_ns: int) -> None:
        """Add one STATUSTEXT: a new text, or the next chunk of one that is not complete."""
        source = (message.get_srcSystem(), message.get_srcComponent())
        number, chunk = message.id, message.chunk_seq
        line = StatusText(received_ns, message.severity, message.text, source[1])
        open_id, place, expected = self._open.get(source, (0, 0, 0))
        if number and number == open_id and chunk >= expected:
            gap = "..." if chunk > expected else ""
            begun = self.lines[place]
            self.lines[place] = replace(begun, text=begun.text + gap + line.text)
        else:
            place = len(self.lines)
            self.lines.append(replace(line, text="..." + line.text) if chunk else line)
        self._open[source] = (number, place, chunk + 1)
