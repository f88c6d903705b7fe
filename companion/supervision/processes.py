"""Flight processes as the supervisor handles them."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Sequence

_DISMISS_S = 5.0


class FlightProcess:
    """A command that flies. standby: with ``--standby`` it prepares, and waits for a line.

    It has a session of its own: the terminal's interrupt comes through the supervisor alone.
    """

    def __init__(self, command: Sequence[str], *, standby: bool) -> None:
        self._process = subprocess.Popen(
            [*command, "--standby"] if standby else command,
            stdin=subprocess.PIPE if standby else subprocess.DEVNULL,
            start_new_session=True,
        )

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def release(self) -> None:
        """Let a standby fly; harmless where it died meanwhile: then its death is seen."""
        if self._process.stdin is not None:
            with contextlib.suppress(OSError, ValueError):
                self._process.stdin.write(b"fly\n")
                self._process.stdin.flush()

    def wait(self, timeout_s: float) -> int | None:
        """Its exit code, negative of a signal; None while it runs."""
        try:
            return self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None

    def interrupt(self, number: int) -> None:
        """Pass a signal on; harmless when it has ended."""
        with contextlib.suppress(ProcessLookupError):
            self._process.send_signal(number)

    def dismiss(self) -> None:
        """End a standby: its line never comes."""
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
        if self.wait(_DISMISS_S) is None:
            self._process.kill()
            self._process.wait()
