"""Counters of an engine's threads, and the current error."""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass, replace

from localizer.errors import LocalizerError, MapLoadingError
from localizer.tracking.attitude_bias import AttitudeBias

_log = logging.getLogger(__name__)
_REPORT_EVERY_S = 5.0


@dataclass(frozen=True)
class EngineHealth:
    """Counters since the start, the text of the error that stands ("" when none does), and which
    renderer, feature network and optimizer serve. map_loading: that error is that tiles are still
    being read. searches, found: of places without a prior;
    searching: whether one is under way; search_hangs: for so long that none will answer.
    horizon_off_deg: what autopilot and gimbal are off by in pitch and roll, and the sigma of their
    attitude once that is taken out; None where it is not used.
    """

    frames_in: int = 0
    frames_dropped: int = 0
    localized: int = 0
    accepted: int = 0
    references: int = 0
    errors: int = 0
    searches: int = 0
    found: int = 0
    searching: bool = False
    search_hangs: bool = False
    last_error: str = ""
    map_loading: bool = False
    renderer: str = ""
    features: str = ""
    optimizer: str = ""
    horizon_off_deg: tuple[float, float, float] | None = None


class HealthBook:
    """Collects the threads' counters; every method may be called by any of them."""

    def __init__(self, renderer: str, features: str) -> None:
        self._health = EngineHealth(renderer=renderer, features=features)
        self._errors: dict[str, Exception] = {}  # by thread
        self._reported_s = -_REPORT_EVERY_S
        self._lock = threading.Lock()

    def read(
        self, frames_dropped: int, optimizer: str, bias: AttitudeBias | None = None
    ) -> EngineHealth:
        """A snapshot, with what only the engine knows."""
        with self._lock:
            error = next(iter(self._errors.values()), None)
            return replace(
                self._health,
                frames_dropped=frames_dropped,
                optimizer=optimizer,
                horizon_off_deg=None if bias is None else bias.reported_deg,
                last_error="" if error is None else _text(error),
                map_loading=isinstance(error, MapLoadingError),
            )

    def count(self, **increments: int) -> None:
        """Add to counters of `EngineHealth`, by name."""
        with self._lock:
            h = self._health
            self._health = replace(h, **{k: getattr(h, k) + n for k, n in increments.items()})

    def set_searching(self, searching: bool) -> None:
        """Whether a search for a place is under way; it begins or answers, so it does not hang."""
        with self._lock:
            self._health = replace(self._health, searching=searching, search_hangs=False)

    def set_search_hangs(self, hangs: bool) -> None:
        """Whether the one under way does not answer any more."""
        with self._lock:
            news = hangs and not self._health.search_hangs
            self._health = replace(self._health, search_hangs=hangs)
        if news:
            _log.error("the search for a place does not answer: the flight goes on without it")

    def report(self, error: Exception) -> None:
        """An error of this thread: it stands until the thread has done its work again."""
        with self._lock:
            self._errors[threading.current_thread().name] = error
        self.count(errors=1)
        now = time.monotonic()
        if now - self._reported_s > _REPORT_EVERY_S:
            self._reported_s = now
            _log.warning("%s", _text(error))

    def clear_error(self) -> None:
        """This thread has done its work: an error of its own is over, another thread's is not."""
        with self._lock:
            self._errors.pop(threading.current_thread().name, None)


def _text(error: Exception) -> str:
    known = isinstance(error, LocalizerError)
    return str(error) if known else f"unexpected {type(error).__name__}: {error}"
