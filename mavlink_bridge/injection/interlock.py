"""The shadow interlock: vision must agree with GNSS before its positions are injected.

The EKF accepts a map with a 20 m offset without a warning. While there is GNSS, nothing is sent
before the shadow check has passed. Without GNSS from the start (an indoor vehicle, a restart)
vision cannot be compared; injection then begins with an alert.
"""

from __future__ import annotations

from collections.abc import Callable

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import CATALOGUE, alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.config import BridgeConfig, Mode
from mavlink_bridge.injection.restart_memory import ShadowFailureMemory
from mavlink_bridge.injection.shadow import MINIMUM_SAMPLES, ShadowScore, gnss_healthy
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.status_notifier import StatusNotifier

_PERIOD_NS = 1_000_000_000
_WITHOUT_GNSS_NS = 2_000_000_000  # GPS_RAW_INT comes five times a second
_BEFORE_LAST_NS = 30_000_000_000  # a jammed receiver spoils the score's end
_GO_NS = 600_000_000_000


class ShadowInterlock:
    """Decides at each step whether fixes may be injected; one thread.

    score: gives the result of the shadow check at a time. compared_ns: when a fix was last compared
    with GNSS, 0 if never. inhibited_by: active alerts that inhibit injection. A failed shadow check
    is kept over a restart, beside `state_file`.
    """

    def __init__(
        self,
        config: BridgeConfig,
        score: Callable[[int], ShadowScore],
        compared_ns: Callable[[], int],
        notifier: StatusNotifier,
    ) -> None:
        self._force, file = config.injection.force, config.state_file
        self._memory: ShadowFailureMemory | None = None
        if file is not None:
            self._memory = ShadowFailureMemory(file.with_name("shadow-no-go.json"))
        self._score = score
        self._compared_ns = compared_ns
        self._notifier = notifier
        self.inhibited_by: frozenset[AlertId] = frozenset()
        self._next_ns = 0
        self._without_since_ns: int | None = None
        self._go_ns: int | None = None
        self._against: Alert | None = None
        self._reason: Alert | None = alert(AlertId.SHADOW_NOT_COMPARED)
        self._open = False

    def set_map_id(self, map_id: str) -> None:
        """Set the id of the map; called before `recall`."""
        if self._memory is not None:
            self._memory.about = map_id

    def recall(self) -> None:
        """Restore the failed shadow check of a process that was killed, and report it; before the
        link starts.
        """
        if self._memory is not None and self._memory.recall():
            self._against = self._reason = alert(AlertId.SHADOW_RESTORED)
            self._notifier.report(self._against)

    def end(self, *, clean_shutdown: bool = True) -> None:
        """End the memory; a clean shutdown deletes the stored failure. The first call counts."""
        if self._memory is not None:
            self._memory.stop(clean_shutdown=clean_shutdown)

    def mode(self, wanted: Mode, state: VehicleState, now_ns: int, *, by_pilot: bool) -> Mode:
        """The mode that is allowed: ``shadow`` for ``inject`` until injection may begin, after that
        always ``inject``. by_pilot: the mode is ``rc``; the pilot's ``inject`` is followed,
        reported if the shadow check has not passed, and ended by the pilot's ``shadow``.
        """
        self._update(state, now_ns)
        if wanted != "inject":
            if by_pilot:
                self._open = False  # its next opening is reported again
            self._remember()
            return wanted
        if not self._open and state.connected:
            self._open = self._may_begin(now_ns, by_pilot=by_pilot)
        self._remember()
        return "inject" if self._open else "shadow"

    def _remember(self) -> None:
        """Store the failure for a restart, unless injection runs: injection that has started is not
        stopped by a restart or a spoofed receiver.
        """
        if self._memory is not None:
            self._memory.store(not self._open and self._against is not None)

    @property
    def reason(self) -> Alert | None:
        """Why nothing is injected in mode ``inject``; None if the interlock is not the reason."""
        if self._open:
            return None
        if self.inhibited_by:
            first = min(self.inhibited_by, key=lambda of: CATALOGUE[of].title)
            return alert(AlertId.INHIBITED, alert=first)
        return self._reason

    def may_switch(self, now_ns: int) -> bool:
        """Whether the EKF may switch to vision: by `force`; or, while no alert inhibits, if the
        shadow check has passed in the last 10 min and at most 30 s before the last comparison, or
        if injection runs and nothing was ever compared.
        """
        if self._force:
            return True
        if self.inhibited_by:
            return False
        unproven = self._open and not self._compared_ns() and not self._against
        return self._recent_go(now_ns) if self._go_ns is not None else unproven

    def _recent_go(self, now_ns: int) -> bool:
        if self._go_ns is None:
            return False
        before_last_ns = self._compared_ns() - self._go_ns
        return before_last_ns <= _BEFORE_LAST_NS and now_ns - self._go_ns <= _GO_NS

    def _may_begin(self, now_ns: int, *, by_pilot: bool) -> bool:
        """Whether injection may start; reports a start without a passed check. Never revoked."""
        since_ns = self._without_since_ns
        without = since_ns is not None and now_ns - since_ns >= _WITHOUT_GNSS_NS
        if self._recent_go(now_ns) and not self.inhibited_by:
            return True
        if self._force:
            self._notifier.report(alert(AlertId.INJECTION_FORCED))
        elif by_pilot:
            self._notifier.report(alert(AlertId.INJECTION_NOT_READY))
        elif without and not self._against and not self.inhibited_by:
            self._notifier.report(alert(AlertId.INJECTION_UNCHECKED))
        else:
            return False
        return True

    def _update(self, state: VehicleState, now_ns: int) -> None:
        """Update the time without GNSS, and once a second the result of the shadow check."""
        if gnss_healthy(state, now_ns) or not state.connected:
            self._without_since_ns = None
        elif self._without_since_ns is None:
            self._without_since_ns = now_ns
        if now_ns < self._next_ns:
            return
        self._next_ns = now_ns + _PERIOD_NS
        score = self._score(now_ns)
        if score.ready:
            self._go_ns, self._against = self._compared_ns(), None
        elif score.samples >= MINIMUM_SAMPLES:
            # It stays when its samples age: a wrong map is wrong without GNSS, too. A low rate
            # says nothing about the map; `Injector` checks it.
            self._against = score.against[0] if score.against else None
        self._reason = self._against or (score.reasons[0] if score.reasons else None)
