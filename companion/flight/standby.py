"""A standby: a flight process that waits with map and network open and kernels compiled."""

from __future__ import annotations

import logging
import sys

from companion.config import CompanionConfig
from companion.errors import CompanionError
from companion.flight.app import Companion
from localizer.errors import LocalizerError

_log = logging.getLogger(__name__)


def released_companion(
    config: CompanionConfig,
    *,
    standby: bool,
    pulse: int | None,
    restart: bool = False,
    lost_settings: str = "",
) -> Companion | None:
    """The flight process, not yet running. A standby is prepared here and returned when a line
    comes on standard input, from the supervisor; None if the input ends without one.
    pulse, restart, lost_settings: see `Companion`. For a standby, restart is always true.
    """
    companion = Companion(
        config, pulse=pulse, restart=restart or standby, lost_settings=lost_settings
    )
    return _stand_by(companion) if standby else companion


def _stand_by(companion: Companion) -> Companion | None:
    """Prepare what takes long, then wait for a line on standard input.

    None if the input ends without a line, because the supervisor is gone. Neither link nor feed is
    opened before.
    """
    try:
        companion.prepare()
    except (CompanionError, LocalizerError, OSError) as error:  # the flight will say so, then
        _log.warning("standby is not warm: %s", error)
    if sys.stdin.readline():
        return companion
    companion.discard_prepared()
    return None
