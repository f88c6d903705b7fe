"""What a command is doing: a spinner on a terminal, a line now and then in a log."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.markup import escape

Say = Callable[[str], None]


@contextmanager
def shown_steps(console: Console, clock: Callable[[], float] = time.monotonic) -> Iterator[Say]:
    """A callback that shows what is done from now on. Where there is no terminal, each step is a
    line with the seconds since the begin, so that a log shows where the time went.
    """
    if not console.is_terminal:
        begun_s = clock()
        yield lambda text: console.print(
            f"{clock() - begun_s:4.0f} s {escape(text)}", highlight=False, soft_wrap=True
        )
        return
    with console.status("starting") as status:
        yield lambda text: status.update(escape(text))


@contextmanager
def shown_count(console: Console, what: str, every_s: float = 5.0) -> Iterator[Callable[..., None]]:
    """A callback (done, total) for work that is counted: a bar, or a line every few seconds."""
    if console.is_terminal:
        from rich.progress import Progress

        with Progress(console=console) as bar:
            task = bar.add_task(what, total=None)
            yield lambda done, total: bar.update(task, completed=done, total=total)
        return
    begun_s = time.monotonic()
    printed_s = -every_s

    def show(done: int, total: int) -> None:
        nonlocal printed_s
        now_s = time.monotonic() - begun_s
        if now_s - printed_s >= every_s or done == total:
            printed_s = now_s
            console.print(f"{now_s:4.0f} s {what}: {done} of {total}", highlight=False)

    yield show
