"""The lines for the operator and the localizer's health, as they go to the ground side."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import severity
from mavlink_bridge.alerts.catalogue import text as alert_text
from mavlink_bridge.link.clock import monotonic_ns
from mavlink_bridge.messages import HealthLevel, without_figures
from mavlink_bridge.status_notifier import Hysteresis

_log = logging.getLogger(__name__)

_TEXTS = 64
_TEXT_LENGTH = 50  # STATUSTEXT.text
_NAME_LENGTH = 10  # NAMED_VALUE_FLOAT.name
_MAX_CHUNKS = 4
_AGAIN_NS = 10_000_000_000
_SAME_NS = 1_000_000_000  # within it the same line is not said twice in a row
_SEVERITY = {
    HealthLevel.STARTING: mavlink.MAV_SEVERITY_INFO,
    HealthLevel.OK: mavlink.MAV_SEVERITY_INFO,
    HealthLevel.DEGRADED: mavlink.MAV_SEVERITY_WARNING,
    HealthLevel.FAILED: mavlink.MAV_SEVERITY_ERROR,
}


class OperatorStatus:
    """Tells the operator. Every method may be called from any thread.

    send: a line's severity and message to the ground; on_text: every line (severity, text, its
    alert), for a
    record.
    """

    def __init__(
        self,
        send: Callable[[int, Any], None],
        on_text: Callable[[int, str, Alert | None], None],
        clock: Callable[[], int] = monotonic_ns,
    ) -> None:
        self._send, self._clock = send, clock
        self._on_text = on_text
        self._health_lock = threading.Lock()
        self._text_lock = threading.Lock()
        self._health = (HealthLevel.STARTING, "")
        self._settling = Hysteresis()
        self._told_ns: dict[tuple[HealthLevel, str], int] = {}
        self._last_told = self._health
        self._texts: deque[tuple[int, str]] = deque(maxlen=_TEXTS)
        self._newest = (-_SAME_NS, 0, "")  # line, and when it was said
        self._text_id = 0

    @property
    def level(self) -> HealthLevel:
        """The localizer's health, as the heartbeats tell it."""
        return self._health[0]

    def set_health(
        self, level: HealthLevel, text: str, *, tell: bool, now_ns: int | None = None
    ) -> None:
        """A change of level or text (but for its figures) is told, if at all; to be called again
        and again.

        What comes and goes by turns is told once in 10 s, and its end once it has lasted: an
        overloaded computer is well and ill every other second. now_ns: CLOCK_MONOTONIC.
        """
        now_ns = self._clock() if now_ns is None else now_ns
        key = (level, without_figures(text))
        bad = level in (HealthLevel.DEGRADED, HealthLevel.FAILED)
        with self._health_lock:
            self._health = key
            over = self._settling.is_over(now_ns, bad=bad)
            lately = now_ns - self._told_ns.get(key, -_AGAIN_NS) < _AGAIN_NS
            news = key != self._last_told and (not lately if bad else over)
            if news:
                self._last_told, self._told_ns[key] = key, now_ns
        if news and tell:
            self.say(_SEVERITY[level], f"PiLoT: {text or level.value}", now_ns)

    def report(self, alert: Alert, now_ns: int | None = None) -> None:
        """An alert: its text, and the alert itself for who records it. As `say`."""
        self.say(severity(alert), alert_text(alert), now_ns, alert)

    def say(
        self, severity: int, text: str, now_ns: int | None = None, alert: Alert | None = None
    ) -> None:
        """STATUSTEXT, and the log. A line that is said again within a second is left out: a flood
        of orders that are refused would hide every other, and wear out the link and the record. One
        after another line is no repetition: "on" after "off" tells how it stands.
        """
        if self._was_said(severity, text, self._clock() if now_ns is None else now_ns):
            return
        self._texts.append((severity, text))
        grave = severity <= mavlink.MAV_SEVERITY_WARNING
        _log.log(logging.WARNING if grave else logging.INFO, text)
        self._on_text(severity, text, alert)
        with self._text_lock:  # two threads' texts under one id would be mixed at the receiver
            self._text_id = text_id = self._text_id % 0xFFFF + 1
        for message in status_texts(severity, text, text_id):
            self._send(severity, message)

    def _was_said(self, severity: int, text: str, now_ns: int) -> bool:
        with self._text_lock:
            said_ns, *line = self._newest
            if line == [severity, text] and now_ns - said_ns < _SAME_NS:
                return True
            self._newest = (now_ns, severity, text)
            return False

    def texts(self) -> list[str]:
        """The last lines, oldest first."""
        return [text for _, text in list(self._texts)]


def status_texts(severity: int, text: str, text_id: int) -> list[Any]:
    """STATUSTEXT (253) of a line, in chunks of 50 characters under one id where it is longer."""
    raw = text.encode("ascii", "replace")[: _MAX_CHUNKS * _TEXT_LENGTH]
    chunks = [raw[i : i + _TEXT_LENGTH] for i in range(0, max(len(raw), 1), _TEXT_LENGTH)]
    if len(chunks) == 1:
        return [mavlink.MAVLink_statustext_message(severity, raw)]
    if len(chunks[-1]) == _TEXT_LENGTH:
        # A receiver knows the end by a chunk that is not full.
        chunks.append(b"")
    return [
        mavlink.MAVLink_statustext_message(severity, chunk, text_id, i)
        for i, chunk in enumerate(chunks)
    ]


def named_values(figures: Mapping[str, float], uptime_ms: int) -> list[Any]:
    """NAMED_VALUE_FLOAT (251) of each figure; a name holds 10 characters."""
    too_long = [name for name in figures if not 0 < len(name) <= _NAME_LENGTH]
    if too_long:
        raise ValueError(f"NAMED_VALUE_FLOAT.name holds {_NAME_LENGTH} characters: {too_long}")
    return [
        mavlink.MAVLink_named_value_float_message(uptime_ms, name.encode("ascii"), value)
        for name, value in figures.items()
    ]
