"""What happened to the vehicle that changes what its operator should do: GNSS gone, arming."""

from __future__ import annotations

from mavlink_bridge.injection.shadow import gnss_healthy
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.texts import Teller

_LOST_NS = 1_000_000_000  # beyond the freshness of a report, 1.5 s
_BACK_NS = 5_000_000_000
_HELD_NS = 10_000_000_000


class VehicleNews:
    """Looks ten times a second; one thread. Each change is told once, and only when it lasts."""

    def __init__(self, teller: Teller) -> None:
        self._teller = teller
        self._gnss: bool | None = None  # None: never seen healthy
        self._changed_ns: int | None = None
        self._armed = False
        self._held_ns: int | None = None

    def look(self, state: VehicleState, now_ns: int, *, injecting: bool) -> None:
        """Take in the vehicle's state. injecting: positions are being sent."""
        healthy = gnss_healthy(state, now_ns)
        self._follow_gnss(healthy, now_ns, injecting=injecting)
        if state.armed and not self._armed and not healthy:
            what = "injecting" if injecting else "nothing is injected"
            self._teller.warn(f"armed without GNSS, {what}")
        self._armed = state.armed

    def held(self, reason: str, now_ns: int) -> None:
        """Why fixes that come are not sent, from the interlock; empty when they are or none come.

        A score needs some seconds: what goes by itself is no news.
        """
        if not reason:
            self._held_ns = None
            return
        self._held_ns = self._held_ns or now_ns
        if now_ns - self._held_ns >= _HELD_NS:
            self._teller.tell("held", f"not sent: {reason}")

    def _follow_gnss(self, healthy: bool, now_ns: int, *, injecting: bool) -> None:
        if self._gnss is None:
            self._gnss = True if healthy else None
            return
        if healthy == self._gnss:
            self._changed_ns = None
            return
        self._changed_ns = self._changed_ns or now_ns
        if now_ns - self._changed_ns < (_BACK_NS if healthy else _LOST_NS):
            return
        self._gnss, self._changed_ns = healthy, None
        if healthy:
            self._teller.inform("GNSS is back")
        else:
            self._teller.warn(f"GNSS lost, {'injecting' if injecting else 'nothing is injected'}")
