"""Tracks nodes of a cache that could not be read, and when to retry."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

from localizer.errors import MapCacheError

_log = logging.getLogger(__name__)

_RETRY_S, _RETRY_MOST_S = 0.5, 30.0  # between attempts at a node that could not be read


@dataclass(frozen=True)
class _Failure:
    """Why a node could not be read, how often in a row, and when it is tried again."""

    error: MapCacheError
    count: int
    again_s: float


class FailedNodes:
    """Nodes that could not be read. Callers hold the streamer's lock. clock: returns seconds.
    attempts: number of failures so far.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._failures: dict[int, _Failure] = {}
        self.attempts = 0

    def __len__(self) -> int:
        return len(self._failures)

    def add(self, node: int, error: MapCacheError) -> None:
        """Record a failed read, and log a node's first; each further one delays its retry
        longer.
        """
        before = self._failures.get(node)
        if before is None:
            _log.error("%s", error)
        count = 1 if before is None else before.count + 1
        wait_s = min(_RETRY_S * 2.0 ** min(count - 1, 10), _RETRY_MOST_S)
        self._failures[node] = _Failure(error, count, self._clock() + wait_s)
        self.attempts += 1

    def remove(self, node: int) -> None:
        """Forget a node's failures, because it was read."""
        self._failures.pop(node, None)

    def is_waiting(self, node: int) -> bool:
        """Whether a node has failed and its retry is not due."""
        failure = self._failures.get(node)
        return failure is not None and self._clock() < failure.again_s

    def check(self, node: int) -> None:
        """Raise the node's `MapCacheError` while it is waiting."""
        if self.is_waiting(node):
            raise self._failures[node].error
