"""Counters of an engine's threads, and the current error."""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass, replace

from localizer.errors import LocalizerError, OutsideMapError
from localizer.tracking.attitude_bias import AttitudeBias

_log = logging.getLogger(__name__)
_REPORT_EVERY_S = 5.0


@dataclass(frozen=True)
class EngineHealth:
    """Counters since the start, text of the present error ("" without one), and names of renderer,
    features and optimizer. no_map_in_view: whether the error is an `OutsideMapError` only.
    searches, found: numbers of searches and results; searching: whether one is running;
    search_hangs: whether it no longer responds. horizon_off_deg: attitude bias in pitch and roll,
    and the sigma after correction; None if not used.
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
    no_map_in_view: bool = False
    renderer: str = ""
    features: str = ""
    optimizer: str = ""
    horizon_off_deg: tuple[float, float, float] | None = None


class HealthCounters:
    """Collects the threads' counters. Thread-safe."""

    def __init__(self, renderer: str, features: str) -> None:
        self._health = EngineHealth(renderer=renderer, features=features)
        self._errors: dict[str, Exception] = {}  # by thread
        self._reported_s: dict[type[Exception], float] = {}
        self._lock = threading.Lock()

    def read(
        self, frames_dropped: int, optimizer: str, bias: AttitudeBias | None = None
    ) -> EngineHealth:
        """A snapshot, with values that only the engine has. bias: None: not estimated."""
        with self._lock:
            error = min(self._errors.values(), key=_is_outside, default=None)
            return replace(
                self._health,
                frames_dropped=frames_dropped,
                optimizer=optimizer,
                horizon_off_deg=None if bias is None else bias.reported_deg,
                last_error="" if error is None else _text(error),
                no_map_in_view=error is not None and _is_outside(error),
            )

    def count(self, **increments: int) -> None:
        """Add to counters of `EngineHealth`, by name."""
        with self._lock:
            h = self._health
            self._health = replace(h, **{k: getattr(h, k) + n for k, n in increments.items()})

    def set_searching(self, searching: bool) -> None:
        """Set whether a search is running; also resets `search_hangs`."""
        with self._lock:
            self._health = replace(self._health, searching=searching, search_hangs=False)

    def set_search_hangs(self, hangs: bool) -> None:
        """Set whether the running search no longer responds; its beginning is logged."""
        with self._lock:
            news = hangs and not self._health.search_hangs
            self._health = replace(self._health, search_hangs=hangs)
        if news:
            _log.error("the search for a place does not answer: the flight goes on without it")

    def report(self, error: Exception) -> None:
        """Set the calling thread's error until its `clear_error`, count it, and log it, at most one
        error of a kind in 5 s.
        """
        with self._lock:
            self._errors[threading.current_thread().name] = error
        self.count(errors=1)
        now = time.monotonic()
        if now - self._reported_s.get(type(error), -_REPORT_EVERY_S) > _REPORT_EVERY_S:
            self._reported_s[type(error)] = now
            _log.warning("%s", _text(error))

    def clear_error(self) -> None:
        """The calling thread works again: clear its error, but no other thread's."""
        with self._lock:
            self._errors.pop(threading.current_thread().name, None)


def _is_outside(error: Exception) -> bool:
    return isinstance(error, OutsideMapError)


def _text(error: Exception) -> str:
    known = isinstance(error, LocalizerError)
    return str(error) if known else f"unexpected {type(error).__name__}: {error}"
