"""Runs that pause after some minutes, and go on where they ended."""

from __future__ import annotations

import time
from collections.abc import Callable


def deadline(minutes: float) -> Callable[[], bool]:
    """Whether so many minutes from now have not passed."""
    end = time.monotonic() + 60.0 * minutes
    return lambda: time.monotonic() < end
