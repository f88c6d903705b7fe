"""What the operator is told: a problem when it begins or changes, and its end."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.messages import without_figures


class Teller:
    """Remembers by topic what the operator was told, so that nothing is told twice.

    say: tell the operator (severity, text). known: topics that count as told already.
    """

    def __init__(
        self, say: Callable[[int, str], None], known: Mapping[str, str] | None = None
    ) -> None:
        self._say = say
        self._told = dict(known or {})

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

    def warn(self, text: str) -> None:
        """A warning, whatever was told before."""
        self._say(mavlink.MAV_SEVERITY_WARNING, f"PiLoT: {text}")

    def notice(self, text: str) -> None:
        """A notice, whatever was told before."""
        self._say(mavlink.MAV_SEVERITY_NOTICE, f"PiLoT: {text}")

    def inform(self, text: str) -> None:
        """An information, whatever was told before."""
        self._say(mavlink.MAV_SEVERITY_INFO, f"PiLoT: {text}")
