"""The end of a thread, waited for with a limit: what hangs must not keep the rest from ending."""

from __future__ import annotations

import logging
import threading

_log = logging.getLogger(__name__)
_PATIENCE_S = 5.0


def joined(thread: threading.Thread) -> bool:
    """Whether a daemon thread that was told to end has ended. One that hangs (a disk that stands
    still, a device that does not answer) is named in the log and left behind: what is closed after
    it, the record and the link to the autopilot, is closed all the same.
    """
    thread.join(_PATIENCE_S)
    if thread.is_alive():
        _log.warning("the thread %s does not end, it is left behind", thread.name)
    return not thread.is_alive()
