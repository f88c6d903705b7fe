"""A benchmark's bad input, or what it lacks, in one line and exit code 2, as the companion's."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from companion.errors import CompanionError
from localizer.errors import LocalizerError
from mavlink_bridge.errors import BridgeError


@contextmanager
def named_errors() -> Iterator[None]:
    """Around a main function. Other errors are faults of the benchmark and keep their traceback."""
    try:
        yield
    except (CompanionError, LocalizerError, BridgeError, OSError) as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        sys.exit(2)
