"""Raises and clears alerts after a delay, so that they do not alternate.

Alerts that inhibit injection survive a restart, because the evidence for them (a turn, a climb) may
return only after minutes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mavlink_bridge.alerts.alert import Alert, AlertSpec, Inhibits
from mavlink_bridge.alerts.catalogue import CATALOGUE, cleared
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import CalibrationError, Name
from mavlink_bridge.injection.restart_memory import RestartMemory

_LARGEST = 1e4  # per cent, degrees, milliseconds; of what is kept


@dataclass(frozen=True)
class CheckResult:
    """Result of a check. bad: True raises the alert, False clears it; None: no evidence, nothing
    changes. figure, word: values for the alert's text, such as metres and a direction.
    """

    bad: bool | None
    figure: float = 0.0
    word: CalibrationError | Name | None = None


class AlertDebouncer:
    """Raises an alert after `spec.raise_s` of bad results and clears it after `spec.clear_s` of
    good ones. Time without evidence counts for neither, and no alert is repeated during it.
    """

    def __init__(self, spec: AlertSpec) -> None:
        self.spec = spec
        self.raised = False
        self.figure = 0.0
        self.word: CalibrationError | Name | None = None
        self._since_ns: int | None = None
        self._updated_ns = 0
        self._reported_ns = 0

    def update(self, now_ns: int, result: CheckResult) -> Alert | None:
        """Add a check's result at now_ns; returns the alert to report now, if any. An alert is
        raised after the result was bad for `raise_s`, cleared after it was good for `clear_s`, and
        repeated while it lasts. A result without evidence (bad is None) changes nothing, and its
        time does not count.
        """
        silent_ns, self._updated_ns = now_ns - self._updated_ns, now_ns
        if result.bad is None:
            if not self.raised:
                self._since_ns = None
            elif self._since_ns is not None:
                self._since_ns += silent_ns
            return None
        if result.bad:
            self.figure, self.word = result.figure, result.word
        if result.bad == self.raised:
            self._since_ns = None
            return self._again(now_ns)
        if self._since_ns is None:
            self._since_ns = now_ns
        wait_s = self.spec.clear_s if self.raised else self.spec.raise_s
        if now_ns - self._since_ns < wait_s * 1e9:
            return self._again(now_ns)
        self._since_ns, self.raised, self._reported_ns = None, not self.raised, now_ns
        return self.alert() if self.raised else cleared(self.spec.id)

    def restore(self, figure: float, word: CalibrationError) -> None:
        """Activate the alert as before a restart, without a report; evidence clears it as usual."""
        self.raised, self.figure, self.word = True, figure, word

    def alert(self) -> Alert:
        """The alert with its newest values, whether active or not."""
        values = (self.figure,) if self.word is None else (self.figure, self.word)
        return Alert(self.spec.id, values[: len(self.spec.values)])

    def _again(self, now_ns: int) -> Alert | None:
        repeats = self.raised and self.spec.repeat_s > 0.0
        if not repeats or now_ns - self._reported_ns < self.spec.repeat_s * 1e9:
            return None
        self._reported_ns = now_ns
        return self.alert()


ActiveAlerts = Mapping[AlertId, tuple[float, CalibrationError]]
"""Figure and word of active alerts."""


class InhibitMemory(RestartMemory):
    """Remembers over a restart the active alerts that inhibit injection."""

    _kept: frozenset[AlertId] = frozenset()

    def recall(self) -> ActiveAlerts:
        """The alerts that were active before the restart; empty after a clean shutdown."""
        kept = self.recall_state()
        kept_alerts = None if kept is None else kept[0].get("inhibits")
        rows = kept_alerts.items() if isinstance(kept_alerts, dict) else ()
        known = {spec.id.value: spec.id for spec in CATALOGUE.values()
                 if Inhibits.INJECTION in spec.inhibits}  # fmt: skip
        found = {known[name]: row for name, values in rows
                 if name in known and (row := _parse_row(values))}  # fmt: skip
        self.store(found)
        return found

    def store(self, found: ActiveAlerts) -> None:
        """Store the active alerts, if others than at the last call; with none, drop the memory."""
        if found.keys() == self._kept:
            return
        self._kept = frozenset(found)
        if found:
            self.store_state({"inhibits": {of.value: row for of, row in found.items()}})
        else:
            self.drop()


def _parse_row(value: Any) -> tuple[float, CalibrationError] | None:
    if not isinstance(value, list) or len(value) != 2:
        return None
    figure, word = value
    if not isinstance(figure, float) or not abs(figure) <= _LARGEST:
        return None
    sense = next((one for one in CalibrationError if one.value == word), None)
    return None if sense is None else (figure, sense)
