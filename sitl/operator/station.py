"""The operator's ground station: one MAVLink client on the vehicle's spare port.

It sends the camera protocol's commands to component 100 and keeps all that this component answers.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.ground.connection import Connection

_CAMERA = 100
_CONNECTED_S = 30.0
_HEARTBEAT_NS = 500_000_000
_ANSWER_NS = 1_500_000_000
_TRIES = 4
_COMMANDS = {
    "point": mavlink.MAV_CMD_CAMERA_TRACK_POINT,
    "rectangle": mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE,
    "stop": mavlink.MAV_CMD_CAMERA_STOP_TRACKING,
}


@dataclass(frozen=True)
class GeoReport:
    """CAMERA_TRACKING_GEO_STATUS as it came. velocity: m/s, north east down; None: not told."""

    time_ns: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    h_accuracy_m: float
    v_accuracy_m: float
    velocity: tuple[float, float, float] | None


@dataclass(frozen=True)
class ImageReport:
    """CAMERA_TRACKING_IMAGE_STATUS of a target. middle: 0 to 1, of its point or rectangle."""

    time_ns: int
    middle: tuple[float, float]


@dataclass
class ReceivedMessages:
    """Everything that came, in its order; texts: (CLOCK_MONOTONIC, text)."""

    geo: list[GeoReport] = field(default_factory=list)
    image: list[ImageReport] = field(default_factory=list)
    idle: int = 0
    texts: list[tuple[int, str]] = field(default_factory=list)


class Station:
    """Sends and listens in its caller's thread; `run_until` passes the time."""

    def __init__(self, endpoint: str, alive: Callable[[], None] = lambda: None) -> None:
        self._link = Connection(endpoint)
        self._link.open(time.monotonic() + _CONNECTED_S, alive)
        self.heard = ReceivedMessages()
        self._ack: Any = None
        self._beat_ns = 0

    def close(self) -> None:
        """Disconnect."""
        self._link.close()

    def run_until(self, done: Callable[[], bool], until_ns: int) -> bool:
        """Listen until something holds, or a CLOCK_MONOTONIC time is reached: False."""
        while not done():
            now_ns = time.monotonic_ns()
            if now_ns >= until_ns:
                return False
            if now_ns - self._beat_ns >= _HEARTBEAT_NS:
                self._beat_ns = now_ns
                self._link.beat()
            for message in self._link.receive():
                self._take(message, time.monotonic_ns())
        return True

    def ask(self, kind: str, parameters: tuple[float, ...]) -> tuple[int | None, int]:
        """Send a command until it is answered; (MAV_RESULT or None, the target's number)."""
        command, padded = _COMMANDS[kind], [*parameters, *([0.0] * (7 - len(parameters)))]
        for attempt in range(_TRIES):
            self._ack = None
            self._link.send(
                mavlink.MAVLink_command_long_message(1, _CAMERA, command, attempt, *padded)
            )
            self.run_until(lambda: self._is_answer(command), time.monotonic_ns() + _ANSWER_NS)
            if self._is_answer(command):
                return int(self._ack.result), int(self._ack.result_param2)
        return None, 0

    def _is_answer(self, command: int) -> bool:
        return self._ack is not None and self._ack.command == command

    def _take(self, message: Any, now_ns: int) -> None:
        kind = message.get_type()
        if kind == "STATUSTEXT":
            if message.get_srcComponent() != mavlink.MAV_COMP_ID_AUTOPILOT1:
                self.heard.texts.append((now_ns, str(message.text)))
        elif message.get_srcComponent() != _CAMERA:
            return
        elif kind == "COMMAND_ACK":
            self._ack = message
        elif kind == "CAMERA_TRACKING_GEO_STATUS":
            self.heard.geo.append(_geo(message, now_ns))
        elif kind != "CAMERA_TRACKING_IMAGE_STATUS":
            return
        elif not message.tracking_mode:
            self.heard.idle += 1
        else:
            self.heard.image.append(ImageReport(now_ns, _middle(message)))


def _geo(message: Any, now_ns: int) -> GeoReport:
    velocity = (message.vel_n, message.vel_e, message.vel_d)
    return GeoReport(
        now_ns, message.lat * 1e-7, message.lon * 1e-7, message.alt, message.h_acc, message.v_acc,
        velocity if all(math.isfinite(v) for v in velocity) else None,
    )  # fmt: skip


def _middle(message: Any) -> tuple[float, float]:
    if message.tracking_mode == mavlink.CAMERA_TRACKING_MODE_POINT:
        return message.point_x, message.point_y
    return (
        (message.rec_top_x + message.rec_bottom_x) / 2.0,
        (message.rec_top_y + message.rec_bottom_y) / 2.0,
    )
