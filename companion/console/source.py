"""Source of the page's data: a running flight over its local socket, or a record."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import socket
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from companion.live.protocol import LinkError, Message, MessageDecoder, SharedMemoryReader, encode

_TEN_MINUTES = 600
_EVENTS = 1000


@dataclass
class Newest:
    """The newest messages of a flight, and a short history. states, frames: counts by which a page
    notices new data.
    """

    hello: dict[str, Any] | None = None
    state: dict[str, Any] | None = None
    frame: Message | None = None
    states: int = 0
    frames: int = 0
    samples: deque[dict[str, Any]] = field(default_factory=lambda: deque(maxlen=_TEN_MINUTES))
    events: deque[dict[str, Any]] = field(default_factory=lambda: deque(maxlen=_EVENTS))

    def add(self, message: Message) -> None:
        """Store a message of the flight by its kind; "hello" clears samples and events."""
        kind = message.head.get("kind")
        if kind == "hello":
            self.hello = message.head
            self.samples.clear()
            self.events.clear()
        elif kind == "frame":
            self.frame = message
            self.frames += 1
        elif kind == "state":
            self.state = message.head
            self.states += 1
            self.events.extend(message.head.get("events") or ())
            sample = sample_of(message.head)
            if not self.samples or sample["t"] - self.samples[-1]["t"] >= 0.95:
                self.samples.append(sample)

    def is_armed(self) -> bool | None:
        """Whether the vehicle is armed; None if the flight does not hear it, False without one."""
        if self.hello is None:
            return False
        vehicle = (self.state or {}).get("vehicle") or {}
        return bool(vehicle.get("armed")) if vehicle.get("connected") else None


class ConsoleSource(ABC):
    """Data source of the console: a running flight or a record. newest: the data to show."""

    def __init__(self) -> None:
        self.newest = Newest()
        self._event = asyncio.Event()

    @property
    def is_connected(self) -> bool:
        """Whether the source delivers data now."""
        return True

    def watch(self, wanted: bool) -> None:  # noqa: B027
        """Request frames, or stop; without effect where frames come by themselves."""

    async def changed(self) -> None:
        """Wait until there are new data, or the connection changes."""
        await self._event.wait()

    @abstractmethod
    async def order(self, order: dict[str, Any]) -> tuple[bool, str]:
        """Send an order; returns whether it was executed, and a text."""

    @abstractmethod
    async def run(self) -> None:
        """Read the source until cancelled."""

    def _wake_waiters(self) -> None:
        """Wake everybody that waits in `changed`."""
        event, self._event = self._event, asyncio.Event()
        event.set()


def sample_of(state: dict[str, Any]) -> dict[str, Any]:
    """A sample of the plots from a state document: t in seconds UTC; None for unknown values."""
    estimate = state.get("estimate") or {}
    health = state.get("health") or {}
    integrity_monitor = health.get("guardian") or {}
    machine = state.get("machine") or {}
    vehicle = state.get("vehicle") or {}
    stages = estimate.get("stages_ms") or {}
    accepted = bool(estimate.get("accepted"))
    return {
        "t": (state.get("utc_ns") or 0) * 1e-9,
        "sigma_m": estimate.get("sigma_m") if accepted else None,
        "hpl_m": integrity_monitor.get("hpl_m"),
        "residual_m": state.get("gnss_residual_m"),
        "quality": estimate.get("quality"),
        "rate_hz": health.get("rate_hz"),
        **{name: stages.get(name) for name in ("reference", "extract", "register", "latency")},
        "cpu_percent": machine.get("cpu_percent"),
        "temperature_c": machine.get("temperature_c"),
        "vision": [estimate.get("latitude_deg"), estimate.get("longitude_deg")]
        if accepted else None,
        "autopilot": _place(vehicle, "latitude_deg", "longitude_deg"),
        "gnss": _place(vehicle, "gps_latitude_deg", "gps_longitude_deg")
        if (vehicle.get("gps_fix_type") or 0) >= 3 else None,
    }  # fmt: skip


def _place(vehicle: dict[str, Any], *keys: str) -> list[float] | None:
    values = [vehicle.get(key) for key in keys]
    return None if None in values else values  # type: ignore[return-value]  # no None in it


_log = logging.getLogger(__name__)
_AGAIN_S = 1.0
_ANSWER_S = 3.0
_READ = 1 << 20


class FlightSource(ConsoleSource):
    """Connects to the flight again and again. The last data stay, marked as not connected."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path
        self._connection: socket.socket | None = None
        self._wanted = False
        self._answers: dict[int, asyncio.Future[tuple[bool, str]]] = {}
        self._numbers = itertools.count(1)

    @property
    def is_connected(self) -> bool:
        """Whether the flight is connected."""
        return self._connection is not None

    def watch(self, wanted: bool) -> None:
        """Request frames from the flight, or stop; also from the next one that connects."""
        if wanted != self._wanted:
            self._wanted = wanted
            self._send({"kind": "watch", "frames": wanted})

    async def order(self, order: dict[str, Any]) -> tuple[bool, str]:
        """Send an order and wait up to 3 s for its result: whether it was executed, and a text.
        False without a connection or answer, though an order without answer may be executed.
        """
        if self._connection is None:
            return False, "no flight is connected"
        number = next(self._numbers)
        future: asyncio.Future[tuple[bool, str]] = asyncio.get_running_loop().create_future()
        self._answers[number] = future
        try:
            self._send({**order, "number": number})
            return await asyncio.wait_for(future, _ANSWER_S)
        except asyncio.TimeoutError:
            return False, "the flight did not answer"
        finally:
            self._answers.pop(number, None)

    async def run(self) -> None:
        """Connect and read, again and again, until cancelled."""
        while True:
            try:
                await self._serve()
            except (OSError, LinkError) as error:
                _log.debug("no flight at %s: %s", self._path, error)
            self._wake_waiters()
            await asyncio.sleep(_AGAIN_S)

    async def _serve(self) -> None:
        """Serve one connection until it ends."""
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        arrivals = SharedMemoryReader(connection)
        try:
            connection.setblocking(False)
            await asyncio.get_running_loop().sock_connect(connection, str(self._path))
            self._connection = connection
            if self._wanted:
                self._send({"kind": "watch", "frames": True})
            await self._read(connection, arrivals)
        finally:
            self._connection = None
            arrivals.close()

    async def _read(self, connection: socket.socket, arrivals: SharedMemoryReader) -> None:
        """Read all messages that have arrived; only the newest of them is shown."""
        loop, decoder = asyncio.get_running_loop(), MessageDecoder()
        readable = asyncio.Event()
        loop.add_reader(connection, readable.set)
        try:
            while True:
                await readable.wait()
                readable.clear()
                try:
                    data = arrivals.receive(_READ)
                except BlockingIOError:
                    continue
                if not data:
                    return
                for message in decoder.feed(data):
                    self._take(message, arrivals)
                self._wake_waiters()
        finally:
            loop.remove_reader(connection)

    def _take(self, message: Message, arrivals: SharedMemoryReader) -> None:
        head = message.head
        if head.get("kind") == "answer":
            self._answer(head)
            return
        if (size := head.get("shared")) is not None:
            if not isinstance(size, int):
                raise LinkError("an image whose size is no number")
            message = Message(head, arrivals.read(size))
            self._send({"kind": "read"})
        self.newest.add(message)

    def _answer(self, head: dict[str, Any]) -> None:
        future = self._answers.get(head.get("number", 0))
        if future is not None and not future.done():
            future.set_result((bool(head.get("ok")), str(head.get("text", ""))))

    def _send(self, head: dict[str, Any]) -> None:
        """Send a message whole, or close: a flight that does not read at once hangs."""
        if self._connection is not None:
            data = encode(head)
            try:
                sent = self._connection.send(data)
            except OSError as error:
                _log.debug("the flight takes no orders: %s", error)
                sent = 0
            if sent != len(data):
                with contextlib.suppress(OSError):
                    self._connection.shutdown(socket.SHUT_RDWR)
