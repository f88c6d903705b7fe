"""Byte transports of a MAVLink link: UDP in and out, TCP client and server, serial.

All are non-blocking and can be polled by file descriptor. `read` returns b"" if nothing has arrived
and raises OSError if the other side is gone; `write` returns the number of bytes accepted.
"""

from __future__ import annotations

import ipaddress
import math
import os
import socket
import time
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from mavlink_bridge.errors import EndpointError

Kind = Literal["udpin", "udpout", "tcp", "tcpin", "serial"]
_CONNECT_TIMEOUT_S = 2.0
_KEPT_S = 3.0  # without a heartbeat, as long as until the vehicle counts as lost
_MAX_REFUSED = 64
_READ_SIZE = 65536
_MARKERS = (b"\xfd", b"\xfe")  # of MAVLink 2 and 1
_HIGHEST_BAUD = 12_000_000
_LISTENING = ("udpin", "udp", "tcpin")
_KINDS: dict[str, Kind] = {
    "udpin": "udpin",
    "udp": "udpin",
    "udpout": "udpout",
    "tcp": "tcp",
    "tcpout": "tcp",
    "tcpin": "tcpin",
    "serial": "serial",
}


@dataclass(frozen=True)
class Endpoint:
    """One end of a link. address: host or serial device; number: port or baud rate."""

    kind: Kind
    address: str
    number: int

    @classmethod
    def parse(cls, text: str) -> Endpoint:
        """Parse ``kind:address:number``, such as ``udpin:0.0.0.0:14550``; else `EndpointError`."""
        kind, _, rest = text.partition(":")
        address, _, number = rest.rpartition(":")
        networked = kind in _KINDS and kind != "serial"
        # IPv4 and names only; a blank or a second colon would be tried for ever.
        unnamed = networked and not set(address).isdisjoint(" :[]/")
        if kind not in _KINDS or not address or not number.isdigit() or unnamed:
            raise EndpointError(
                f"{text!r} is no endpoint; write udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, "
                "tcpin:HOST:PORT or serial:DEVICE:BAUD"
            )
        lowest = 0 if kind in _LISTENING else 1  # 0 lets the system choose
        highest = _HIGHEST_BAUD if kind == "serial" else 65535
        if not lowest <= int(number) <= highest:
            what = "baud rate" if kind == "serial" else "port number"
            raise EndpointError(f"{text!r}: {number} is no {what}")
        return cls(_KINDS[kind], address, int(number))

    def __str__(self) -> str:
        return f"{self.kind}:{self.address}:{self.number}"


def parse_sender(text: str) -> tuple[str, int | None]:
    """Parse ADDRESS or ADDRESS:PORT (IPv4) of an accepted sender; else `EndpointError`."""
    host, _, port = text.partition(":")
    try:
        address = str(ipaddress.IPv4Address(host))
        number = int(port) if port else None
    except ValueError as error:
        raise EndpointError(f"{text!r} is no sender; write ADDRESS or ADDRESS:PORT") from error
    if text.endswith(":") or (number is not None and not 1 <= number <= 65535):
        raise EndpointError(f"{text!r}: no port number")
    return address, number


class Transport(Protocol):
    """An open byte stream or datagram socket; see the module."""

    @property
    def stream(self) -> bool:
        """Whether the transport notices a lost connection (TCP, serial); UDP does not."""

    def fileno(self) -> int:
        """File descriptor for poll."""

    def read(self) -> bytes:
        """Bytes that have arrived, b"" for none; OSError if the other side is gone."""

    def write(self, data: bytes) -> int:
        """Send bytes; returns the number accepted (0 without a peer or room)."""

    def close(self) -> None:
        """Close the transport."""


class UdpTransport:
    """A UDP socket. With `remote`, only that peer is accepted. Without it, every sender is accepted
    and the last one is answered, until `keep_peer` selects one.

    The peer may change its port (after a restart) once it was silent for 3 s. Another host is
    accepted only after the silence set by `follow_hosts_after`, otherwise never.
    """

    stream = False

    def __init__(self, local: tuple[str, int] | None, remote: tuple[str, int] | None) -> None:
        self.refused = 0
        self.stranger = ""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._remote = remote
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        self._socket.setblocking(False)
        if local is not None:
            # No SO_REUSEADDR: a second process on the port (doctor, in flight) would take it over.
            try:
                self._socket.bind(local)
            except OSError:
                self._socket.close()
                raise
        self._learn = remote is None
        self._sender = remote
        self._peer = remote
        self._only: tuple[str, int | None] | None = None
        self._heard_s = 0.0
        self._other_host_s = math.inf

    @property
    def port(self) -> int:
        """The local UDP port."""
        return int(self._socket.getsockname()[1])

    def fileno(self) -> int:
        """Descriptor for poll."""
        return self._socket.fileno()

    def accept_only(self, host: str, port: int | None) -> None:
        """Accept this sender only. port: None for any port of the host."""
        self._only = (host, port)

    def follow_hosts_after(self, silence_s: float) -> None:
        """Accept another host as the peer once this one was silent for silence_s."""
        self._other_host_s = silence_s

    def read(self) -> bytes:
        """One datagram of the peer, or of anyone while there is no peer; b"" if none waits."""
        for _ in range(_MAX_REFUSED):
            try:
                data, sender = self._socket.recvfrom(_READ_SIZE)
            except (BlockingIOError, ConnectionRefusedError):
                # Refused: an ICMP answer to something sent before the peer listened; UDP goes on.
                return b""
            if self._accepts(sender):
                break
            self.refused += 1
            self.stranger = sender[0]
        else:
            return b""
        self._sender = sender
        if self._learn and self._peer is None and data[:1] in _MARKERS:
            self._remote = sender
        return data

    def keep_peer(self) -> None:
        """Without `remote`: make the sender of the last datagram the only accepted peer."""
        if self._learn:
            self._remote = self._peer = self._sender
            self._heard_s = time.monotonic()

    def _accepts(self, sender: tuple[str, int]) -> bool:
        if self._only is not None:
            host, port = self._only
            if sender[0] != host or port not in (None, sender[1]):
                return False
        if self._peer is None or sender == self._peer:
            return True
        if not self._learn:
            return False
        silent_s = time.monotonic() - self._heard_s
        patience_s = _KEPT_S if sender[0] == self._peer[0] else self._other_host_s
        return silent_s >= patience_s

    def write(self, data: bytes) -> int:
        """Send one datagram to the peer; 0 without a peer or if the socket refuses."""
        if self._remote is None:
            return 0
        try:
            return self._socket.sendto(data, self._remote)
        except (BlockingIOError, ConnectionRefusedError):
            return 0

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class TcpTransport:
    """A connected TCP socket."""

    stream = True

    def __init__(self, connected: socket.socket) -> None:
        self._socket = connected
        self._socket.setblocking(False)
        # An estimate must not wait for the acknowledgement of the one before.
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def fileno(self) -> int:
        """Descriptor for poll."""
        return self._socket.fileno()

    def read(self) -> bytes:
        """Bytes that have arrived, b"" for none; ConnectionResetError at the end of the stream."""
        try:
            data = self._socket.recv(_READ_SIZE)
        except BlockingIOError:
            return b""
        if not data:
            raise ConnectionResetError("the other side closed the connection")
        return data

    def write(self, data: bytes) -> int:
        """Send what fits; returns the number of bytes."""
        try:
            return self._socket.send(data)
        except BlockingIOError:
            return 0

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class SerialTransport:
    """A serial port, by pyserial; `EndpointError` if that is not installed."""

    stream = True

    def __init__(self, device: str, baud: int) -> None:
        try:
            import serial
        except ImportError as error:
            raise EndpointError("serial endpoints need pyserial: pip install pyserial") from error
        # pyserial derives SerialException from OSError; a missing device is retried like any other.
        self._port: Any = serial.Serial(device, baud, timeout=0, write_timeout=0, exclusive=True)

    def fileno(self) -> int:
        """Descriptor for poll."""
        return int(self._port.fileno())

    def read(self) -> bytes:
        """Bytes that have arrived; OSError if the device is gone."""
        return bytes(self._port.read(max(1, self._port.in_waiting)))

    def write(self, data: bytes) -> int:
        """Send what fits; returns the number of bytes."""
        try:
            return os.write(self.fileno(), data)
        except BlockingIOError:
            return 0

    def close(self) -> None:
        """Close the port."""
        self._port.close()


def _accept(endpoint: Endpoint) -> TcpTransport:
    """Listen up to 2 s for one client; TimeoutError (an OSError) if none connects."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((endpoint.address, endpoint.number))
        listener.listen(1)
        listener.settimeout(_CONNECT_TIMEOUT_S)
        return TcpTransport(listener.accept()[0])


def open_transport(endpoint: Endpoint) -> Transport:
    """Open the endpoint; OSError if that fails and a retry may succeed, `EndpointError` without
    pyserial. Blocks up to 2 s for a TCP connection (tcpin: for a client), and to resolve a name.
    """
    where = (endpoint.address, endpoint.number)
    if endpoint.kind == "udpin":
        return UdpTransport(where, None)
    if endpoint.kind == "udpout":
        return UdpTransport(None, (socket.gethostbyname(endpoint.address), endpoint.number))
    if endpoint.kind == "tcp":
        return TcpTransport(socket.create_connection(where, timeout=_CONNECT_TIMEOUT_S))
    if endpoint.kind == "tcpin":
        return _accept(endpoint)
    return SerialTransport(endpoint.address, endpoint.number)
