"""Mode ``rc``: an RC channel or a command selects shadow or inject."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import InjectionOrder, RcChannel
from mavlink_bridge.config import InjectionEnableConfig
from mavlink_bridge.injection.restart_memory import InjectionEnableMemory

_HYSTERESIS_US = 50
_PULSE_US = (800, 2200)  # outside it no receiver speaks; 65535 means "no such channel"

COMMANDS = {
    "user_1": mavlink.MAV_CMD_USER_1,
    "user_2": mavlink.MAV_CMD_USER_2,
    "user_3": mavlink.MAV_CMD_USER_3,
    "user_4": mavlink.MAV_CMD_USER_4,
    "user_5": mavlink.MAV_CMD_USER_5,
}


class InjectionEnable:
    """Enables and disables injection. The newest order is valid: a change of the RC channel, or a
    command.

    If the RC receiver goes silent, injection continues: without a position, ArduPilot would land
    instead of returning. Any thread may call.

    changed: called with an alert when injection is enabled or disabled. memory: stores the state
    for a restart, None without.
    """

    def __init__(
        self,
        config: InjectionEnableConfig,
        changed: Callable[[Alert], None],
        memory: InjectionEnableMemory | None = None,
    ) -> None:
        self._config = config
        self._changed = changed
        self._lock = threading.Lock()
        self._open = False
        self._high: bool | None = None
        self._memory = memory
        self._at_start = alert(AlertId.INJECTION_OFF, by=InjectionOrder.START)

    def recall(self) -> None:
        """Enable injection, before the links start, if a process that crashed had enabled it."""
        remembered = self._memory.recall() if self._memory is not None else None
        if remembered is None:
            return
        by_channel, age_s = remembered
        with self._lock:
            if by_channel:
                self._high = True  # a switch turned off meanwhile closes it at its first look
            self._open = True
            self._at_start = alert(AlertId.INJECTION_RESTORED, seconds=age_s)
        if self._memory is not None:
            self._memory.store_enabled(by_channel=by_channel)

    def announce(self) -> None:
        """Report the state at the start (off, or restored); called once a link is connected."""
        self._changed(self._at_start)

    def stop(self, *, clean_shutdown: bool = True) -> None:
        """End the memory; a clean shutdown deletes the stored state. The first call counts."""
        if self._memory is not None:
            self._memory.stop(clean_shutdown=clean_shutdown)

    @property
    def enabled(self) -> bool:
        """Whether injection is enabled."""
        return self._open

    def on_rc_channels(self, pulses_us: Sequence[int]) -> None:
        """Process the pulse widths of RC_CHANNELS: crossing the threshold enables or disables
        injection; at the first report only a switch that is on counts.
        """
        number = self._config.channel
        pulse = pulses_us[number - 1] if len(pulses_us) >= number else 0
        if not _PULSE_US[0] <= pulse <= _PULSE_US[1]:
            return
        with self._lock:
            before = self._high
            slack = _HYSTERESIS_US if before else 0
            self._high = pulse >= self._config.inject_above_us - slack
            # At the first look only a switch that is on counts: a command may have come before.
            moved = self._high if before is None else self._high != before
        if moved:
            self._set(bool(self._high), RcChannel(number))

    def command(self, command: int, wanted: float) -> int:
        """Process a command to the localizer's component; returns the MAV_RESULT.

        wanted: the command's param1, 1 enables and 0 disables injection; any other is denied.
        """
        if self._config.command is None or command != COMMANDS[self._config.command]:
            return int(mavlink.MAV_RESULT_UNSUPPORTED)
        if not math.isfinite(wanted) or wanted not in (0.0, 1.0):
            return int(mavlink.MAV_RESULT_DENIED)
        self._set(wanted == 1.0, InjectionOrder.COMMAND)
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _set(self, wanted: bool, by: RcChannel | InjectionOrder) -> None:
        with self._lock:
            if wanted == self._open:
                return
            self._open = wanted
            if self._memory is not None:
                if wanted:
                    self._memory.store_enabled(by_channel=isinstance(by, RcChannel))
                else:
                    self._memory.drop()
        self._changed(alert(AlertId.INJECTION_ON if wanted else AlertId.INJECTION_OFF, by=by))
