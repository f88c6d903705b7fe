"""What the operator is told: a problem when it begins or changes, and its end."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.messages import without_figures

_RELAPSE_NS = 8_000_000_000


class Hysteresis:
    """Good news that may not last: told after a while without trouble, later with each relapse.

    An overloaded computer is well and ill by turns, every second. Each relapse soon after
    doubles the wait, and what recurs meanwhile counts as the same trouble: it was told.
    """

    def __init__(self, wait_s: float = 1.5, longest_s: float = 60.0) -> None:
        self._shortest_ns = self._wait_ns = int(wait_s * 1e9)
        self._longest_ns = int(longest_s * 1e9)
        self._bad_ns: int | None = None
        self._over_ns: int | None = None

    def is_over(self, now_ns: int, *, bad: bool) -> bool:
        """Take in whether there is trouble now; whether there is and was none for long enough."""
        if bad:
            if self._over_ns is not None:
                relapsed = now_ns - self._over_ns < _RELAPSE_NS + 2 * self._wait_ns
                longer_ns = min(2 * self._wait_ns, self._longest_ns)
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
    """Remembers by topic what the operator was told, so that nothing is told twice.

    say: tell the operator (severity, text). known: topics that count as told already.
    """

    def __init__(
        self, say: Callable[[int, str], None], known: Mapping[str, str] | None = None
    ) -> None:
        self._say = say
        self._told = dict(known or {})
        self._settling: dict[str, Hysteresis] = {}
        self._since_relief: dict[str, set[str]] = {}

    def told(self, topic: str) -> str:
        """What was told last of a topic, without its figures; empty when all is well."""
        return self._told.get(topic, "")

    def forget(self, topic: str) -> None:
        """The next text of a topic is told whatever it says."""
        self._told.pop(topic, None)

    def tell(self, topic: str, problem: str, relief: str = "", *, prefix: str = "") -> None:
        """A problem when it begins or changes (digits aside, or it would never stop), and its end.

        prefix: part of what is compared, not of what is said.
        """
        plain = f"{prefix if not problem else ''}{without_figures(problem)}"
        if plain == self.told(topic):
            return
        known = topic in self._told
        self._told[topic] = plain
        if problem:
            self.warn(problem)
        elif relief and known and prefix in ("", "inject"):
            self.inform(relief)

    def tell_settled(
        self,
        topic: str,
        problem: str,
        relief: str,
        now_ns: int,
        *,
        prefix: str = "",
        wait_s: float = 1.5,
    ) -> None:
        """As `tell`, for what comes and goes: each problem once until the relief, and that only
        once it has lasted, `wait_s` the first time.
        """
        settling = self._settling.setdefault(topic, Hysteresis(wait_s))
        over = settling.is_over(now_ns, bad=bool(problem))
        told = self._since_relief.setdefault(topic, set())
        if problem and without_figures(problem) not in told:
            told.add(without_figures(problem))
            self.tell(topic, problem, relief, prefix=prefix)
        elif over:
            told.clear()
            self.tell(topic, "", relief, prefix=prefix)

    def warn(self, text: str) -> None:
        """A warning, whatever was told before."""
        self._say(mavlink.MAV_SEVERITY_WARNING, f"PiLoT: {text}")

    def notice(self, text: str) -> None:
        """A notice, whatever was told before."""
        self._say(mavlink.MAV_SEVERITY_NOTICE, f"PiLoT: {text}")

    def inform(self, text: str) -> None:
        """An information, whatever was told before."""
        self._say(mavlink.MAV_SEVERITY_INFO, f"PiLoT: {text}")
