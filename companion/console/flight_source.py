"""The running flight as a source, over its local socket; the flight may end and start again."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import socket
from pathlib import Path
from typing import Any

from companion.console.source import ConsoleSource
from companion.live.protocol import LinkError, Message, MessageDecoder, encode
from companion.live.shared import SharedMemoryReader

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
                raise LinkError("a picture whose size is no number")
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
