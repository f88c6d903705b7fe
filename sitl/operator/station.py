"""The operator's ground station: a MAVLink client on the vehicle's spare port.

It sends commands of the camera protocol to component 100 and waits for the answers.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.ground.connection import Connection

_CAMERA = 100
_CONNECTED_S = 30.0
_HEARTBEAT_NS = 500_000_000
_ANSWER_NS = 1_500_000_000
_TRIES = 4


class Station:
    """A MAVLink client in the caller's thread. It connects when it is made; `PilotError` if nothing
    listens for 30 s. alive: as of `GroundLink`.
    """

    def __init__(self, endpoint: str, alive: Callable[[], None] = lambda: None) -> None:
        self._link = Connection(endpoint)
        self._link.open(time.monotonic() + _CONNECTED_S, alive)
        self._ack: Any = None
        self._beat_ns = 0

    def close(self) -> None:
        """Disconnect."""
        self._link.close()

    def run_until(self, done: Callable[[], bool], until_ns: int) -> bool:
        """Receive until `done` holds (True) or a CLOCK_MONOTONIC time is reached (False)."""
        while not done():
            now_ns = time.monotonic_ns()
            if now_ns >= until_ns:
                return False
            if now_ns - self._beat_ns >= _HEARTBEAT_NS:
                self._beat_ns = now_ns
                self._link.send_heartbeat()
            for message in self._link.receive():
                if message.get_srcComponent() == _CAMERA and message.get_type() == "COMMAND_ACK":
                    self._ack = message
        return True

    def track(self, x: float, y: float) -> tuple[int | None, int]:
        """Send MAV_CMD_CAMERA_TRACK_POINT for an image point, 0 to 1, until it is answered. Returns
        (MAV_RESULT or None, the target's number).
        """
        command = mavlink.MAV_CMD_CAMERA_TRACK_POINT
        for attempt in range(_TRIES):
            self._ack = None
            self._link.send(
                mavlink.MAVLink_command_long_message(1, _CAMERA, command, attempt, x, y, *[0.0] * 5)
            )
            self.run_until(lambda: self._is_answer(command), time.monotonic_ns() + _ANSWER_NS)
            if self._is_answer(command):
                return int(self._ack.result), int(self._ack.result_param2)
        return None, 0

    def _is_answer(self, command: int) -> bool:
        return self._ack is not None and self._ack.command == command
