"""The guardian's thread, and its last word on every fix."""

from __future__ import annotations

import logging
import threading

from companion.calibration_watch.sighting import Sighting
from companion.guardian.config import GuardianConfig
from companion.guardian.monitor import Limits, Monitor
from companion.guardian.protection import ProtectionLevel
from localizer.types import Image
from mavlink_bridge.bridge import Bridge
from mavlink_bridge.link.clock import monotonic_ns
from mavlink_bridge.messages import VisionFix

_log = logging.getLogger(__name__)
_PERIOD_S = 0.1
_ERROR, _WARNING, _NOTICE = 3, 4, 5  # MAV_SEVERITY


class Guardian:
    """Watches pictures, fixes and the vehicle, tells the operator, and withholds fixes.

    Pictures come from the feed's thread and fixes from the localization thread; neither waits for
    more than the lock. What is costly happens on a thread of its own, ten times a second.
    """

    def __init__(self, config: GuardianConfig, limits: Limits, bridge: Bridge) -> None:
        self._monitor = Monitor(config, limits)
        self._bridge = bridge
        self._lock = threading.Lock()
        self._picture: tuple[int, Image] | None = None
        self._failures = 0
        self.turn_ns = monotonic_ns()
        """When its thread began its newest turn, CLOCK_MONOTONIC."""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="guardian")

    def start(self) -> None:
        """Start watching."""
        self._thread.start()

    def stop(self) -> None:
        """Stop watching."""
        self._stop.set()
        self._thread.join()

    def see(self, time_ns: int, image: Image) -> None:
        """Offer a picture; the newest is looked at. Never blocks."""
        self._picture = (time_ns, image)

    def sight(self, sighting: Sighting) -> None:
        """Offer a registered picture as evidence of the calibration."""
        with self._lock:
            self._monitor.sight(sighting)

    def judge(self, fix: VisionFix) -> VisionFix | None:
        """The fix as it may be injected; None withholds it."""
        try:
            state = self._bridge.state()
            with self._lock:
                return self._monitor.admit(fix, state)
        except Exception:
            self._failed()
            return fix

    def submit(self, fix: VisionFix) -> None:
        """Judge a fix and hand it to the bridge, if it may be injected."""
        admitted = self.judge(fix)
        if admitted is not None:
            self._bridge.submit(admitted)

    @property
    def reason(self) -> str:
        """Why fixes are withheld; empty while they are not."""
        with self._lock:
            return self._monitor.reason

    @property
    def level(self) -> ProtectionLevel | None:
        """The newest fix's protection level."""
        with self._lock:
            return self._monitor.level

    def standing(self) -> dict[str, float]:
        """The findings that stand, by name, with their figures."""
        with self._lock:
            return self._monitor.standing()

    def _run(self) -> None:
        while not self._stop.wait(_PERIOD_S):
            self.turn_ns = monotonic_ns()
            try:
                self._step()
            except Exception:
                self._failed()

    def _failed(self) -> None:
        """A guardian that died in silence would be believed: told once, from its own exception."""
        self._failures += 1
        if self._failures == 1:
            _log.exception("the guardian failed")
            self._bridge.say(_ERROR, "PiLoT: guardian failed: fixes are not watched")

    def _step(self) -> None:
        picture, self._picture = self._picture, None
        with self._lock:
            if picture is not None:
                self._monitor.see(*picture)
            lines = self._monitor.step(monotonic_ns(), self._bridge)
            doubt, forbids = self._monitor.doubt, self._monitor.forbids
        self._bridge.doubt(doubt)
        self._bridge.forbid(forbids)
        for line in lines:
            severity = _ERROR if line.withholds else _WARNING
            self._bridge.say(severity if line.bad else _NOTICE, line.text)
