"""A temporary connection to the autopilot, for mission, parameters and the signing key."""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.config import BridgeConfig, SigningConfig
from mavlink_bridge.errors import (
    BridgeStateError,
    ConnectionSilentError,
    MissionError,
    ParameterError,
)
from mavlink_bridge.link.link import Link, LinkOptions
from mavlink_bridge.link.signing import load_key, signing_timestamp
from mavlink_bridge.link.transport import Endpoint
from mavlink_bridge.mission.items import FRAMES
from mavlink_bridge.mission.path import planned_path
from mavlink_bridge.vehicle.mission import MissionWaypoint, mission_item, waypoint_of
from mavlink_bridge.vehicle.readings import is_autopilot

_RETRIES = 3
_ANSWER_S = 0.7
_INTEGER_FORMATS = {
    mavlink.MAV_PARAM_TYPE_UINT8: "<B3x",
    mavlink.MAV_PARAM_TYPE_INT8: "<b3x",
    mavlink.MAV_PARAM_TYPE_UINT16: "<H2x",
    mavlink.MAV_PARAM_TYPE_INT16: "<h2x",
    mavlink.MAV_PARAM_TYPE_UINT32: "<I",
    mavlink.MAV_PARAM_TYPE_INT32: "<i",
}

_CONNECT_S = 15.0
_FIRST_GUESS = 1
_FIRMWARES = {
    mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ArduPilot",
    mavlink.MAV_AUTOPILOT_PX4: "PX4",
}

_Self = TypeVar("_Self", bound="VehicleClient")


class VehicleClient:
    """Finds the autopilot and keeps its link active by heartbeats. A context manager.

    Raises `ConnectionSilentError` if no heartbeat arrives. A subclass receives the autopilot's
    messages in `take`, which is called under the lock of `wait_for`.
    """

    def __init__(self, config: BridgeConfig, name: str, wanted: Collection[int]) -> None:
        self.config = config
        messages = {mavlink.MAVLINK_MSG_ID_HEARTBEAT, *wanted}
        options = LinkOptions(name=name, wanted=messages, signing=config.signing)
        self._link = Link(Endpoint.parse(config.connection), self, options)
        self._changed = threading.Condition()
        self.system = 0
        self.component = mavlink.MAV_COMP_ID_AUTOPILOT1
        self.autopilot = mavlink.MAV_AUTOPILOT_INVALID
        self.armed = False
        """As the heartbeat said that began the conversation."""
        self._next_heartbeat_ns = 0

    def __enter__(self: _Self) -> _Self:
        self._link.start()
        try:
            self.wait_for(lambda: self.system != 0, _CONNECT_S)
        finally:  # an interrupt included
            if not self.system:
                self._link.stop()
        if not self.system:
            raise ConnectionSilentError(
                f"no autopilot heartbeat at {self.config.connection} in {_CONNECT_S:.0f} s; "
                "check the connection string, the wiring and the port's MAVLink 2 protocol"
            )
        return self

    def __exit__(self, *_: object) -> None:
        self._link.stop()

    def take(self, message: Any) -> None:
        """Process a message of the autopilot, other than its heartbeat."""

    def ask(self, message: Any) -> None:
        """Send a message as the companion; the answer comes to `take`, see `wait_for`."""
        self._link.send(message, self.config.companion_component)

    def wait_for(self, predicate: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until the predicate holds, tested after each message; False after the timeout."""
        with self._changed:
            return self._changed.wait_for(predicate, timeout_s)

    # --- link handler ---------------------------------------------------------------------------

    def on_open(self, link: Link) -> None:
        """Does nothing: nothing is sent before a heartbeat is received."""

    def on_message(self, link: Link, message: Any, time_ns: int) -> None:
        """Process the autopilot's heartbeat, or pass its other messages to `take`."""
        system = message.get_srcSystem()
        if message.get_type() == "HEARTBEAT":
            # The first one decides: a second vehicle on the link must not be given what was asked
            # of, or written for, the first.
            if self.system or self.config.system_id not in (None, system):
                return
            if not is_autopilot(message):
                return
            link.system_id = system
            link.keep_peer()
            with self._changed:
                self.system, self.component = system, message.get_srcComponent()
                self.autopilot = message.autopilot
                self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
                self._changed.notify_all()
        elif (system, message.get_srcComponent()) == (self.system, self.component):
            with self._changed:
                self.take(message)
                self._changed.notify_all()

    def on_tick(self, link: Link, now_ns: int) -> int:
        """Send a heartbeat once a second, so that the autopilot answers on this link; returns the
        time of the next call, ns. On a link on which the autopilot speaks second, or that is
        signed, a system id is guessed until it has been heard.
        """
        if link.system_id == 0 and (link.endpoint.kind == "udpout" or self.config.signing):
            link.system_id = _FIRST_GUESS
        if link.system_id and now_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = now_ns + 1_000_000_000
            message = mavlink.MAVLink_heartbeat_message(
                mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 3, 3
            )
            link.send(message, self.config.companion_component)
        return now_ns + 100_000_000


@dataclass(frozen=True)
class DetectedAutopilot:
    """MAVLink system id and firmware of a detected autopilot."""

    system_id: int
    firmware: str


def detect_autopilot(config: BridgeConfig) -> DetectedAutopilot:
    """The autopilot at `config.connection`; `ConnectionSilentError` without one for 15 s."""
    with VehicleClient(config, "meeting", ()) as client:
        number = client.autopilot
        return DetectedAutopilot(client.system, _FIRMWARES.get(number, f"MAV_AUTOPILOT {number}"))


def decode_value(value: float, kind: int, *, bytewise: bool) -> float:
    """The value in PARAM_VALUE. kind: MAV_PARAM_TYPE; bytewise: PX4 copies an integer's bytes into
    the float field, ArduPilot converts the number.
    """
    if bytewise and kind in _INTEGER_FORMATS:
        return float(struct.unpack(_INTEGER_FORMATS[kind], struct.pack("<f", value))[0])
    return float(value)


def encode_value(value: float, kind: int, *, bytewise: bool) -> float:
    """The float to send in PARAM_SET for a parameter's value: the inverse of `decode_value`."""
    if bytewise and kind in _INTEGER_FORMATS:
        raw = struct.pack(_INTEGER_FORMATS[kind], round(value))
        return float(struct.unpack("<f", raw)[0])
    return value


class ParameterClient(VehicleClient):
    """Reads and writes parameters. A context manager."""

    def __init__(self, config: BridgeConfig) -> None:
        super().__init__(config, "parameters", (mavlink.MAVLINK_MSG_ID_PARAM_VALUE,))
        self._values: dict[str, tuple[float, int]] = {}

    def read(self, name: str) -> float | None:
        """Request a parameter from the vehicle, and return its value; None if it does not exist, or
        no answer comes in 2 s.
        """
        self._values.pop(name, None)
        for _ in range(_RETRIES):
            self._request(name)
            if self.wait_for(lambda: name in self._values, _ANSWER_S):
                return self._values[name][0]
        return None

    def read_known(self, names: Collection[str]) -> dict[str, float]:
        """Values by name of those parameters that were answered within 0.7 s. All are requested
        together and once, so that all missing ones cost one timeout.
        """
        for name in names:
            self._values.pop(name, None)
            self._request(name)
        self.wait_for(lambda: all(name in self._values for name in names), _ANSWER_S)
        return {name: self._values[name][0] for name in names if name in self._values}

    def write(self, name: str, value: float) -> None:
        """Set a parameter and verify it. `ParameterError` if it does not exist or the value is not
        accepted.
        """
        if self.read(name) is None:
            raise ParameterError(f"{name}: the flight controller has no such parameter")
        kind = self._values[name][1]
        message = mavlink.MAVLink_param_set_message(
            self.system,
            self.component,
            name.encode("ascii"),
            encode_value(value, kind, bytewise=self._bytewise),
            kind,
        )
        for _ in range(_RETRIES):
            self._values.pop(name, None)
            self.ask(message)
            answered = self.wait_for(lambda: name in self._values, _ANSWER_S)
            if answered and abs(self._values[name][0] - value) < 1e-3 * max(1, abs(value)):
                return
        raise ParameterError(f"{name} = {value:g} was not taken by the flight controller")

    def _request(self, name: str) -> None:
        to = (self.system, self.component)
        self.ask(mavlink.MAVLink_param_request_read_message(*to, name.encode("ascii"), -1))

    @property
    def _bytewise(self) -> bool:
        return bool(self.autopilot == mavlink.MAV_AUTOPILOT_PX4)

    def take(self, message: Any) -> None:
        """Process a PARAM_VALUE."""
        value = decode_value(message.param_value, message.param_type, bytewise=self._bytewise)
        self._values[message.param_id] = (value, message.param_type)


_REPEATS = 3
_APART_S = 0.3


def _send(client: VehicleClient, key: bytes) -> None:
    """Send the key and the time a few times, because nothing acknowledges them."""
    message = mavlink.MAVLink_setup_signing_message(
        client.system, client.component, list(key), signing_timestamp()
    )
    for _ in range(_REPEATS):
        client.ask(message)
        client.wait_for(lambda: False, _APART_S)


def install_key(connection: str, key_file: Path) -> bool:
    """Send the key of a file to the autopilot; True if its heartbeat is then signed with it.

    False on ArduPilot's USB port, which stays unsigned, and if the autopilot already used another
    key. Raises `BridgeStateError` if the vehicle is armed, because ArduPilot then ignores the key;
    `ConnectionSilentError` without a vehicle, `SigningKeyError` for an unusable key file.
    """
    key = load_key(key_file)
    config = BridgeConfig(connection=connection)
    with VehicleClient(config, "signing", ()) as client:
        if client.armed:
            raise BridgeStateError(f"{connection}: the vehicle is armed; disarm it, then install")
        _send(client, key)
    signed = config.model_copy(update={"signing": SigningConfig(key_file=key_file)})
    try:
        with VehicleClient(signed, "signing", ()):
            return True
    except ConnectionSilentError:
        return False


_ITEM_RETRIES = 5
_ITEM_ANSWER_S = 1.0
_LONGEST_S = 120.0  # for all items
_WANTED = (
    mavlink.MAVLINK_MSG_ID_MISSION_COUNT,
    mavlink.MAVLINK_MSG_ID_MISSION_ITEM_INT,
    mavlink.MAVLINK_MSG_ID_MISSION_ACK,
)


class MissionDownloader(VehicleClient):
    """Downloads the mission. A context manager."""

    def __init__(self, config: BridgeConfig) -> None:
        super().__init__(config, "mission", _WANTED)
        self._count: int | None = None
        self._items: dict[int, Any] = {}
        self._refusal: int | None = None

    def download(self) -> list[MissionWaypoint]:
        """Download home and the mission's positions in flight order; otherwise `MissionError`."""
        self._count, self._refusal = None, None
        self._items.clear()
        self._repeat(
            mavlink.MAVLink_mission_request_list_message(self.system, self.component, 0),
            lambda: self._count is not None,
            "the number of items",
        )
        # Once: a count that a ground station asks for meanwhile must not change ours.
        count, ends_s = self._count or 0, time.monotonic() + _LONGEST_S
        for number in range(count):
            if time.monotonic() > ends_s:
                raise MissionError(
                    f"the flight controller gave {number} of {count} items of its mission in "
                    f"{_LONGEST_S:.0f} s; check the link's rate, or the mission in the vehicle"
                )
            self._repeat(
                mavlink.MAVLink_mission_request_int_message(self.system, self.component, number, 0),
                lambda number=number: number in self._items,
                f"item {number}",
            )
        self.ask(mavlink.MAVLink_mission_ack_message(self.system, self.component, 0))
        return _as_flown([self._items[number] for number in range(count)])

    def _repeat(self, question: Any, answered: Any, what: str) -> None:
        for _ in range(_ITEM_RETRIES):
            self.ask(question)
            if self.wait_for(lambda: answered() or self._refusal is not None, _ITEM_ANSWER_S):
                break
        if not answered():
            why = "silence" if self._refusal is None else f"MAV_MISSION_RESULT {self._refusal}"
            raise MissionError(f"the flight controller did not give {what} of its mission ({why})")

    def take(self, message: Any) -> None:
        """Process MISSION_COUNT, MISSION_ITEM_INT or a refusal; other mission types are ignored."""
        if getattr(message, "mission_type", 0) != mavlink.MAV_MISSION_TYPE_MISSION:
            return
        kind = message.get_type()
        if kind == "MISSION_COUNT":
            self._count = message.count
        elif kind == "MISSION_ITEM_INT":
            self._items[message.seq] = message
        elif message.type != mavlink.MAV_MISSION_ACCEPTED:
            self._refusal = message.type


def _as_flown(messages: Sequence[Any]) -> list[MissionWaypoint]:
    """Positions in flight order; the first message is home. Local frames are left out."""
    home = waypoint_of(messages[0]) if messages else None
    items = [mission_item(m) for m in messages[1:] if not _is_local(m)]
    place = None if home is None else (home.latitude_deg, home.longitude_deg)
    flown = planned_path(items, place).path
    places = [MissionWaypoint(p.item, p.latitude_deg, p.longitude_deg) for p in flown if p.item > 0]
    return places if home is None else [home, *places]


def _is_local(message: Any) -> bool:
    return message.command <= mavlink.MAV_CMD_NAV_LAST and message.frame not in FRAMES


def download_mission(config: BridgeConfig) -> list[MissionWaypoint]:
    """Download home (if it is known, first) and the mission's positions in flight order from the
    flight controller at `config.connection`. `ConnectionSilentError` or `MissionError` if it fails.
    """
    with MissionDownloader(config) as client:
        return client.download()
