"""The page's HTTP server: uvicorn with a time limit for incomplete requests.

uvicorn waits without limit for the rest of a request and counts it among the open connections. So a
hundred clients that send half a line each would lock the operator out.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from companion.console.server import ConsoleSite, make_application

REQUEST_S = 10.0  # from the connection, or from a request's first byte, to its last
MOST_WAITING = 32  # connections without a whole request: one more, and the oldest goes
_MOST_CONNECTIONS = 64


class RequestTimeoutProtocol(H11Protocol):
    """Closes connections whose request is not complete in time, and the oldest of too many."""

    _deadline: asyncio.TimerHandle | None = None

    @property
    def due_s(self) -> float | None:
        """Time limit of the request, on the loop's clock; None without a request."""
        return None if self._deadline is None else self._deadline.when()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the time limit; see asyncio."""
        super().connection_made(transport)
        self._begin()
        waiting = [
            (other.due_s, id(other), other) for other in self.connections
            if isinstance(other, RequestTimeoutProtocol) and other.due_s is not None
        ]  # fmt: skip
        if len(waiting) > MOST_WAITING:
            min(waiting)[-1].give_up()

    def data_received(self, data: bytes) -> None:
        """Process received data; see asyncio."""
        if self._deadline is None:
            self._begin()
        super().data_received(data)
        if self.conn.their_state not in (h11.IDLE, h11.SEND_BODY):
            self._end()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """End the time limit, because the request is complete; the page continues."""
        self._end()
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """End the time limit; see asyncio."""
        self._end()
        super().connection_lost(exc)

    def give_up(self) -> None:
        """Close the connection without an answer."""
        self._end()
        self.transport.abort()

    def _begin(self) -> None:
        self._deadline = self.loop.call_later(REQUEST_S, self.give_up)

    def _end(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None


class Server(uvicorn.Server):
    """The console's HTTP server. on_ready: called once the page can be opened."""

    def __init__(self, site: ConsoleSite, on_ready: Callable[[], None]) -> None:
        config = site.config
        super().__init__(
            uvicorn.Config(
                make_application(site), host=config.host, port=config.port, log_level="warning",
                http=RequestTimeoutProtocol, ws="websockets-sansio", ws_max_size=4096,
                # JPEGs do not get smaller, and trying costs both ends.
                ws_per_message_deflate=False,
                limit_concurrency=_MOST_CONNECTIONS, timeout_keep_alive=5,
                timeout_graceful_shutdown=1, server_header=False, lifespan="on",
                ssl_certfile=config.tls_certificate, ssl_keyfile=config.tls_key,
            )
        )  # fmt: skip
        self._told = on_ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen, then call `on_ready`; see uvicorn."""
        await super().startup(sockets=sockets)
        if self.started:
            self._told()
