"""TCP links and MAVLink routing as on ArduPilot's serial ports.

Each port accepts one client at a time. ArduPilot's routing rules apply: a link is sent nothing
until something was received on it, addressed messages go to links on which their target was heard,
unknown message ids are not forwarded.

Time stamps, as ArduPilot's JitterCorrection: the link's lag is the smallest over 100 samples. A
sample is never in the future, and at most 500 ms in the past. The smallest lag cannot be measured;
VISO_DELAY_MS compensates it.
"""

from __future__ import annotations

import contextlib
import math
import select
import socket
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.errors import PortError

_MAX_LAG_US = 500_000
_CONVERGENCE = 100


class JitterCorrection:
    """One per link: every time-stamped message of a link shares it."""

    def __init__(self) -> None:
        self._offset_us: int | None = None
        self._least_us = 0
        self._count = 0

    def correct(self, remote_us: int, local_us: int) -> int:
        """Local time (µs since boot) of a remote time stamp (µs, any epoch)."""
        difference = local_us - remote_us
        if self._offset_us is None or difference < self._offset_us:
            self._offset_us = difference
        estimate = remote_us + self._offset_us
        if estimate + _MAX_LAG_US < local_us:
            estimate = local_us - _MAX_LAG_US
            self._offset_us = estimate - remote_us
        self._least_us = difference if self._count == 0 else min(self._least_us, difference)
        self._count += 1
        if self._count == _CONVERGENCE:
            self._offset_us = self._least_us
            self._count = 0
        return estimate


_MAX_BACKLOG = 1 << 16  # bytes a stalled reader may leave before messages are dropped
_NEVER_FORWARDED = frozenset({"BAD_DATA", "RADIO", "RADIO_STATUS"})


@dataclass
class SerialPort:
    """One serial port and its client."""

    name: str
    listener: socket.socket
    system_id: int
    client: socket.socket | None = None
    intervals: dict[int, float] = field(default_factory=dict)  # message id -> seconds
    due: dict[int, float] = field(default_factory=dict)
    heard: set[tuple[int, int]] = field(default_factory=set)
    jitter: JitterCorrection = field(default_factory=JitterCorrection)
    dropped: int = 0

    def __post_init__(self) -> None:
        self._outgoing = bytearray()
        self._new_parser()

    def _new_parser(self) -> None:
        self._mav = mavlink.MAVLink(None, srcSystem=self.system_id, srcComponent=1)
        self._mav.robust_parsing = True

    def send(self, message: Any) -> None:
        """Queue one of the autopilot's own messages; dropped without a client, or if it stalls."""
        if self.client is not None:
            self._queue(message.pack(self._mav))
            self._mav.seq = (self._mav.seq + 1) % 256

    def forward(self, raw: bytes) -> None:
        """Queue a frame of another component unchanged."""
        if self.client is not None:
            self._queue(raw)

    def _queue(self, raw: bytes) -> None:
        if len(self._outgoing) + len(raw) > _MAX_BACKLOG:
            self.dropped += 1
            return
        self._outgoing += raw

    def set_interval(self, message_id: int, seconds: float | None) -> None:
        """Send this message every `seconds` (above 0) of the vehicle's time, from now on; None
        stops it.
        """
        if seconds is None:
            self.intervals.pop(message_id, None)
            self.due.pop(message_id, None)
        else:
            self.intervals[message_id] = seconds
            self.due[message_id] = 0.0

    def due_messages(self, now_s: float) -> list[int]:
        """Ids of streamed messages that are due, noted as sent; ATTITUDE before the truth's."""
        if self.client is None:
            return []
        ready = []
        for message_id, when in self.due.items():
            if now_s >= when:
                ready.append(message_id)
        for message_id in ready:
            # Phases are locked to boot time, so that messages of one rate share one tick.
            interval = self.intervals[message_id]
            self.due[message_id] = (math.floor(now_s / interval + 1e-6) + 1) * interval - 1e-6
        return sorted(ready)

    def receive(self) -> list[Any]:
        """All waiting messages. Without a client it accepts one; a closed client is dropped."""
        if self.client is None:
            self._accept()
            return []
        chunks = bytearray()
        try:
            while data := self.client.recv(65536):
                chunks += data
                if len(data) < 65536:
                    break
            else:
                self._drop()
        except BlockingIOError:
            pass
        except OSError:
            self._drop()
        if not chunks:
            return []
        return self._mav.parse_buffer(bytes(chunks)) or []

    def flush(self) -> None:
        """Write the queue as far as the socket accepts it."""
        if self.client is None or not self._outgoing:
            return
        try:
            sent = self.client.send(self._outgoing)
            del self._outgoing[:sent]
        except BlockingIOError:
            pass
        except OSError:
            self._drop()

    def _accept(self) -> None:
        try:
            client, _ = self.listener.accept()
        except BlockingIOError:
            return
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.client = client
        self._new_parser()

    def _drop(self) -> None:
        if self.client is not None:
            self.client.close()
        self.client = None
        self._outgoing.clear()

    def close(self) -> None:
        """Close client and listener."""
        self._drop()
        self.listener.close()


class MavlinkServer:
    """All links of the vehicle. `PortError` if a port cannot be listened on."""

    def __init__(self, ports: tuple[int, ...], system_id: int) -> None:
        self.system_id = system_id
        self.links: list[SerialPort] = []
        try:
            for number, port in enumerate(ports):
                self.links.append(SerialPort(f"serial{number}", _listen(port), system_id))
        except PortError:
            self.close()
            raise

    def poll(self) -> Iterator[tuple[SerialPort, Any]]:
        """Read what the links have received, without waiting. Messages for others are forwarded as
        ArduPilot does; those for the autopilot are yielded as (link, message).
        """
        sockets = [link.client or link.listener for link in self.links]
        ready = set(select.select(sockets, [], [], 0.0)[0])
        for link in self.links:
            if (link.client or link.listener) not in ready:
                continue
            for message in link.receive():
                if message.get_type() not in _NEVER_FORWARDED and self._route(link, message):
                    yield link, message

    def broadcast(self, message: Any) -> None:
        """Send one of the autopilot's own messages on every link."""
        for link in self.links:
            link.send(message)

    def flush(self) -> None:
        """Write everything that is queued."""
        for link in self.links:
            link.flush()

    def close(self) -> None:
        """Close all sockets."""
        for link in self.links:
            link.close()

    def _route(self, source: SerialPort, message: Any) -> bool:
        """Forward as ArduPilot's MAVLink_routing does; True if the autopilot handles it, too."""
        sender = (message.get_srcSystem(), message.get_srcComponent())
        if sender == (self.system_id, 1):
            return False  # our own, come back by a loop
        source.heard.add(sender)
        if message.get_type().startswith("UNKNOWN"):
            return False
        system = getattr(message, "target_system", 0)
        component = getattr(message, "target_component", 0)
        if (system, component) == (self.system_id, 1):
            return True
        others = [link for link in self.links if link is not source and link.heard]
        found = False
        for link in others:
            if _reaches(link, system, component):
                link.forward(bytes(message.get_msgbuf()))
                found = True
        if system == 0:
            return True
        return system == self.system_id and (component == 0 or not found)


def _reaches(link: SerialPort, system: int, component: int) -> bool:
    if system == 0:
        return True
    if component == 0:
        return any(heard[0] == system for heard in link.heard)
    return (system, component) in link.heard


def _listen(port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind(("127.0.0.1", port))
    except OSError as error:
        with contextlib.suppress(OSError):
            listener.close()
        raise PortError(
            f"TCP port {port} cannot be listened on ({error.strerror}): "
            "another vehicle may run; choose another --port"
        ) from error
    listener.listen(1)
    listener.setblocking(False)
    return listener
