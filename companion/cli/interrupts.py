"""Ends a process that needs no clean-up at the operator's interrupt."""

from __future__ import annotations

import os

INTERRUPTED = 130  # the shell's convention: 128 + SIGINT


def end_at_once(*_: object) -> None:
    """Signal handler that exits at once. An exception could be raised inside an import, a
    destructor or a compiler callback, which may catch it and continue.
    """
    os._exit(INTERRUPTED)
