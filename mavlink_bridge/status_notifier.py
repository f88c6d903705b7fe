"""Reports a problem to the operator when it begins or changes, and when it ends."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from mavlink_bridge.alerts.alert import Alert, AlertKey

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
