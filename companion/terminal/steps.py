"""Shows the progress of a command: a spinner on a terminal, lines in a log; links to files."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.style import Style
from rich.text import Text


def file_link(path: Path) -> Text:
    """The path as text that links to the file (OSC 8), if the terminal supports it."""
    full = path.resolve()
    return Text(str(path), Style(color="green", link=full.as_uri()))


Say = Callable[[str], None]
_SILENT_S, _COUNT_EVERY_S, _EVERY_S = 2.0, 5.0, 10.0
COMPILES = "makes the localizer ready; a first start on a machine compiles its kernels"
READING = "reads the source"


@contextmanager
def show_steps(console: Console) -> Iterator[Say]:
    """Context manager: a callback that shows the present step. In a log each step is a line with
    the seconds since the start.
    """
    if not console.is_terminal:
        begun_s = time.monotonic()
        yield lambda text: console.print(
            f"{time.monotonic() - begun_s:4.0f} s {escape(text)}", highlight=False, soft_wrap=True
        )
        return
    with console.status("starting") as status:
        yield lambda text: status.update(escape(text))


@contextmanager
def show_count(console: Console, what: str, begins: str = "begun") -> Iterator[Callable[..., None]]:
    """Context manager for counted work. Gives a callback (done, total), which shows a bar, or in a
    log a line every few seconds. begins: text shown if nothing was counted after two seconds.
    """
    if console.is_terminal:
        from rich.progress import Progress

        with Progress(console=console) as bar:
            task = bar.add_task(what, total=None)
            yield lambda done, total: bar.update(task, completed=done, total=total)
        return
    lines = _Lines(console, what, begins)
    timer = threading.Timer(_SILENT_S, lines.begin)
    timer.daemon = True
    timer.start()
    try:
        yield lines.show
    finally:
        timer.cancel()


@contextmanager
def show_work(console: Console, what: str) -> Iterator[None]:
    """Context manager for work that cannot be counted: a spinner, or in a log a line after two
    seconds and then every ten.
    """
    if console.is_terminal:
        with console.status(escape(what)):
            yield
        return
    begun_s, over = time.monotonic(), threading.Event()

    def tell() -> None:
        wait_s = _SILENT_S
        while not over.wait(wait_s):
            line = f"{time.monotonic() - begun_s:4.0f} s {what}"
            console.print(line, highlight=False, soft_wrap=True, markup=False)
            wait_s = _EVERY_S

    threading.Thread(target=tell, name="progress", daemon=True).start()
    try:
        yield
    finally:
        over.set()


def tally(show: Callable[..., None], total: int | None = None) -> Callable[..., None]:
    """A callback that counts its calls and passes the count to `show`."""
    count = itertools.count(1)
    return lambda *_: show(next(count), total)


class _Lines:
    """Log lines of counted work: the first after two seconds, then one every few, and the last."""

    def __init__(self, console: Console, what: str, begins: str) -> None:
        self._console, self._what, self._begins = console, what, begins
        self._begun_s = time.monotonic()
        self._lock = threading.Lock()
        self._printed_s: float | None = None

    def begin(self) -> None:
        """Write that nothing was counted yet."""
        with self._lock:
            if self._printed_s is None:
                self._print(self._begins)

    def show(self, done: int, total: int | None) -> None:
        """Write how much is done, if a line is due. total: None if unknown."""
        with self._lock:
            now_s = time.monotonic() - self._begun_s
            is_first = self._printed_s is None and now_s >= _SILENT_S
            later = self._printed_s is not None and now_s - self._printed_s >= _COUNT_EVERY_S
            is_last = done == total and self._printed_s is not None
            if is_first or later or is_last:
                self._print(f"{done}" if total is None else f"{done} of {total}")

    def _print(self, text: str) -> None:
        self._printed_s = time.monotonic() - self._begun_s
        line = f"{self._printed_s:4.0f} s {self._what}: {text}"
        self._console.print(line, highlight=False, soft_wrap=True, markup=False)
