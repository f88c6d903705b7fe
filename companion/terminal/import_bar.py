"""The progress bar of `companion map build`."""

from __future__ import annotations

from types import TracebackType

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


class ImportBar:
    """A callback of `build_cache` as a bar: shown from the first call until all tiles are done."""

    def __init__(self) -> None:
        columns = (TextColumn("importing tiles"), BarColumn(), MofNCompleteColumn())
        self._bar = Progress(*columns, TimeRemainingColumn())
        self._task = self._bar.add_task("", total=None)
        self._began = False

    def __enter__(self) -> ImportBar:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stop()

    def __call__(self, done: int, total: int) -> None:
        """Show that `done` of `total` tiles are imported."""
        self._bar.update(self._task, completed=done, total=total)
        if not self._began:
            self._began = True
            self._bar.start()
        if done == total:
            self._stop()

    def _stop(self) -> None:
        if self._bar.live.is_started:
            self._bar.stop()
