"""Ground station socket: connect, send, receive, heartbeat."""

from __future__ import annotations

import contextlib
import select
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.errors import PilotError

SYSTEM, COMPONENT = 255, 190  # of the ground station


def disable_reconnect(link: Any) -> None:
    """Keep pymavlink from printing and reconnecting when the vehicle closes a TCP link."""
    link.handle_eof = link.handle_disconnect = lambda: None


class Connection:
    """A MAVLink connection over TCP; any thread sends, one receives."""

    def __init__(self, endpoint: str) -> None:
        self.endpoint = endpoint
        self._link: Any = None
        self._send_lock = threading.Lock()

    def open(self, deadline: float, alive: Callable[[], None]) -> None:
        """Connect, retrying until `deadline` (time.monotonic()); `PilotError` after it. alive:
        raises if the vehicle has died.
        """
        while self._link is None:
            alive()
            try:
                self._link = mavutil.mavlink_connection(
                    self.endpoint,
                    source_system=SYSTEM,
                    source_component=COMPONENT,
                    dialect="ardupilotmega",
                    retries=0,
                    robust_parsing=True,
                )
            except OSError as error:
                if time.monotonic() > deadline:
                    raise PilotError(
                        f"no vehicle listens at {self.endpoint}: {error}; is it started?"
                    ) from error
                time.sleep(0.1)
        disable_reconnect(self._link)

    def shut_down(self) -> None:
        """Shut the socket down, so that a waiting `receive` returns; `close` comes later."""
        if self._link is not None:
            with contextlib.suppress(OSError):  # the vehicle may have closed it
                self._link.port.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Disconnect after the receiving thread has ended."""
        if self._link is not None:
            self._link.close()

    def send(self, message: Any) -> None:
        """Send one message, after `open`; OSError if the vehicle closed the link."""
        with self._send_lock:
            self._link.mav.send(message)

    def send_heartbeat(self) -> None:
        """Send the ground station's heartbeat if the link is open."""
        with contextlib.suppress(OSError):
            self.send(
                mavlink.MAVLink_heartbeat_message(
                    mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3
                )
            )

    def receive(self) -> list[Any]:
        """Messages received, after waiting up to 0.1 s; none from a closed link, or OSError."""
        port = self._link.port
        if port.fileno() < 0 or not select.select([port], [], [], 0.1)[0]:
            return []
        if not port.recv(1, socket.MSG_PEEK):
            time.sleep(0.05)  # closed by the vehicle; pymavlink would report that in a tight loop
            return []
        messages = []
        while (message := self._link.recv_msg()) is not None:
            messages.append(message)
        return messages
