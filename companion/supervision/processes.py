"""Flight processes, as the supervisor starts and ends them."""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass

_DISMISS_S = 5.0
_KILL_S = 10.0  # its ports are free once it is gone, and not before
_READ = 4096
ENDING = "ending"  # the last word of a process whose end is in order


@dataclass(frozen=True)
class Beat:
    """Sign of life of a flight process: the component whose last cycle is oldest, and its age."""

    part: str
    age_s: float


class FlightProcess:
    """Starts (in the constructor; OSError) and controls a flight process. standby: it is started
    with ``--standby``, prepares and waits. hands_on: inherited file descriptors.

    It has its own process group, so that the terminal's interrupt reaches it through the supervisor
    only. It has no session of its own, because Linux schedules each session as one group and would
    ignore the supervisor's priority.
    """

    def __init__(
        self, command: Sequence[str], *, standby: bool, hands_on: Sequence[int] = ()
    ) -> None:
        self._beats, end = os.pipe()
        os.set_blocking(self._beats, False)
        self._unread = b""
        try:
            self._process = subprocess.Popen(
                [*command, f"--pulse={end}", *(["--standby"] if standby else [])],
                stdin=subprocess.PIPE if standby else subprocess.DEVNULL,
                pass_fds=(end, *hands_on),
            )
        except BaseException:
            os.close(self._beats)
            raise
        finally:
            os.close(end)

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def release(self) -> None:
        """Let a standby fly; harmless if it has died."""
        if self._process.stdin is not None:
            with contextlib.suppress(OSError, ValueError):
                self._process.stdin.write(b"fly\n")
                self._process.stdin.flush()

    def wait(self, timeout_s: float) -> int | None:
        """Wait; exit code, negative for a signal, or None while it runs after timeout_s."""
        try:
            return self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None

    def close(self) -> None:
        """Close the pipe of the signs of life, also repeatedly; the process goes on."""
        if self._beats >= 0:
            os.close(self._beats)
            self._beats = -1

    def beats(self) -> tuple[Beat, ...]:
        """Signs of life since the last call, oldest first. Never blocks."""
        try:
            while data := os.read(self._beats, _READ):
                self._unread += data
        except OSError:  # nothing more for now
            pass
        *lines, self._unread = self._unread.split(b"\n")
        self._unread = self._unread[:_READ]
        return tuple(beat for line in lines if (beat := _beat(line)) is not None)

    def kill(self) -> None:
        """Kill it (SIGKILL), and wait up to 10 s until it is gone."""
        self._process.kill()
        self.wait(_KILL_S)

    def send_signal(self, number: int) -> None:
        """Send the signal `number`; harmless if the process has ended."""
        with contextlib.suppress(ProcessLookupError):
            self._process.send_signal(number)

    def dismiss(self) -> None:
        """End an unused standby: close its input, kill it if it has not ended after 5 s, and close
        the pipes.
        """
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
        if self.wait(_DISMISS_S) is None:
            self.kill()
        self.close()


def _beat(line: bytes) -> Beat | None:
    """Parse a line of `companion.supervision.pulse`; None for anything else."""
    part, _, age_ms = line.decode(errors="replace").partition(" ")
    return Beat(part, int(age_ms) * 1e-3) if age_ms.isdecimal() and len(age_ms) < 12 else None
