"""The process ``companion``: also ``python -m companion``."""

from __future__ import annotations

import signal

from companion.cli.output import end_at_once


def main() -> None:
    """Entry point. The operator can interrupt during the imports, which take seconds."""
    signal.signal(signal.SIGINT, end_at_once)
    from companion.cli.commands import main as command_line

    command_line()


if __name__ == "__main__":
    main()
