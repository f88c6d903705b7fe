"""What is wrong with the fixes themselves or with who takes them, told once."""

from __future__ import annotations

from mavlink_bridge.injection.injector import Injector
from mavlink_bridge.messages import VehicleState, without_figures
from mavlink_bridge.shared import Shared
from mavlink_bridge.status_notifier import StatusNotifier
from mavlink_bridge.vehicle.profile import FirmwareProfile

_RELIEF_SHARE = 0.9  # of a limit, below which its warning ends
_DELAY_SLACK_MS = 10.0
_IN_TIME_S = 15.0  # until lateness is over; a computer at its limit is late and in time by turns


class FixWarnings:
    """Looks at the injector and the computer's clock; one thread."""

    def __init__(self, shared: Shared, injector: Injector, teller: StatusNotifier) -> None:
        self._config = shared.config.injection
        self._utc = shared.utc
        self._injector = injector
        self._teller = teller

    def firmware(self, state: VehicleState, profile: FirmwareProfile) -> None:
        """A firmware that is unknown, or does not take the configured message."""
        if not state.connected or state.version is None:
            return
        problem = ""
        if not profile.known:
            problem = "unknown firmware, using the safe profile"
        elif self._config.message not in profile.messages:
            problem = f"{profile.name} does not take {self._config.message.upper()}"
        self._teller.tell("profile", problem)

    def fixes(self, profile: FirmwareProfile, now_ns: int) -> None:
        """Fixes that are late, that nothing checks, or that cannot be stamped."""
        tell = self._teller.tell
        late = self._latency(profile)
        relief = "fixes are in time again"
        self._teller.tell_settled("latency", late, relief, now_ns, wait_s=_IN_TIME_S)
        blind = "vision yaw is not checked: no attitude or no gimbal angles"
        tell("blind", blind if self._injector.guard.blind else "", "vision yaw is checked")
        unset = self._config.message == "gps_input" and not self._utc.is_set
        problem = "this computer's clock is not set: GPS_INPUT carries no time"
        tell("utc", problem if unset else "")

    def _latency(self, profile: FirmwareProfile) -> str:
        known = self._injector.latency
        latency, least = known.median_ms, known.least_ms
        if latency is None or least is None or not known.is_known:
            return ""
        delay = self._config.delay_ms
        # Where the firmware goes by the least lag, its positions lag by what that is late.
        lag = least if profile.least_lag else latency
        name = profile.delay_parameter
        if self._config.message == "gps_input":
            name = profile.gps_delay_parameter.format(n=self._config.gps_id + 1)
        told = self._teller.told("latency")
        late = f"fixes are {lag:.0f} ms old: raise delay_ms ({delay:.0f}) and {name}"
        over = f"fixes are {latency:.0f} ms old, over the {profile.max_delay_ms:.0f} ms of {name}"
        over_is_told = told == without_figures(over)
        if latency > profile.max_delay_ms * (_RELIEF_SHARE if over_is_told else 1.0):
            return over
        limit = delay + _DELAY_SLACK_MS
        if lag > limit:
            return late
        if told and lag > _RELIEF_SHARE * limit:  # not yet over, but nothing new to say
            return over if over_is_told else late
        return ""
