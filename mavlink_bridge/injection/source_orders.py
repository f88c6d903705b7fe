"""Orders to change the EKF's source set: sent, told, and their answers taken."""

from __future__ import annotations

from collections import Counter

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.config import SourceSwitchConfig
from mavlink_bridge.injection.propagate import PropagatedFix
from mavlink_bridge.injection.switching import SourceSwitch
from mavlink_bridge.link.link import Link
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.texts import Teller
from mavlink_bridge.vehicle.commands import Commander


class SourceOrders:
    """Carries out what `SourceSwitch` decides; one thread."""

    def __init__(
        self,
        config: SourceSwitchConfig,
        commander: Commander,
        teller: Teller,
        counters: Counter[str],
    ) -> None:
        self._switch = SourceSwitch(config)
        self._gnss_set = config.gnss_set
        self._commander = commander
        self._teller = teller
        self._counters = counters

    @property
    def current(self) -> int:
        """The source set that the flight controller uses, as far as it was acknowledged."""
        return self._switch.current

    @property
    def on_gnss(self) -> bool:
        """Whether the flight controller uses the set of GNSS."""
        return self.current == self._gnss_set

    def rebooted(self) -> None:
        """The flight controller starts with its first set."""
        self._switch.reset()
        self._teller.forget("switch")

    def acknowledged(self, accepted: bool) -> None:
        """COMMAND_ACK of an order."""
        self._switch.acknowledged(accepted)
        if not accepted:
            self._teller.warn("source switch refused")

    def tick(
        self,
        link: Link,
        state: VehicleState,
        vision: PropagatedFix | None,
        *,
        vision_good: bool,
        now_ns: int,
    ) -> None:
        """Order a change if it is time for one. vision_good: positions are sent and trusted."""
        order = self._switch.decide(now_ns, state, vision, vision_good)
        if order is None:
            return
        self._counters["source_switches"] += 1
        self._commander.send(link, mavlink.MAV_CMD_SET_EKF_SOURCE_SET, order.source_set)
        # Set 2 for a reason and set 1 for another differ by more than digits.
        self._teller.tell("switch", f"EKF source set {order.source_set}: {order.reason}")
