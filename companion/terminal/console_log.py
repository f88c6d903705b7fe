"""Writes the log to the terminal on its own thread.

A terminal may be stopped (Ctrl-S) or hang with its radio link, a pipe may close, and a disk may be
full. A flight thread must neither wait for it nor end because of it.
"""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import sys
import threading
from collections.abc import Iterator
from logging.handlers import QueueHandler

from rich.console import Console
from rich.logging import RichHandler

OURS = ("companion", "localizer", "mavlink_bridge")
WAITING = 1000
_LAST_WORDS_S = 2.0


class Descriptor:
    """Unbuffered text output to a file descriptor; text that it does not accept is lost."""

    def __init__(self, number: int) -> None:
        self._number = number
        self.encoding = getattr(sys.stdout, "encoding", None) or "utf-8"

    def write(self, text: str) -> int:
        """Write as much as is accepted; returns the length of the text."""
        data = text.encode(self.encoding, "replace")
        with contextlib.suppress(OSError):
            while data:
                data = data[os.write(self._number, data) :]
        return len(text)

    def flush(self) -> None:
        """Does nothing: output is unbuffered."""

    def isatty(self) -> bool:
        """Whether it is a terminal."""
        return os.isatty(self._number)

    def fileno(self) -> int:
        """The descriptor."""
        return self._number


class _Queue(QueueHandler):
    """Passes log records on to the writing thread; those beyond the bound are lost."""

    def enqueue(self, record: logging.LogRecord) -> None:
        with contextlib.suppress(queue.Full):
            self.queue.put_nowait(record)


@contextlib.contextmanager
def console_log(verbose: bool, descriptor: int = 1) -> Iterator[None]:
    """Context manager: log to a file descriptor, by default standard output. Records beyond 1000
    that wait are lost; the end waits up to 2 s for the rest.

    verbose: of our own packages, because numba's own log is endless.
    """
    waiting: queue.Queue[logging.LogRecord | None] = queue.Queue(WAITING)
    console = Console(file=Descriptor(descriptor))  # type: ignore[arg-type]
    writer = RichHandler(show_path=False, console=console)
    over = threading.Event()  # the descriptor's number may soon be another file's

    def write() -> None:
        while (record := waiting.get()) is not None and not over.is_set():
            writer.handle(record)

    # A daemon: one that waits for a stopped terminal must not keep the process.
    thread = threading.Thread(target=write, name="console", daemon=True)
    thread.start()
    handler, root = _Queue(waiting), logging.getLogger()
    before = root.level
    root.addHandler(handler)
    root.setLevel(logging.INFO)
    for name in OURS:
        logging.getLogger(name).setLevel(logging.DEBUG if verbose else logging.NOTSET)
    try:
        yield
    finally:
        root.removeHandler(handler)
        root.setLevel(before)
        with contextlib.suppress(queue.Full):
            waiting.put_nowait(None)
        thread.join(_LAST_WORDS_S)
        over.set()
