"""The flight that runs, over its local socket; it may come, go and come again."""

from __future__ import annotations

import asyncio
import itertools
import logging
from pathlib import Path
from typing import Any

from companion.console.source import Newest
from companion.live.protocol import Decoder, LinkError, encode

_log = logging.getLogger(__name__)
_AGAIN_S = 1.0
_ANSWER_S = 3.0
_READ = 1 << 20


class FlightSource:
    """Connects again and again; what it showed last stays, marked as not connected."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.newest = Newest()
        self._writer: asyncio.StreamWriter | None = None
        self._wanted = False
        self._answers: dict[int, asyncio.Future[tuple[bool, str]]] = {}
        self._numbers = itertools.count(1)
        self._event = asyncio.Event()

    @property
    def is_connected(self) -> bool:
        """Whether the flight is there."""
        return self._writer is not None

    async def changed(self) -> None:
        """Returns when something new came, or the flight came or went."""
        await self._event.wait()

    def watch(self, wanted: bool) -> None:
        """Ask the flight for pictures, or not."""
        if wanted != self._wanted:
            self._wanted = wanted
            self._send({"kind": "watch", "frames": wanted})

    async def order(self, order: dict[str, Any]) -> tuple[bool, str]:
        """Send an order and wait for what becomes of it."""
        if self._writer is None:
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
        """Connect, read, and begin again."""
        while True:
            try:
                reader, self._writer = await asyncio.open_unix_connection(str(self._path))
                if self._wanted:
                    self._send({"kind": "watch", "frames": True})
                await self._read(reader)
            except (OSError, LinkError) as error:
                _log.debug("no flight at %s: %s", self._path, error)
            finally:
                writer, self._writer = self._writer, None
                if writer is not None:
                    writer.close()
                self._tell()
            await asyncio.sleep(_AGAIN_S)

    async def _read(self, reader: asyncio.StreamReader) -> None:
        decoder = Decoder()
        while data := await reader.read(_READ):
            for message in decoder.feed(data):
                if message.head.get("kind") == "answer":
                    self._answer(message.head)
                else:
                    self.newest.take(message)
            self._tell()

    def _answer(self, head: dict[str, Any]) -> None:
        future = self._answers.get(head.get("number", 0))
        if future is not None and not future.done():
            future.set_result((bool(head.get("ok")), str(head.get("text", ""))))

    def _tell(self) -> None:
        """Wake everybody that waits now."""
        event, self._event = self._event, asyncio.Event()
        event.set()

    def _send(self, head: dict[str, Any]) -> None:
        if self._writer is not None:
            self._writer.write(encode(head))
