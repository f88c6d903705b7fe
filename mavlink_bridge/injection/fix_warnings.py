"""Warnings about late or unchecked fixes, a wrong clock and unknown firmware; each is reported
once.
"""

from __future__ import annotations

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert, cleared
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import Name
from mavlink_bridge.injection.injector import Injector
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.shared import Shared
from mavlink_bridge.status_notifier import StatusNotifier
from mavlink_bridge.vehicle.profile import FirmwareProfile

_RELIEF_SHARE = 0.9  # of a limit, below which its warning ends
_DELAY_SLACK_MS = 10.0
_IN_TIME_S = 15.0  # until lateness is over; a computer at its limit is late and in time by turns


class FixWarnings:
    """Checks the injector and the computer's clock, and reports; one thread."""

    def __init__(self, shared: Shared, injector: Injector, notifier: StatusNotifier) -> None:
        self._config = shared.config.injection
        self._utc = shared.utc
        self._injector = injector
        self._notifier = notifier

    def check_firmware(self, state: VehicleState, profile: FirmwareProfile) -> None:
        """Report a known firmware without a profile, or without the configured message."""
        if not state.connected or state.version is None:
            return
        self._notifier.notify("profile", None if profile.known else alert(AlertId.UNKNOWN_FIRMWARE))
        sent = self._config.message
        taken = sent in profile.messages
        unsupported = (
            None if taken else alert(AlertId.MESSAGE_UNSUPPORTED, message=Name(sent.upper()))
        )
        self._notifier.notify("message", unsupported)

    def check_fixes(self, profile: FirmwareProfile, now_ns: int) -> None:
        """Report fixes that are late, not checked for yaw, or (GPS_INPUT) without a valid UTC."""
        tell = self._notifier.notify
        late = self._latency(profile)
        relief = alert(AlertId.FIXES_IN_TIME)
        self._notifier.notify_settled("latency", late, relief, now_ns, wait_s=_IN_TIME_S)
        blind = alert(AlertId.YAW_UNCHECKED) if self._injector.guard.blind else None
        tell("blind", blind, cleared(AlertId.YAW_UNCHECKED))
        unset = self._config.message == "gps_input" and not self._utc.is_set
        tell("utc", alert(AlertId.CLOCK_NOT_SET) if unset else None)

    def _latency(self, profile: FirmwareProfile) -> Alert | None:
        known = self._injector.latency
        latency, least = known.median_ms, known.least_ms
        if latency is None or least is None or not known.is_known:
            return None
        says_age = self._config.message == "external_position_estimate"
        limit_ms = profile.max_delay_ms if says_age else self._config.delay_ms
        # Where the firmware goes by the least lag, its positions lag by what that is late.
        lag = least if profile.least_lag else latency
        late = alert(AlertId.FIXES_LATE, age_ms=lag, limit_ms=limit_ms)
        over = alert(AlertId.FIXES_OVER_LIMIT, age_ms=latency, limit_ms=profile.max_delay_ms)
        reported = self._notifier.reported("latency")
        last = None if reported is None else reported.id
        is_over = last is AlertId.FIXES_OVER_LIMIT
        if latency > profile.max_delay_ms * (_RELIEF_SHARE if is_over else 1.0):
            return over
        limit = limit_ms + _DELAY_SLACK_MS
        if lag > limit:
            return late
        is_told = is_over or last is AlertId.FIXES_LATE
        if is_told and lag > _RELIEF_SHARE * limit:  # not yet over, but nothing new to report
            return over if is_over else late
        return None
