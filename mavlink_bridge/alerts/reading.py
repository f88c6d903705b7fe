"""From a STATUSTEXT back to its alert, for programs on the ground that have only the text.

For recordings (`.tlog`), the simulator's ground station and records of version 0.1. No component of
the flight process uses it: they have the alerts themselves.
"""

from __future__ import annotations

import re
from functools import cache

from mavlink_bridge.alerts.catalogue import CATALOGUE, cleared, text
from mavlink_bridge.alerts.ids import AlertId


@cache
def _patterns() -> tuple[tuple[AlertId, re.Pattern[str]], ...]:
    found = []
    for spec in CATALOGUE.values():
        fixed = re.split(r"\{[^}]*\}", spec.template)
        found.append((spec.id, re.compile(".+".join(re.escape(part) for part in fixed))))
    return tuple(found)


def alert_of(statustext: str) -> tuple[AlertId, bool] | None:
    """The alert of a text and whether it is active; None for other texts."""
    for of, pattern in _patterns():
        if pattern.fullmatch(statustext) is not None:
            return of, True
        if statustext == text(cleared(of)):
            return of, False
    return None
