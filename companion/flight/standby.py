"""A flight process that is ready but does not fly: imports done, kernels compiled."""

from __future__ import annotations

import logging
import sys

from companion.config import CompanionConfig
from companion.flight.app import Companion
from localizer.errors import LocalizerError
from localizer.tracking.opening import MapStack, build_localizer

_log = logging.getLogger(__name__)


def ready(config: CompanionConfig, *, standby: bool) -> Companion | None:
    """The flight process: at once, or once a standby is released; None of one that never is."""
    return _stand_by(config) if standby else Companion(config)


def _stand_by(config: CompanionConfig) -> Companion | None:
    """Load and compile what a flight needs, then wait for a line on the standard input.

    None where it ends without one: the supervisor is gone. Neither link nor feed is opened before,
    and the map is closed again: what stays is what takes long, imports, kernels, and the disk's
    cache of the map's files.
    """
    companion = Companion(config)
    try:
        stack = MapStack(config.map, config.localizer)
        try:
            build_localizer(stack, config.camera.model.camera(), config.localizer)
        finally:
            stack.close()
    except (LocalizerError, OSError) as error:  # the flight will say so, if it comes to that
        _log.warning("standby is not warm: %s", error)
    return companion if sys.stdin.readline() else None
