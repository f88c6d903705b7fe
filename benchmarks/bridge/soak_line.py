"""The line of the soak test, which does everything wrong, and the vehicle at its end."""

from __future__ import annotations

import random
import select
import socket
import time
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.geodesy import Location
from sitl.vehicles.launch import GIMBAL, EmbeddedSitl, vision_only_parameters

HOME = Location(47.397742, 8.545594, 488.0)

# Share of the flight that each fault begins at, its kind, and its length in seconds of 30 minutes.
SCHEDULE = (
    (0.08, "fuzz", 60.0),
    (0.14, "reset", 30.0),
    (0.19, "silence", 30.0),
    (0.24, "reboot", 0.0),
    (0.30, "stall", 30.0),
    (0.35, "fuzz", 60.0),
    (0.42, "cut", 300.0),
    (0.64, "fuzz", 60.0),
    (0.70, "reboot", 0.0),
    (0.76, "cut", 60.0),
    (0.82, "fuzz", 120.0),
    (0.92, "reset", 20.0),
)


@dataclass(frozen=True)
class LineFault:
    """What the line did, CLOCK_MONOTONIC seconds."""

    kind: str
    begun: float
    ended: float


def damage(data: bytes, rng: random.Random, held: list[bytes]) -> bytes:
    """What becomes of a chunk: flipped, cut, doubled, swapped with the next, mixed with noise."""
    kind = rng.randrange(8)
    if kind == 0 and data:
        at = rng.randrange(len(data))
        data = data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]
    elif kind == 1:
        data = data[: rng.randrange(len(data) + 1)]
    elif kind == 2:
        data = data + data
    elif kind == 3:
        held.append(data)
        return b""
    elif kind == 4:
        data = data + rng.randbytes(rng.randrange(200))
    elif kind == 5:
        data = data + bytes([0xFD]) * rng.randrange(1, 50)
    while held:
        data += held.pop()
    return data


class SoakLine:
    """A TCP line between the bridge and the vehicle, and a ground station that talks nonsense."""

    def __init__(self, vehicle: EmbeddedSitl, rng: random.Random) -> None:
        self._vehicle, self._rng = vehicle, rng
        self._listener = self._listen(0)
        self.port: int = self._listener.getsockname()[1]
        self.ground = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.ground.bind(("127.0.0.1", 0))
        self.ground.setblocking(False)
        self._ground_peer: Any = None
        self._pair: tuple[socket.socket, socket.socket] | None = None
        self._held: tuple[list[bytes], list[bytes]] = ([], [])
        self.kind = ""

    @staticmethod
    def _listen(port: int) -> socket.socket:
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(("127.0.0.1", port))
        listener.listen(1)
        return listener

    def hang_up(self) -> None:
        """Close the connection on both sides."""
        for end in self._pair or ():
            end.close()
        self._pair = None

    def refuse(self, *, refusing: bool) -> None:
        """Whether nobody listens at all."""
        if refusing:
            self.hang_up()
            self._listener.close()
        else:
            self._listener = self._listen(self.port)

    def pass_for(self, seconds: float) -> None:
        """Carry bytes."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            try:
                self._step()
            except OSError:
                self.hang_up()

    def _step(self) -> None:
        sockets: list[socket.socket] = [self.ground]
        if self.kind != "cut":
            sockets += self._pair or (self._listener,)
        if self.kind == "stall" and self._pair:
            sockets.remove(self._pair[0])
        ready = select.select(sockets, [], [], 0.05)[0]
        if self.ground in ready:
            self._ground()
        if self._pair is None and self._listener in ready:
            host, port = self._vehicle.companion_endpoint.split(":")[1:]
            bridge = self._listener.accept()[0]
            try:
                self._pair = (bridge, socket.create_connection((host, int(port)), 2.0))
            except OSError:
                bridge.close()
                time.sleep(0.2)
            return
        for i, end in enumerate(self._pair or ()):
            if end in ready and self._pair is not None:
                data = end.recv(65536)
                if not data:
                    raise ConnectionResetError("end of stream")
                if self.kind == "silence":
                    continue
                if self.kind == "fuzz" and self._rng.random() < 0.4:
                    data = damage(data, self._rng, self._held[i])
                if self.kind == "reset" and self._rng.random() < 0.02:
                    raise ConnectionResetError("pulled")
                self._pair[1 - i].sendall(data)

    def _ground(self) -> None:
        data, self._ground_peer = self.ground.recvfrom(65536)
        if self.kind == "fuzz" or self._rng.random() < 0.02:
            for piece in (damage(data, self._rng, []), self._command()):
                self.ground.sendto(piece[:1400], self._ground_peer)

    def _command(self) -> bytes:
        """A frame whose checksum is right and whose content makes no sense."""
        numbers = [self._rng.choice([0.0, -1.0, 1e30, float("nan"), 0.5, 260.0]) for _ in range(7)]
        command = self._rng.choice([2004, 2005, 2010, 511, 512, 521, 31010, 65535])
        component = self._rng.choice([0, 100, 197, 191])
        message = mavlink.MAVLink_command_long_message(1, component, command, 0, *numbers)
        return bytes(message.pack(mavlink.MAVLink(None, 255, 190)))


def world(pipe: Any, minutes: float, seed: int) -> None:
    """Vehicle and line; sends the ports, waits for the start, then the faults as they end."""
    rng = random.Random(seed)
    with EmbeddedSitl(HOME, parameters={**vision_only_parameters(), **GIMBAL}) as vehicle:
        line = SoakLine(vehicle, rng)
        pipe.send((line.port, line.ground.getsockname()[1]))
        begun, scale = time.monotonic(), minutes / 30.0
        for share, kind, seconds in SCHEDULE:
            line.pass_for(begun + share * minutes * 60.0 - time.monotonic())
            start = time.monotonic()
            pipe.send(LineFault(kind, start, 0.0))
            if kind == "reboot":
                line.hang_up()
                vehicle.restart()
            else:
                line.kind = kind
                if kind == "cut":
                    line.refuse(refusing=True)
                line.pass_for(seconds * min(scale, 1.0))
                if kind == "cut":
                    line.refuse(refusing=False)
                line.kind = ""
            pipe.send(LineFault(kind, start, time.monotonic()))
        line.pass_for(begun + minutes * 60.0 - time.monotonic())
        line.hang_up()
