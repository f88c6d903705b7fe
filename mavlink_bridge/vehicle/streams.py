"""Selects the messages that the flight controller must stream, and requests missing ones."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.link.link import Link
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.vehicle.commands import Commander

_CHECK_EVERY_NS = 2_000_000_000
_SILENT_NS = 3_000_000_000
_VERSION_EVERY_NS = 1_000_000_000
_OPTIONAL_ATTEMPTS = 2
_OPTIONAL_EVERY = 30  # looks, a minute: an autopilot that boots hears no question


@dataclass(frozen=True)
class Stream:
    """A message to be streamed. optional: the firmware may not have the message; it is then
    requested rarely.

    unless: name of a message; while that is streamed, this one is not requested.
    """

    name: str
    rate_hz: float
    optional: bool = False
    unless: str = ""

    @property
    def message_id(self) -> int:
        """The MAVLink message id."""
        return int(getattr(mavlink, f"MAVLINK_MSG_ID_{self.name}"))


def wanted_streams(config: BridgeConfig, autopilot: str) -> tuple[Stream, ...]:
    """The streams that a configuration needs. autopilot: as `autopilot_name`."""
    estimator = "ESTIMATOR_STATUS" if autopilot == "px4" else "EKF_STATUS_REPORT"
    streams = [
        Stream("ATTITUDE", config.attitude_rate_hz),
        Stream("LOCAL_POSITION_NED", 10.0),
        Stream("GLOBAL_POSITION_INT", 5.0),
        Stream("GPS_RAW_INT", 5.0),
        Stream(estimator, 2.0),
        # Evidence of its own for whoever watches the fixes: what no estimator has touched.
        Stream("HIGHRES_IMU" if autopilot == "px4" else "RAW_IMU", 50.0, optional=True),
        Stream("SCALED_PRESSURE", 5.0, optional=True),
        Stream("DISTANCE_SENSOR", 5.0, optional=True),
    ]
    if config.camera.mount == "gimbal":
        device = "GIMBAL_DEVICE_ATTITUDE_STATUS"
        streams.append(Stream(device, min(config.attitude_rate_hz, 25.0), optional=True))
        streams.append(Stream("MOUNT_STATUS", 10.0, optional=True, unless=device))
    if config.camera.zoom_rate_hz:
        streams.append(Stream("CAMERA_SETTINGS", config.camera.zoom_rate_hz))
    if config.mode == "rc":
        streams.append(Stream("RC_CHANNELS", 5.0))
    return tuple(streams)


class StreamKeeper:
    """Requests the firmware version, and streams that have not started or have stopped, until they
    come; one thread. counts: messages received, by name.
    """

    def __init__(self, config: BridgeConfig, commander: Commander) -> None:
        self.counts: Counter[str] = Counter()
        self._config = config
        self._commander = commander
        self._seen_ns: dict[str, int] = {}
        self._attempts: dict[str, int] = {}
        self._next_ns = self._next_version_ns = 0

    def reset(self) -> None:
        """Request all again, because the flight controller rebooted or the link was reopened."""
        self._seen_ns.clear()
        self._attempts.clear()
        self._next_ns = self._next_version_ns = 0

    def on_message(self, name: str, time_ns: int) -> None:
        """Count a message of that name."""
        self._seen_ns[name] = time_ns
        self.counts[name] += 1

    def tick(self, link: Link, state: VehicleState, now_ns: int) -> None:
        """Every 2 s request what is missing: each stream once, and again while it is silent for 3 s
        (an optional one rarely); the version every second.
        """
        if state.version is None and now_ns >= self._next_version_ns:
            self._next_version_ns = now_ns + _VERSION_EVERY_NS
            wanted = mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION
            self._commander.send(link, mavlink.MAV_CMD_REQUEST_MESSAGE, wanted)
        if now_ns < self._next_ns:
            return
        self._next_ns = now_ns + _CHECK_EVERY_NS
        interval = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
        for stream in wanted_streams(self._config, state.autopilot):
            if self._is_due(stream, now_ns):
                interval_us = round(1e6 / stream.rate_hz)
                self._commander.send(link, interval, stream.message_id, interval_us)

    def _is_streaming(self, name: str, now_ns: int) -> bool:
        return now_ns - self._seen_ns.get(name, -_SILENT_NS) < _SILENT_NS

    def _is_due(self, stream: Stream, now_ns: int) -> bool:
        attempts = self._attempts.get(stream.name, 0)
        if self._is_streaming(stream.name, now_ns):
            # Some stream at a default rate until they are asked once.
            self._attempts[stream.name] = max(attempts, 1)
            return attempts == 0
        if stream.unless and (
            self._is_streaming(stream.unless, now_ns) or not self._was_requested(stream.unless)
        ):
            return False
        self._attempts[stream.name] = attempts + 1
        known = not stream.optional or stream.name in self._seen_ns
        return known or attempts < _OPTIONAL_ATTEMPTS or attempts % _OPTIONAL_EVERY == 0

    def _was_requested(self, name: str) -> bool:
        return self._attempts.get(name, 0) > _OPTIONAL_ATTEMPTS
