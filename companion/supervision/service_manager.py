"""Reports to systemd over NOTIFY_SOCKET (sd_notify(3)): ready, alive, status."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import MutableMapping

_VARIABLE = "NOTIFY_SOCKET"
_LONGEST = 200  # characters of a status


class ServiceManager:
    """Reports to the service manager; does nothing with an empty address. Never blocks.

    address: of a datagram socket, a path, or ``@`` and a name in the abstract name space.
    """

    def __init__(self, address: str) -> None:
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        self._socket: socket.socket | None = None
        if address:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)

    @classmethod
    def of(cls, environment: MutableMapping[str, str]) -> ServiceManager:
        """From NOTIFY_SOCKET, "" if not set. It is removed from `environment`, so that child
        processes do not use it.
        """
        return cls(environment.pop(_VARIABLE, ""))

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def ready(self) -> None:
        """Report that the service has started."""
        self._say("READY=1")

    def alive(self) -> None:
        """Report a sign of life (WatchdogSec)."""
        self._say("WATCHDOG=1")

    def status(self, text: str) -> None:
        """Set the line for `systemctl status`, cut to 200 characters."""
        self._say(f"STATUS={text[:_LONGEST]}")

    def _say(self, text: str) -> None:
        if self._socket is None:
            return
        with contextlib.suppress(OSError):  # it restarts, or its queue is full: the flight goes on
            self._socket.sendto(text.encode(), self._address)
