"""Serves the console from the flight process over a local socket, in one thread.

At most one unfinished message per console is kept; others are dropped. Frames pass through shared
memory (`live.protocol`), one at a time: the newest frame is written after the console has read the
one before. Without a console the thread sleeps.
"""

from __future__ import annotations

import contextlib
import logging
import selectors
import socket
import threading
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.live.orders import OrderError, Orders
from companion.live.protocol import MOST_ORDER, LinkError, MessageDecoder, SharedMemory, encode
from companion.live.shown import ConsoleData, ConsoleFrame

_log = logging.getLogger(__name__)
_MOST_CONSOLES = 3
_STATE_S = 0.5
_PAUSE_S = 1.0  # after a failure, which may last: nothing is tried more often
_ANSWERS = 8


@dataclass
class RateLimiter:
    """Limits the mean rate: the next event is due a period after the last was due, not after it was
    sent. Otherwise 10 Hz frames limited to 6 Hz would be sent every 200 ms, at 5 Hz.
    """

    period_s: float
    due_s: float = 0.0

    def is_due(self, now_s: float) -> bool:
        """Whether an event may be sent now; CLOCK_MONOTONIC in s."""
        return now_s >= self.due_s

    def mark_sent(self, now_s: float) -> None:
        """Note that an event was sent; the next is due one period after this one was due."""
        self.due_s = max(self.due_s + self.period_s, now_s)


class _Console:
    """One connection. watching: it wants frames; last_event: number of the newest event sent."""

    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self.decoder = MessageDecoder(MOST_ORDER, 0)
        self.sending = memoryview(b"")
        self.answers: deque[bytes] = deque(maxlen=_ANSWERS)
        self.last_event = 0
        self.watching = False
        self.memory: SharedMemory | None = None  # once it wants pictures

    @property
    def is_idle(self) -> bool:
        return not self.sending

    @property
    def is_ready(self) -> bool:
        """Whether a frame can be sent."""
        return self.watching and self.is_idle and (self.memory is None or self.memory.is_read)

    def send(self) -> None:
        """Send as much of the message as the socket takes."""
        while self.sending:
            taking = self.connection.send if self.memory is None else self._send_with_memory
            self.sending = self.sending[taking(self.sending) :]

    def close(self) -> None:
        if self.memory is not None:
            self.memory.close()
        self.connection.close()

    def _send_with_memory(self, data: memoryview) -> int:
        assert self.memory is not None
        return self.memory.send(self.connection, data)


class Publisher:
    """Serves console processes at the socket `path`, which the constructor makes (`LinkError`), in
    a thread of its own.

    shown: gives state documents and frames; orders: executes the console's orders. frames_hz: limit
    of frames per second. The flight calls only `start`, `stop` and `wake`.
    """

    def __init__(self, path: Path, shown: ConsoleData, orders: Orders, frames_hz: float) -> None:
        self.path, self._data, self._orders = path, shown, orders
        self._pictures = RateLimiter(1.0 / frames_hz)
        self._consoles: dict[socket.socket, _Console] = {}
        self._selector = selectors.DefaultSelector()
        self._woken, self._waker = socket.socketpair()
        for end in (self._woken, self._waker):
            end.setblocking(False)
        self._listening = _listen(path)
        self._stopping = threading.Event()
        self._next_state_s = 0.0
        self._accept_again_s: float | None = None  # while no connection can be taken
        self._thread = threading.Thread(target=self._run, name="console link", daemon=True)

    @property
    def is_watched(self) -> bool:
        """Whether a console requests frames."""
        return any(c.watching for c in tuple(self._consoles.values()))

    def start(self) -> None:
        """Start the thread."""
        self._selector.register(self._listening, selectors.EVENT_READ, self._accept)
        self._selector.register(self._woken, selectors.EVENT_READ, self._clear_wake)
        self._thread.start()

    def stop(self) -> None:
        """End the thread and close all connections; waits up to 2 s."""
        self._stopping.set()
        self.wake()
        if self._thread.ident is not None:
            self._thread.join(2.0)

    def close(self) -> None:
        """Close the socket and remove its file, after `stop`."""
        for end in (self._listening, self._woken, self._waker):
            end.close()
        with contextlib.suppress(OSError):
            self.path.unlink()

    def wake(self) -> None:
        """Wake the thread, because a new frame is available. Never blocks."""
        with contextlib.suppress(OSError):
            self._waker.send(b"1")

    def _run(self) -> None:
        # Of the process's own priority: a thread of a lower one that is put aside while it holds
        # the interpreter would hold up every thread that flies.
        while not self._stopping.is_set():
            try:
                self._serve_once()
            except Exception:  # whatever the console does, the flight goes on without it
                _log.exception("the console's link failed and starts over")
                self._drop_all()
                self._stopping.wait(_PAUSE_S)
        self._drop_all()
        self._selector.close()

    def _serve_once(self) -> None:
        due = [self._next_state_s] if self._consoles else []
        due += [] if self._accept_again_s is None else [self._accept_again_s]
        timeout = max(min(due) - time.monotonic(), 0.0) if due else None
        for key, events in self._selector.select(timeout):
            key.data(key.fileobj, events)
        now = time.monotonic()
        if self._accept_again_s is not None and now >= self._accept_again_s:
            self._accept_again_s = None
            self._selector.register(self._listening, selectors.EVENT_READ, self._accept)
        if self._consoles and now >= self._next_state_s:
            self._next_state_s = now + _STATE_S
            for console in [c for c in self._consoles.values() if c.is_idle]:
                head, last_event = self._data.state(console.last_event)
                if self._begin_send(console, encode(head)):
                    console.last_event = last_event
        ready = [c for c in self._consoles.values() if c.is_ready]
        if ready and self._pictures.is_due(now) and (shot := self._data.take_frame()):
            self._pictures.mark_sent(now)
            for console in ready:
                self._show(console, shot)

    def _accept(self, listening: Any, _: int) -> None:
        try:
            connection, _address = listening.accept()
        except (BlockingIOError, ConnectionAbortedError):
            return  # it went again
        except OSError as error:
            # Whoever waits keeps the socket readable: without a pause this thread would spin.
            _log.warning("no console can connect for %.0f s: %s", _PAUSE_S, error)
            self._selector.unregister(listening)
            self._accept_again_s = time.monotonic() + _PAUSE_S
            return
        if len(self._consoles) >= _MOST_CONSOLES:
            connection.close()
            return
        connection.setblocking(False)
        console = _Console(connection)
        self._consoles[connection] = console
        self._selector.register(connection, selectors.EVENT_READ, self._serve)
        self._next_state_s = 0.0
        self._begin_send(console, encode(self._data.first_message()))

    def _clear_wake(self, woken: Any, _: int) -> None:
        with contextlib.suppress(OSError):
            woken.recv(4096)

    def _serve(self, connection: Any, events: int) -> None:
        console = self._consoles[connection]
        try:
            if events & selectors.EVENT_WRITE:
                self._send(console)
            if events & selectors.EVENT_READ:
                data = connection.recv(MOST_ORDER)
                if not data:
                    raise LinkError("closed")
                for message in console.decoder.feed(data):
                    self._handle(console, message.head)
        except BlockingIOError:
            pass
        except (OSError, LinkError):
            self._drop(console)

    def _handle(self, console: _Console, head: dict[str, Any]) -> None:
        if head.get("kind") == "watch":
            console.watching = head.get("frames") is True
            return
        if head.get("kind") == "read":
            if console.memory is not None:
                console.memory.is_read = True
            return
        try:
            ok, text = True, self._orders.execute(head)
        except OrderError as error:
            ok, text = False, str(error)
        number = head.get("number")
        if isinstance(number, int):
            answer = {"kind": "answer", "number": number, "ok": ok, "text": text}
            console.answers.append(encode(answer))
        if console.is_idle:
            self._next_answer(console)

    def _show(self, console: _Console, shot: ConsoleFrame) -> None:
        try:
            if console.memory is None:
                console.memory = SharedMemory()
            size = console.memory.write(shot.parts)
        except OSError as error:  # no memory, or no descriptor: what is flown needs both more
            _log.warning("a console cannot be given images and is left: %s", error)
            self._drop(console)
            return
        self._begin_send(console, encode(shot.head | {"shared": size}))

    def _begin_send(self, console: _Console, message: bytes) -> bool:
        """Begin to send, if no message is under way; whether it was begun."""
        if not console.is_idle:
            return False
        console.sending = memoryview(message)
        try:
            self._send(console)
        except BlockingIOError:
            pass
        except OSError:
            self._drop(console)
            return False
        return True

    def _send(self, console: _Console) -> None:
        try:
            console.send()
        finally:
            if console.connection in self._consoles:
                wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if console.sending else 0)
                self._selector.modify(console.connection, wanted, self._serve)
        self._next_answer(console)

    def _next_answer(self, console: _Console) -> None:
        if console.answers and console.is_idle:
            self._begin_send(console, console.answers.popleft())

    def _drop(self, console: _Console) -> None:
        if self._consoles.pop(console.connection, None) is not None:
            self._selector.unregister(console.connection)
            console.close()

    def _drop_all(self) -> None:
        for console in tuple(self._consoles.values()):
            self._drop(console)


def _listen(path: Path) -> socket.socket:
    """Listen at a Unix socket of that path, which only this user can use."""
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        path.unlink(missing_ok=True)  # of a process that was killed
        listening.bind(str(path))
        path.chmod(0o600)
        listening.listen(_MOST_CONSOLES)
        listening.setblocking(False)
    except OSError as error:
        listening.close()
        raise LinkError(f"{path}: the console's socket cannot be made: {error}") from error
    return listening
