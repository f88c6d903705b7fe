"""Sends alerts and the localizer's health to the ground station; alerts become text here."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.alerts.alert import Alert, AlertKey
from mavlink_bridge.alerts.catalogue import TEXT_LENGTH, severity, text
from mavlink_bridge.link.clock import monotonic_ns
from mavlink_bridge.messages import HealthLevel

_RELAPSE_NS = 8_000_000_000
_LONGEST_NS = 60_000_000_000
_MOST_EACH = 4


class Hysteresis:
    """Decides when a problem is over: after some time without it, and later after each relapse.

    On an overloaded computer problems come and go every second. A relapse soon after the end
    doubles the wait. A problem that recurs during the wait is not reported again.
    """

    def __init__(self, wait_s: float = 1.5) -> None:
        self._shortest_ns = self._wait_ns = int(wait_s * 1e9)
        self._bad_ns: int | None = None
        self._over_ns: int | None = None

    def is_over(self, now_ns: int, *, bad: bool) -> bool:
        """Add whether the problem exists now. True if it was absent long enough, or always."""
        if bad:
            if self._over_ns is not None:
                relapsed = now_ns - self._over_ns < _RELAPSE_NS + 2 * self._wait_ns
                longer_ns = min(2 * self._wait_ns, _LONGEST_NS)
                self._wait_ns = longer_ns if relapsed else self._shortest_ns
                self._over_ns = None
            self._bad_ns = now_ns
            return False
        if self._bad_ns is None:
            return True
        if now_ns - self._bad_ns < self._wait_ns:
            return False
        self._bad_ns, self._over_ns = None, now_ns
        return True


class StatusNotifier:
    """Remembers the last alert of each topic, so that nothing is reported twice."""

    def __init__(
        self, report: Callable[[Alert], None], known: Mapping[str, Alert | None] | None = None
    ) -> None:
        self.report = report
        """Report an alert, whatever was reported before."""
        self._reported: dict[str, Alert | None] = dict(known or {})
        self._settling: dict[str, Hysteresis] = {}
        self._since_relief: dict[str, set[AlertKey]] = {}
        self._each: dict[str, set[AlertKey]] = {}

    def reported(self, topic: str) -> Alert | None:
        """The last problem or relief of a topic; None before the first, or if it ended without."""
        return self._reported.get(topic)

    def forget(self, topic: str) -> None:
        """Forget a topic's last alert: the next one is reported even if it is equal."""
        self._reported.pop(topic, None)

    def notify(self, topic: str, problem: Alert | None, relief: Alert | None = None) -> None:
        """Report a problem when it begins or changes in more than numbers, and `relief` when it
        ends; None: no problem, or nothing to report at its end. No relief is reported before the
        first problem, except for topics in `known`. topic: any name; each has its own memory.
        """
        news, last = problem or relief, self.reported(topic)
        if (news and news.key) == (last and last.key):
            return
        is_known = topic in self._reported
        self._reported[topic] = news
        if news is not None and (problem is not None or is_known):
            self.report(news)

    def notify_each(self, topic: str, problem: Alert) -> None:
        """Report each problem of a topic once, and four of them: a forger may use many names."""
        reported = self._each.setdefault(topic, set())
        if problem.key not in reported and len(reported) < _MOST_EACH:
            reported.add(problem.key)
            self.report(problem)

    def notify_settled(
        self,
        topic: str,
        problem: Alert | None,
        relief: Alert | None,
        now_ns: int,
        *,
        wait_s: float = 1.5,
    ) -> None:
        """As `notify`, for problems that come and go: reports each problem once, then the relief
        after a time without problems (`wait_s` at first, see `Hysteresis`).
        """
        settling = self._settling.get(topic)
        if settling is None:
            settling = self._settling[topic] = Hysteresis(wait_s)
        over = settling.is_over(now_ns, bad=problem is not None)
        told = self._since_relief.setdefault(topic, set())
        if problem is not None and problem.key not in told:
            told.add(problem.key)
            self.notify(topic, problem, relief)
        elif over:
            told.clear()
            self.notify(topic, None, relief)


_log = logging.getLogger(__name__)

_KEPT = 64
_NAME_LENGTH = 10  # NAMED_VALUE_FLOAT.name
_AGAIN_NS = 10_000_000_000
_SAME_NS = 1_000_000_000  # within it the same alert is not sent twice in a row


class OperatorStatus:
    """Reports alerts and health to the operator. Thread-safe.

    send: an alert's severity and message to the ground; on_alert: every alert, for a record.
    """

    def __init__(
        self,
        send: Callable[[int, Any], None],
        on_alert: Callable[[Alert], None],
        clock: Callable[[], int] = monotonic_ns,
    ) -> None:
        self._send, self._clock = send, clock
        self._on_alert = on_alert
        self._health_lock = threading.Lock()
        self._newest_lock = threading.Lock()
        self._level = HealthLevel.STARTING
        self._settling = Hysteresis()
        self._reported_ns: dict[AlertKey, int] = {}
        self._last_reported: tuple[AlertKey, ...] = ()
        self._alerts: deque[Alert] = deque(maxlen=_KEPT)
        self._newest: tuple[int, Alert | None] = (-_SAME_NS, None)  # when it was sent

    @property
    def level(self) -> HealthLevel:
        """The localizer's health level for the heartbeats."""
        return self._level

    def set_health(self, level: HealthLevel, alerts: Sequence[Alert], *, tell: bool) -> None:
        """Set the health and all active alerts, most severe first; call it repeatedly. New alerts
        are reported (`report`) if `tell`, otherwise noted as reported.

        An alert that comes and goes is sent at most every 10 s. Its end is sent only after it has
        lasted, because an overload may begin and end every other second.
        """
        now_ns = self._clock()
        keys = tuple(alert.key for alert in alerts)
        bad = level in (HealthLevel.DEGRADED, HealthLevel.FAILED)
        with self._health_lock:
            self._level = level
            over = self._settling.is_over(now_ns, bad=bad)
            if keys == self._last_reported or not (bad or over):
                return
            due = [
                alert for alert in alerts
                if alert.key not in self._last_reported and self._is_due(alert, now_ns, bad=bad)
            ]  # fmt: skip
            sent = {alert.key for alert in due}
            # An alert that is not active any more is news when it comes back.
            self._last_reported = tuple(
                key for key in keys if not bad or key in sent or key in self._last_reported
            )
            self._reported_ns |= dict.fromkeys(sent, now_ns)
        if tell:
            for alert in due:
                self.report(alert)

    def _is_due(self, alert: Alert, now_ns: int, *, bad: bool) -> bool:
        return not bad or now_ns - self._reported_ns.get(alert.key, -_AGAIN_NS) >= _AGAIN_NS

    def report(self, alert: Alert) -> None:
        """Send an alert as STATUSTEXT, log it and pass it on. It is left out if it equals the last
        alert, with its values, and follows within a second: so many refused commands do not hide
        other alerts.
        """
        if self._is_repeated(alert, self._clock()):
            return
        self._alerts.append(alert)
        grave = severity(alert) <= mavlink.MAV_SEVERITY_WARNING
        _log.log(logging.WARNING if grave else logging.INFO, text(alert))
        self._on_alert(alert)
        self._send(severity(alert), status_text(alert))

    def _is_repeated(self, alert: Alert, now_ns: int) -> bool:
        with self._newest_lock:
            sent_ns, newest = self._newest
            if alert == newest and now_ns - sent_ns < _SAME_NS:
                return True
            self._newest = (now_ns, alert)
            return False

    def alerts(self) -> list[Alert]:
        """The last alerts, oldest first."""
        return list(self._alerts)


def status_text(alert: Alert) -> Any:
    """STATUSTEXT (253) of an alert, cut to 50 ASCII characters."""
    raw = text(alert).encode("ascii", "replace")[:TEXT_LENGTH]
    return mavlink.MAVLink_statustext_message(severity(alert), raw)


def named_values(figures: Mapping[str, float], uptime_ms: int) -> list[Any]:
    """NAMED_VALUE_FLOAT (251) of each value. ValueError for a name that is empty or longer than 10
    characters.
    """
    too_long = [name for name in figures if not 0 < len(name) <= _NAME_LENGTH]
    if too_long:
        raise ValueError(f"NAMED_VALUE_FLOAT.name holds {_NAME_LENGTH} characters: {too_long}")
    return [
        mavlink.MAVLink_named_value_float_message(uptime_ms, name.encode("ascii"), value)
        for name, value in figures.items()
    ]
