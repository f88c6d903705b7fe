"""Flight processes as the supervisor handles them."""

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
    """A sign of life: which part's last turn is longest ago, and how long."""

    part: str
    age_s: float


class FlightProcess:
    """A command that flies. standby: with ``--standby`` it prepares, and waits for a line.
    hands_on: descriptors that it may read, under the same numbers.

    It takes a process group of its own: the terminal's interrupt comes through the supervisor
    alone. Not a session: Linux schedules each as one, whatever priority the supervisor was given.
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

    def close(self) -> None:
        """Nothing is read of it any more."""
        if self._beats >= 0:
            os.close(self._beats)
            self._beats = -1

    def beats(self) -> tuple[Beat, ...]:
        """What it said since the last look."""
        try:
            while data := os.read(self._beats, _READ):
                self._unread += data
        except OSError:  # nothing more for now
            pass
        *lines, self._unread = self._unread.split(b"\n")
        self._unread = self._unread[:_READ]
        return tuple(beat for line in lines if (beat := _beat(line)) is not None)

    def kill(self) -> None:
        """End one that hangs; it may be stopped, or wait for a disk."""
        self._process.kill()
        self.wait(_KILL_S)

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
            self.kill()
        self.close()


def _beat(line: bytes) -> Beat | None:
    """A line of `companion.supervision.pulse`; None for anything else."""
    part, _, age_ms = line.decode(errors="replace").partition(" ")
    return Beat(part, int(age_ms) * 1e-3) if age_ms.isdecimal() and len(age_ms) < 12 else None
