"""Keeps the flight process alive: a process of its own that does nothing else.

It waits for the flight process to end. A death is told to the operator and marked in
``health.json`` within a second, and a standby process, whose imports and compiled kernels are in
memory already, takes over. Deaths that come too fast end it: something is wrong that no restart
mends.
"""

from __future__ import annotations

import json
import logging
import signal
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

_log = logging.getLogger(__name__)
_WATCH_S = 0.5  # between looks at what else is due; a death wakes at once
_AGAIN_S = 1.0
_USAGE = 2  # exit code of a named error


class Process(Protocol):
    """A flight process."""

    @property
    def pid(self) -> int:
        """Its process id."""

    def release(self) -> None:
        """Let a standby fly."""

    def wait(self, timeout_s: float) -> int | None:
        """Its exit code, negative of a signal; None while it runs."""

    def interrupt(self, number: int) -> None:
        """Pass a signal on; harmless when it has ended."""

    def dismiss(self) -> None:
        """End a standby that is not needed, and reap it."""


@dataclass(frozen=True)
class RestartPolicy:
    """At most `deaths` within `window_s`; a standby is made once one flies for `standby_after_s`:
    its imports take a core for seconds.
    """

    deaths: int = 5
    window_s: float = 300.0
    standby_after_s: float = 20.0


class Supervisor:
    """`run` until the flight is over.

    spawn: makes a process, flying at once or as a standby. tell: a line (severity, text) to the
    operator; mark: what ``health.json`` is to say. clock: monotonic seconds; pause: sleeps so many.
    """

    def __init__(
        self,
        spawn: Callable[[bool], Process],
        tell: Callable[[int, str], None],
        mark: Callable[[str], None],
        policy: RestartPolicy | None = None,
        clock: Callable[[], float] = time.monotonic,
        pause: Callable[[float], None] = time.sleep,
    ) -> None:
        self._spawn, self._tell, self._mark = spawn, tell, mark
        self._policy = policy or RestartPolicy()
        self._clock, self._pause = clock, pause
        self._flying: Process | None = None
        self._standby: Process | None = None
        self._deaths: deque[float] = deque(maxlen=self._policy.deaths)
        self._since_s = self._no_standby_until_s = 0.0
        self._stopping = False

    def run(self) -> int:
        """The exit code of the flight process that ended in order, or of the last one."""
        self._fly(self._spawn(False))
        try:
            while True:
                code = self._watch()
                if code is None:
                    continue
                if self._stopping or code == 0 or self._is_hopeless(code):
                    return code
                if not self._recover(code):
                    return code if code > 0 else 128 - code
        finally:
            if self._standby is not None:
                self._standby.dismiss()

    def stop(self, number: int) -> None:
        """Pass a signal on and end with what flies; for a signal handler."""
        self._stopping = True
        if self._flying is not None:
            self._flying.interrupt(number)

    def _fly(self, process: Process) -> None:
        self._flying, self._since_s = process, self._clock()
        if self._stopping:
            process.interrupt(signal.SIGINT)

    def _watch(self) -> int | None:
        assert self._flying is not None
        code = self._flying.wait(_WATCH_S)
        flown_s = self._clock() - self._since_s
        wanted = code is None and self._standby is None and not self._stopping
        if wanted and flown_s >= self._policy.standby_after_s:
            self._prepare_standby()
        return code

    def _prepare_standby(self) -> None:
        """Without one a restart takes longer, and nothing else: the flight goes on."""
        if self._clock() < self._no_standby_until_s:
            return
        try:
            self._standby = self._spawn(True)
        except OSError as error:
            self._no_standby_until_s = self._clock() + self._policy.standby_after_s
            _log.warning("no standby can be started: %s", error)

    def _is_hopeless(self, code: int) -> bool:
        """A wrong configuration is as wrong the next time; it was told where it was found."""
        return code == _USAGE and not self._deaths and self._standby is None

    def _recover(self, code: int) -> bool:
        """Tell, mark, and fly again; False where that has become pointless."""
        now_s = self._clock()
        recent = [at for at in self._deaths if now_s - at < self._policy.window_s]
        self._deaths.append(now_s)
        why = described(code)
        again = len(recent) + 1 < self._policy.deaths
        what = "restarting" if again else "not restarted"
        _log.error("the flight process died (%s), %s", why, what)
        self._guarded(lambda: self._mark(f"companion died ({why}), {what}"))
        self._guarded(lambda: self._tell(2, f"PiLoT: companion died ({why}), {what}"))
        if not again:
            return False
        process, self._standby = self._standby, None
        if process is None:
            return self._begin_anew(code)
        process.release()
        self._fly(process)
        return True

    def _begin_anew(self, code: int) -> bool:
        """A cold start, a few times where the computer has no process to give; False: none had."""
        for _ in range(self._policy.deaths):
            try:
                self._fly(self._spawn(False))
                return True
            except OSError as error:
                _log.error("no flight process can be started: %s", error)
                self._pause(_AGAIN_S)
        text = f"companion died ({described(code)}), not restarted"
        self._guarded(lambda: self._mark(text))
        self._guarded(lambda: self._tell(2, f"PiLoT: {text}"))
        return False

    @staticmethod
    def _guarded(do: Callable[[], None]) -> None:
        """What cannot be told must not keep the aircraft waiting."""
        try:
            do()
        except Exception:
            _log.exception("the death could not be told")


def described(code: int) -> str:
    """An exit code in a word or two."""
    if code >= 0:
        return f"exit {code}"
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"


def mark_dead(folder: Path, text: str, latest: str = "latest") -> None:
    """Let the newest record's ``health.json`` say so; a record that is not there says nothing."""
    path = folder.parent / latest / "health.json"
    if not path.parent.is_dir():
        path = folder / "health.json"
    if not path.parent.is_dir():
        return
    temporary = path.with_suffix(".dead")
    try:
        report = dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        report = {}
    report.update(level="failed", text=text, time_ns=time.monotonic_ns())
    temporary.write_text(json.dumps(report, indent=1), encoding="utf-8")
    temporary.replace(path)
