"""Finds the alert of a STATUSTEXT, for ground programs that have only the text.

For recordings (`.tlog`), the simulator's ground station and records of version 0.1. No component of
the flight process uses it: they have the alerts themselves.
"""

import re
from functools import cache

from mavlink_bridge.alerts.catalogue import CATALOGUE, cleared, text
from mavlink_bridge.alerts.ids import AlertId

_FIELD = re.compile(r"\{(\w+)[^}]*\}")


@cache
def _patterns() -> tuple[tuple[AlertId, re.Pattern[str]], ...]:
    """Patterns, most fixed characters first: "lost" must not be read as "lost: {why}"."""
    found = [(spec.id, _pattern(spec.template)) for spec in CATALOGUE.values()]
    return tuple(sorted(found, key=lambda one: -len(_FIELD.sub("", CATALOGUE[one[0]].template))))


def _pattern(template: str) -> re.Pattern[str]:
    parts = _FIELD.split(template)  # text, name, text, name, ..., text
    made = (f"(?P<{p}>.*)" if i % 2 else re.escape(p) for i, p in enumerate(parts))
    return re.compile("".join(made))


def values_of(statustext: str) -> tuple[AlertId, dict[str, str]] | None:
    """Identifier and shown values of an active alert's text; None for other texts."""
    for of, pattern in _patterns():
        match = pattern.fullmatch(statustext)
        if match is not None:
            return of, match.groupdict()
    return None


def alert_of(statustext: str) -> tuple[AlertId, bool] | None:
    """Identifier of a text's alert, and whether the alert is active; None for other texts."""
    read = values_of(statustext)
    if read is not None:
        return read[0], True
    ended = (
        spec.id
        for spec in CATALOGUE.values()
        if spec.reports_end and text(cleared(spec.id)) == statustext
    )
    of = next(ended, None)
    return None if of is None else (of, False)
