"""What both ends of the bridge share: identity, heartbeats, the camera component."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.camera.component import CameraComponent
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.injection.rc_gate import InjectionGate
from mavlink_bridge.link.clock import SteadyUtc
from mavlink_bridge.link.link import Link
from mavlink_bridge.messages import (
    CameraView,
    HealthLevel,
    Origin,
    TargetReport,
    TrackRequest,
    VehicleState,
)
from mavlink_bridge.vehicle.presence import VehicleWatch
from mavlink_bridge.vehicle.tracker import VehicleTracker

SECOND_NS = 1_000_000_000
COMMANDS_IN = ("COMMAND_LONG", "COMMAND_INT")
_QUEUE = 64
_GROUND_TICK_NS = 20_000_000

SYSTEM_STATUS = {
    HealthLevel.STARTING: mavlink.MAV_STATE_BOOT,
    HealthLevel.OK: mavlink.MAV_STATE_ACTIVE,
    HealthLevel.DEGRADED: mavlink.MAV_STATE_CRITICAL,
    HealthLevel.FAILED: mavlink.MAV_STATE_EMERGENCY,
}


@dataclass(frozen=True)
class Shared:
    """What the bridge lends to its sides. say: tell the operator (severity, text).

    gate: None unless the mode is ``rc``.
    """

    config: BridgeConfig
    geoid_separation_m: float
    utc: SteadyUtc
    tracker: VehicleTracker
    begun_ns: int
    health: Callable[[], HealthLevel]
    say: Callable[[int, str], None]
    on_track: Callable[[TrackRequest], None] | None
    watch: VehicleWatch
    gate: InjectionGate | None

    def uptime_ms(self, now_ns: int) -> int:
        """Milliseconds since the bridge began: its own time_boot_ms."""
        return (now_ns - self.begun_ns) // 1_000_000 & 0xFFFFFFFF


class Side:
    """One link's end: announces the components and serves the camera protocol."""

    def __init__(self, shared: Shared, *, ground: bool) -> None:
        self.shared = shared
        self.config = shared.config
        self.tracker = shared.tracker
        self.outbound: deque[TargetReport | CameraView] = deque(maxlen=_QUEUE)
        self.camera = CameraComponent(
            self.config, shared.geoid_separation_m, shared.on_track, ground_link=ground
        )
        self._next_heartbeat_ns = 0

    def on_open(self, link: Link) -> None:
        """Announce at once."""
        self._next_heartbeat_ns = 0

    def heartbeat(self, link: Link, now_ns: int) -> None:
        """HEARTBEAT of each component at 1 Hz; system status follows the localizer's health."""
        if now_ns < self._next_heartbeat_ns:
            return
        self._next_heartbeat_ns = now_ns + SECOND_NS
        status = SYSTEM_STATUS[self.shared.health()]
        onboard = mavlink.MAV_TYPE_ONBOARD_CONTROLLER
        components = [
            (self.config.companion_component, onboard),
            (self.config.localizer_component, onboard),
        ]
        if self.config.camera.announce:
            components.append((self.config.camera_component, mavlink.MAV_TYPE_CAMERA))
        for component, kind in components:
            message = mavlink.MAVLink_heartbeat_message(
                kind, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, status, 3
            )
            link.send(message, component)

    def serve_camera(self, link: Link, state: VehicleState, now_ns: int) -> None:
        """Targets and camera pose to the ground, where the link has room for them."""
        if link.congested:
            return
        while self.outbound:
            item = self.outbound.popleft()
            if isinstance(item, TargetReport):
                self.camera.report(item)
            else:
                self.camera.look(item)
        position = None
        if math.isfinite(state.latitude_deg):
            position = Origin(state.latitude_deg, state.longitude_deg, state.altitude_amsl_m)
        self.camera.tick(now_ns, position, self.shared.uptime_ms(now_ns), link.send)

    def command(self, link: Link, message: Any, time_ns: int) -> None:
        """A command of a ground station to one of our components.

        While the link is congested it is left unanswered, as if lost: the sender repeats it, and
        a flood of commands costs no position its place.
        """
        if link.congested:
            return
        localizer = self.config.localizer_component
        if (message.target_system, message.target_component) == (link.system_id, localizer):
            self._localizer_command(link, message)
        elif self.config.camera.announce and message.target_system in (0, link.system_id):
            self.camera.command(message, time_ns, self.shared.uptime_ms(time_ns), link.send)

    def _localizer_command(self, link: Link, message: Any) -> None:
        """The command that gates injection; every other one is refused in the protocol's way."""
        gate = self.shared.gate
        result = mavlink.MAV_RESULT_UNSUPPORTED
        if gate is not None:
            result = gate.command(message.command, message.param1)
        ack = mavlink.MAVLink_command_ack_message(
            message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
        )
        link.send(ack, self.config.localizer_component)


class GroundSide(Side):
    """The separate ground link: telemetry bandwidth is not spent on injection there."""

    def __init__(self, shared: Shared) -> None:
        super().__init__(shared, ground=True)

    def on_message(self, link: Link, message: Any, time_ns: int) -> None:
        """Commands for our components."""
        if message.get_type() in COMMANDS_IN:
            self.command(link, message, time_ns)

    def on_tick(self, link: Link, now_ns: int) -> int:
        """Heartbeats and targets, once the vehicle's system id is known."""
        state = self.tracker.snapshot(now_ns)
        link.system_id = self.config.system_id or state.system_id or 0
        self.shared.watch.check(state)
        if link.system_id:
            self.heartbeat(link, now_ns)
            if self.config.camera.announce:
                self.serve_camera(link, state, now_ns)
        return now_ns + _GROUND_TICK_NS
