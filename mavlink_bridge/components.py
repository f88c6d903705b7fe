"""Our components on a link: heartbeats, received commands, camera messages; and the ground link."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import Name, SenderRefusal
from mavlink_bridge.camera.component import TRACKING, CameraComponent
from mavlink_bridge.camera.look_at import LOOKS
from mavlink_bridge.injection.injection_enable import COMMANDS
from mavlink_bridge.link.link import Link
from mavlink_bridge.messages import (
    CameraView,
    HealthLevel,
    Origin,
    PlaceHint,
    TargetEnd,
    TargetReport,
    VehicleState,
)
from mavlink_bridge.place_hint import PLACE_HINT, place_hint
from mavlink_bridge.shared import Shared
from mavlink_bridge.status import StatusNotifier

COMMANDS_IN = ("COMMAND_LONG", "COMMAND_INT")
_QUEUE = 64
_HEARTBEAT_NS = 1_000_000_000
_HINT_NS = 1_000_000_000  # between two texts about hints: an operator's come one by one
_MOST_REFUSED = 4  # systems that are named

SYSTEM_STATUS = {
    HealthLevel.STARTING: mavlink.MAV_STATE_BOOT,
    HealthLevel.OK: mavlink.MAV_STATE_ACTIVE,
    HealthLevel.DEGRADED: mavlink.MAV_STATE_CRITICAL,
    HealthLevel.FAILED: mavlink.MAV_STATE_EMERGENCY,
}


# What changes what the companion does; a question (camera information) anybody may ask.
_ORDERS = frozenset((*COMMANDS.values(), *TRACKING, *LOOKS, PLACE_HINT))


class Components:
    """The bridge's components on one link; its owner thread calls the methods.

    They send a heartbeat once a second, answer commands and report targets and camera poses.
    Only `queue_item` may be called from other threads.
    """

    def __init__(self, shared: Shared, *, ground: bool) -> None:
        self._shared = shared
        self._config = shared.config
        self._outbound: deque[TargetReport | TargetEnd | CameraView] = deque(maxlen=_QUEUE)
        self._camera = CameraComponent(
            self._config,
            shared.geoid_separation_m,
            shared.on_track,
            shared.target_numbers,
            ground_link=ground,
            utc=shared.utc,
            look=shared.look,
        )
        self._next_heartbeat_ns = 0
        # Where one link is signed, an order over another that is not would go round the signature.
        signing = self._config.ground_signing if ground else self._config.signing
        self._is_trusted = signing is not None or self._config.signing is None
        self._refused: set[int] = set()
        self._hints_told: dict[AlertId, int] = {}  # when

    def queue_item(self, item: TargetReport | TargetEnd | CameraView) -> None:
        """Queue an item for the ground station; the oldest is dropped if the queue is full."""
        self._outbound.append(item)

    def announce(self) -> None:
        """Send the next heartbeat at once, because the link was opened."""
        self._next_heartbeat_ns = 0

    def heartbeat(self, link: Link, now_ns: int) -> None:
        """Send each component's HEARTBEAT, with the localizer's health, at most once a second."""
        if now_ns < self._next_heartbeat_ns:
            return
        self._next_heartbeat_ns = now_ns + _HEARTBEAT_NS
        status = SYSTEM_STATUS[self._shared.health()]
        onboard = mavlink.MAV_TYPE_ONBOARD_CONTROLLER
        components = [
            (self._config.companion_component, onboard),
            (self._config.localizer_component, onboard),
        ]
        if self._config.camera.announce:
            components.append((self._config.camera_component, mavlink.MAV_TYPE_CAMERA))
        for component, kind in components:
            message = mavlink.MAVLink_heartbeat_message(
                kind, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, status, 3
            )
            link.send(message, component)

    def serve_camera(self, link: Link, state: VehicleState, now_ns: int) -> None:
        """Send the targets and camera view that are due, unless the link is congested."""
        if link.congested:
            return
        while self._outbound:
            item = self._outbound.popleft()
            if isinstance(item, TargetReport):
                self._camera.report(item)
            elif isinstance(item, TargetEnd):
                self._camera.forget(item.target_id)
            else:
                self._camera.report_view(item)
        position = None
        place = (state.latitude_deg, state.longitude_deg, state.altitude_amsl_m)
        if place[0] is not None and place[1] is not None and place[2] is not None:
            position = Origin(place[0], place[1], place[2])
        self._camera.tick(now_ns, position, self._shared.uptime_ms(now_ns), link.send)

    def command(self, link: Link, message: Any, time_ns: int) -> None:
        """Execute and answer a command of a ground station to one of our components; others are
        ignored. Commands that change something are denied to systems outside `ground_systems`.

        While the link is congested, the command is not answered, as if it were lost. The sender
        repeats it, and many commands cannot delay positions.
        """
        if link.congested:
            return
        if message.command in _ORDERS and not self._may_order(message):
            self._refuse(link, message)
            return
        localizer = self._config.localizer_component
        if (message.target_system, message.target_component) == (link.system_id, localizer):
            self._localizer_command(link, message, time_ns)
        elif self._config.camera.announce and message.target_system in (0, link.system_id):
            self._camera.command(message, time_ns, self._shared.uptime_ms(time_ns), link.send)

    def _may_order(self, message: Any) -> bool:
        return self._is_trusted and message.get_srcSystem() in self._config.ground_systems

    def _refuse(self, link: Link, message: Any) -> None:
        """Deny a command to one of our components and report its sender once. From the fourth
        sender on one alert covers all.
        """
        ours = (self._config.localizer_component, self._config.camera_component)
        if message.target_system not in (0, link.system_id) or message.target_component not in ours:
            return
        system = message.get_srcSystem()
        denied = mavlink.MAV_RESULT_DENIED
        ack = mavlink.MAVLink_command_ack_message(
            message.command, denied, 0, 0, system, message.get_srcComponent()
        )
        link.send(ack, message.target_component)
        if system not in self._refused and len(self._refused) < _MOST_REFUSED:
            self._refused.add(system)
            why = SenderRefusal.NOT_ALLOWED if self._is_trusted else SenderRefusal.NOT_SIGNED
            is_last = len(self._refused) == _MOST_REFUSED
            refused = AlertId.SENDERS_REFUSED if is_last else AlertId.SENDER_REFUSED
            self._shared.report(alert(refused, system=system, why=why))

    def _localizer_command(self, link: Link, message: Any, time_ns: int) -> None:
        """Process the commands that enable injection or give a search position; others are denied
        as the protocol demands.
        """
        enable = self._shared.enable
        result = mavlink.MAV_RESULT_UNSUPPORTED
        if message.command == PLACE_HINT and self._shared.on_hint is not None:
            result = self._hint(message, time_ns, self._shared.on_hint)
        elif enable is not None:
            result = enable.command(message.command, message.param1)
        ack = mavlink.MAVLink_command_ack_message(
            message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
        )
        link.send(ack, self._config.localizer_component)

    def _hint(self, message: Any, time_ns: int, on_hint: Callable[[PlaceHint], bool]) -> int:
        hint = place_hint(message)
        if hint is None:
            return int(mavlink.MAV_RESULT_DENIED)
        taken = on_hint(hint)
        news = alert(AlertId.HINT_REFUSED)
        if taken:
            news = alert(AlertId.HINT_TAKEN, metres=hint.radius_m)
        if time_ns - self._hints_told.get(news.id, -_HINT_NS) >= _HINT_NS:
            self._hints_told[news.id] = time_ns
            self._shared.report(news)
        return int(mavlink.MAV_RESULT_ACCEPTED if taken else mavlink.MAV_RESULT_DENIED)


_TICK_NS = 20_000_000


class GroundEnd:
    """Handles the ground link, in its thread; other threads only fill its components' queues."""

    def __init__(self, shared: Shared) -> None:
        self.components = Components(shared, ground=True)
        self._shared = shared
        self._notifier = StatusNotifier(shared.report)

    def on_open(self, link: Link) -> None:
        """Announce our components at once."""
        self.components.announce()

    def on_message(self, link: Link, message: Any, time_ns: int) -> None:
        """Process commands; a heartbeat of one of `ground_systems` selects the link's peer."""
        if message.get_type() == "HEARTBEAT":
            if message.get_srcSystem() in self._shared.config.ground_systems:
                link.keep_peer()
            return
        if message.get_type() in COMMANDS_IN:
            self.components.command(link, message, time_ns)

    def on_tick(self, link: Link, now_ns: int) -> int:
        """Send heartbeats and targets once the system id is known; returns the next time, ns."""
        config = self._shared.config
        state = self._shared.tracker.snapshot(now_ns)
        link.system_id = config.system_id or state.system_id or 0
        self._shared.watch.check(state)
        if link.stranger:
            self._notifier.notify_each(
                "foreign", alert(AlertId.SENDER_IGNORED, sender=Name(link.stranger))
            )
        if link.system_id:
            self.components.heartbeat(link, now_ns)
            if config.camera.announce:
                self.components.serve_camera(link, state, now_ns)
        return now_ns + _TICK_NS
