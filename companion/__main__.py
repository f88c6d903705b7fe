"""The process ``companion``: also ``python -m companion``."""

from __future__ import annotations

import os
import signal

INTERRUPTED = 130  # the shell's convention: 128 + SIGINT


def main() -> None:
    """Entry point. The imports take seconds, in which an operator may think better of it."""
    # A handler that raised would do so inside the imports, some of which catch it or print it.
    signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))
    from companion.cli import main as command_line

    signal.signal(signal.SIGINT, signal.default_int_handler)
    command_line()


if __name__ == "__main__":
    main()
