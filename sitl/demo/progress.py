"""Progress of a flight or of world generation: a bar on a terminal, lines in a log."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

LINE_EVERY_S = 10.0


class LogProgress:
    """Prints a line when the phase changes, and every ten seconds."""

    def __init__(self, console: Console) -> None:
        self._console, self._begun = console, time.monotonic()
        self._printed_s = 0.0
        self._phase: str | None = None

    def __call__(self, phase: str, share: float) -> None:
        """Report a phase; share: how much of the whole work is done, 0 to 1."""
        now_s = time.monotonic() - self._begun
        if phase == self._phase and now_s - self._printed_s < LINE_EVERY_S:
            return
        self._phase, self._printed_s = phase, now_s
        self._console.print(f"{now_s:4.0f} s {100 * share:3.0f} % {phase}", highlight=False)


@contextmanager
def shown_progress(console: Console) -> Iterator[Callable[[str, float], None]]:
    """Context manager: yields a callback (phase, share done from 0 to 1) that shows progress on
    `console`: a bar in a terminal, otherwise lines.
    """
    if not console.is_terminal:
        yield LogProgress(console)
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("", total=1.0, visible=False)  # until there is something to tell

        def show(phase: str, share: float) -> None:
            bar.update(task, description=phase, completed=share, visible=True)

        yield show
