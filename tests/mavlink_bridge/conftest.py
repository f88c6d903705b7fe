"""A small autopilot on loopback, enough to hold a conversation with the bridge."""

from __future__ import annotations

import contextlib
import select
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink


class FakeAutopilot:
    """Speaks MAVLink 2 over UDP like an ArduCopter at rest: one thread, everything recorded."""

    def __init__(self, key: bytes | None = None, rate_hz: float = 50.0) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.setblocking(False)
        self.port: int = self.socket.getsockname()[1]
        self.peer: tuple[str, int] | None = None
        self.received: list[Any] = []
        self.origin: tuple[float, float, float] | None = None
        self.yaw = 0.0
        self.version = (4, 7, 0)
        self.autopilot = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
        self.streaming = True
        self.ekf_flags = 831
        self.ekf_horizontal_variance = 0.1
        self.rc: dict[int, int] = {}
        self.gps: tuple[int, float, float] | None = None
        self.local: tuple[float, float, float] = (0.0, 0.0, 0.0)
        self.parameters: dict[str, float] = {}
        self.ignore_commands: set[int] = set()
        self.boot_ns = time.monotonic_ns() - 100_000_000_000
        self.extra: Callable[[FakeAutopilot, int], list[Any]] | None = None
        self._rate_hz = rate_hz
        self.codec = mavlink.MAVLink(None, 1, 1)
        self.codec.robust_parsing = True
        if key is not None:
            self.codec.signing.secret_key = key
            self.codec.signing.sign_outgoing = True
            self.codec.signing.timestamp = int((time.time() - 1420070400) * 1e5)
        self._sending = threading.Lock()  # a test sends from its own thread, too
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def boot_ms(self) -> int:
        return (time.monotonic_ns() - self.boot_ns) // 1_000_000

    def reboot(self) -> None:
        self.boot_ns = time.monotonic_ns()
        self.origin = None

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()
        self.socket.close()

    def of(self, name: str, component: int | None = None) -> list[Any]:
        return [
            m
            for m in list(self.received)
            if m.get_type() == name and component in (None, m.get_srcComponent())
        ]

    def wait_for(self, name: str, count: int = 1, timeout_s: float = 30.0) -> list[Any]:
        end = time.monotonic() + timeout_s
        while len(self.of(name)) < count:
            if time.monotonic() > end:
                raise AssertionError(f"{count} {name} expected, {len(self.of(name))} came")
            time.sleep(0.01)
        return self.of(name)

    def send(self, message: Any, component: int = 1, system: int = 1) -> None:
        with self._sending:
            self.codec.srcSystem, self.codec.srcComponent = system, component
            frame = message.pack(self.codec)
            self.codec.seq = (self.codec.seq + 1) % 256
            self.send_bytes(frame)

    def send_bytes(self, data: bytes) -> None:
        if self.peer is not None:
            self.socket.sendto(data, self.peer)

    def _run(self) -> None:
        next_fast = next_slow = 0.0
        while not self._stop.is_set():
            select.select([self.socket], [], [], 0.005)
            self._receive()
            now = time.monotonic()
            if not self.streaming:
                continue
            if now >= next_slow:
                next_slow = now + 0.2
                self.slow()
            if now >= next_fast:
                next_fast = now + 1.0 / self._rate_hz
                self._fast()

    def _receive(self) -> None:
        while True:
            try:
                data, self.peer = self.socket.recvfrom(65536)
            except (BlockingIOError, ConnectionRefusedError):
                return
            for message in self.codec.parse_buffer(data) or []:
                self.received.append(message)
                if message.get_type() != "BAD_DATA":
                    self.answer(message)

    def answer(self, m: Any) -> None:
        kind = m.get_type()
        if kind == "TIMESYNC" and m.tc1 == 0:
            self.send(mavlink.MAVLink_timesync_message(time.monotonic_ns() - self.boot_ns, m.ts1))
        elif kind == "SET_GPS_GLOBAL_ORIGIN" and self.origin is None:
            self.origin = (m.latitude * 1e-7, m.longitude * 1e-7, m.altitude * 1e-3)
        elif kind == "COMMAND_LONG" and m.command not in self.ignore_commands:
            self._command(m)
        elif kind == "PARAM_REQUEST_READ":
            name = m.param_id.rstrip("\x00")
            if name in self.parameters:
                self.parameter(name)
        elif kind == "PARAM_SET":
            name = m.param_id.rstrip("\x00")
            if name in self.parameters:
                self.parameters[name] = m.param_value
                self.parameter(name)

    def parameter(self, name: str) -> None:
        self.send(
            mavlink.MAVLink_param_value_message(
                name.encode(), self.parameters[name], mavlink.MAV_PARAM_TYPE_REAL32, 1, 0
            )
        )

    def _command(self, m: Any) -> None:
        if m.command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            if m.param1 == mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION:
                self._send_version()
            elif m.param1 == mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN and self.origin is not None:
                lat, lon, alt = self.origin
                self.send(
                    mavlink.MAVLink_gps_global_origin_message(
                        round(lat * 1e7), round(lon * 1e7), round(alt * 1e3), 0
                    )
                )
        self.send(mavlink.MAVLink_command_ack_message(m.command, mavlink.MAV_RESULT_ACCEPTED))

    def _send_version(self) -> None:
        major, minor, patch = self.version
        flight = major << 24 | minor << 16 | patch << 8
        empty = [0] * 8
        self.send(
            mavlink.MAVLink_autopilot_version_message(
                0, flight, 0, 0, 0, empty, empty, empty, 0, 0, 0
            )
        )

    def slow(self) -> None:
        self.send(mavlink.MAVLink_heartbeat_message(2, self.autopilot, 81, 4, 4, 3))
        self.send(
            mavlink.MAVLink_ekf_status_report_message(
                self.ekf_flags, 0.0, self.ekf_horizontal_variance, 0.0, 0.0, 0.0
            )
        )
        if self.gps is not None:
            fix, lat, lon = self.gps
            self.send(
                mavlink.MAVLink_gps_raw_int_message(
                    0, fix, round(lat * 1e7), round(lon * 1e7), 500000, 80, 100, 0, 0, 12, 0, 800
                )
            )
        if self.rc:
            channels = [self.rc.get(i, 1500) for i in range(1, 19)]
            self.send(mavlink.MAVLink_rc_channels_message(self.boot_ms, 18, *channels, 255))

    def _fast(self) -> None:
        boot_ms = self.boot_ms
        self.send(mavlink.MAVLink_attitude_message(boot_ms, 0.0, 0.0, self.yaw, 0.0, 0.0, 0.0))
        self.send(mavlink.MAVLink_local_position_ned_message(boot_ms, *self.local, 0.0, 0.0, 0.0))
        if self.extra is not None:
            for message in self.extra(self, boot_ms):
                self.send(message)


@pytest.fixture
def autopilot() -> Iterator[FakeAutopilot]:
    fake = FakeAutopilot()
    yield fake
    fake.stop()


@pytest.fixture
def make_autopilot() -> Iterator[Callable[..., FakeAutopilot]]:
    made: list[FakeAutopilot] = []

    def make(**options: Any) -> FakeAutopilot:
        made.append(FakeAutopilot(**options))
        return made[-1]

    yield make
    for fake in made:
        fake.stop()


class GroundStation:
    """Listens on UDP for what the bridge's ground link says."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(0.1)
        self.port = self.socket.getsockname()[1]
        self.received: list[Any] = []
        self.peer: Any = None
        self._codec = mavlink.MAVLink(None, 255, 190)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.is_set():
            with contextlib.suppress(TimeoutError):
                data, self.peer = self.socket.recvfrom(65536)
                self.received += self._codec.parse_buffer(data) or []

    def of(self, name: str) -> list[Any]:
        return [m for m in list(self.received) if m.get_type() == name]

    def send(self, message: Any, system: int = 255) -> None:
        self.socket.sendto(message.pack(mavlink.MAVLink(None, system, 190)), self.peer)

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()
        self.socket.close()


@pytest.fixture
def ground() -> Iterator[GroundStation]:
    station = GroundStation()
    yield station
    station.stop()
