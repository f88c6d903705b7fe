"""How an operator's interrupt ends a process that has nothing to put away yet."""

from __future__ import annotations

import os

INTERRUPTED = 130  # the shell's convention: 128 + SIGINT


def end_at_once(*_: object) -> None:
    """A signal handler. One that raised would do so wherever the interpreter happens to be: in an
    import, a destructor or a compiler's callback, some of which catch it or print it and go on.
    """
    os._exit(INTERRUPTED)
