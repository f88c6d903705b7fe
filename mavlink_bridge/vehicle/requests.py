"""Requests missing streams and the firmware version from the flight controller."""

from __future__ import annotations

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.link.link import Link
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.vehicle.commands import Commander
from mavlink_bridge.vehicle.mission import MissionWatch
from mavlink_bridge.vehicle.streams import StreamKeeper, wanted_streams

_VERSION_EVERY_NS = 1_000_000_000


class VehicleRequests:
    """Sends requests and repeats them until they are answered; one thread."""

    def __init__(self, config: BridgeConfig, commander: Commander) -> None:
        self.streams = StreamKeeper()
        self.mission = MissionWatch(config.companion_component)
        self._config = config
        self._commander = commander
        self._next_version_ns = 0

    def reset(self) -> None:
        """Request everything again, because the link was opened or the vehicle is back."""
        self.streams.reset()
        self.mission.reset()
        self._next_version_ns = 0

    def tick(self, link: Link, state: VehicleState, now_ns: int) -> None:
        """Request the mission, the streams and the version that are missing."""
        self.mission.tick(link, state, now_ns)
        for stream in self.streams.due(wanted_streams(self._config, state.autopilot), now_ns):
            interval_us = round(1e6 / stream.rate_hz)
            self._commander.send(
                link, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, stream.message_id, interval_us
            )
        if state.version is None and now_ns >= self._next_version_ns:
            self._next_version_ns = now_ns + _VERSION_EVERY_NS
            self._commander.send(
                link,
                mavlink.MAV_CMD_REQUEST_MESSAGE,
                mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION,
            )
