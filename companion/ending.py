"""Waits for the end of a thread with a time limit, so that a hanging thread does not block the
shutdown.
"""

from __future__ import annotations

import logging
import threading

_log = logging.getLogger(__name__)
_PATIENCE_S = 5.0


def wait_for_end(thread: threading.Thread) -> bool:
    """Wait up to 5 s for a started daemon thread that was told to end; returns whether it has. A
    thread that hangs, for example on a disk or device, is named in the log. The shutdown then
    continues, so that record and link are closed.
    """
    thread.join(_PATIENCE_S)
    if thread.is_alive():
        _log.warning("the thread %s does not end, it is left behind", thread.name)
    return not thread.is_alive()
