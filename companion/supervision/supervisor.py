"""Keeps the flight process alive; a separate process that does nothing else.

It waits for the flight process to end, and kills one that hangs. A death is reported to the
operator and written to ``health.json`` within a second, and a standby process, with map and network
in memory, takes over. It never gives up, because the aircraft may fly without GNSS: repeated cold
starts wait longer, and each is reported.
"""

from __future__ import annotations

import glob
import json
import logging
import math
import signal
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.supervision.processes import ENDING, Beat, FlightProcess, ServiceManager
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert, body
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import Name, ProcessFault
from mavlink_bridge.atomic_file import replace_file

_log = logging.getLogger(__name__)
_WATCH_S = 0.25  # between looks at what else is due; a death wakes at once
_LOOKED_AWAY_S = 1.5  # after which it was the supervisor that stood still, or the computer
_PAUSE_S = 0.25  # between looks whether to go on waiting
_MOST_DEATHS = 64  # that are remembered: more within the window wait no longer
_WORDS_S = 3.0  # for a death to be reported, or marked
_PART = 10  # characters of a part's name, so that the line is one STATUSTEXT
_USAGE = 2  # exit code of a named error


@dataclass(frozen=True)
class RestartPolicy:
    """Waits and time limits of the supervisor.

    If `deaths` occur within `window_s`, a cold start waits for 2 s, then twice as long each time,
    at most `wait_s`, because it takes all cores for seconds. A standby takes over at once, however
    often. A new standby is made after a process has flown for `standby_after_s`, because its
    imports take a core for seconds.

    A component without a cycle for `part_s` hangs, and so does a process without a sign of life for
    `silent_s`. These limits are above the delays of an overloaded computer and below the
    autopilot's timeouts. Before its first sign of life a released standby has `released_s` and
    another process `cold_s`, because it may compile. A process that ends by itself has `ending_s`
    to close its record.
    """

    deaths: int = 5
    window_s: float = 300.0
    wait_s: float = 30.0
    standby_after_s: float = 20.0
    part_s: float = 4.0
    silent_s: float = 3.0
    released_s: float = 30.0
    cold_s: float = 300.0
    ending_s: float = 60.0


class Supervisor:
    """Starts, watches and restarts flight processes; `run` until the flight is over.

    spawn: starts a process, flying (False) or as a standby (True). tell: sends an alert to the
    operator; mark: writes a text to the ``health.json`` of a process id. manager: the service
    manager. clock: monotonic seconds; pause: sleeps.
    """

    def __init__(
        self,
        spawn: Callable[[bool], FlightProcess],
        tell: Callable[[Alert], None],
        mark: Callable[[int, str], None],
        policy: RestartPolicy | None = None,
        manager: ServiceManager | None = None,
        clock: Callable[[], float] = time.monotonic,
        pause: Callable[[float], None] = time.sleep,
    ) -> None:
        self._spawn, self._tell, self._mark = spawn, tell, mark
        self._policy = policy or RestartPolicy()
        self._manager = manager or ServiceManager("")
        self._clock, self._pause = clock, pause
        self._flying: FlightProcess | None = None
        self._standby: FlightProcess | None = None
        self._deaths: deque[float] = deque(maxlen=_MOST_DEATHS)
        self._since_s = self._no_standby_until_s = 0.0
        self._heard_s = self._looked_s = self._patience_s = 0.0
        self._awake_s = -math.inf  # since when, after both or the computer stood still
        self._shown_s: float | None = None
        self._is_new = True
        self._stopping = False

    def run(self) -> int:
        """Start the first process and supervise until one ends with exit code 0, or after `stop`,
        or the first with a named error (2); returns that code. Other ends are followed by a
        restart. OSError if the first process cannot be started.
        """
        self._fly(self._spawn(False), self._policy.cold_s)
        try:
            while True:
                code = self._watch()
                if code is None:
                    hangs = "" if self._stopping else self._hanging()
                    if not hangs:
                        continue
                    code = self._kill()
                    self._recover(ProcessFault.HANGS, Name(hangs))
                elif self._stopping or code == 0 or self._is_hopeless(code):
                    return code
                else:
                    self._recover(ProcessFault.DIED, Name(exit_code_text(code)))
                if self._flying is None:  # an order to end came while it waited
                    return code if code > 0 else 128 - code
        finally:
            if self._flying is not None:
                self._flying.close()
            if self._standby is not None:
                self._standby.dismiss()

    def stop(self, number: int) -> None:
        """Pass the signal `number` on; `run` ends with the flight process. For a signal handler."""
        self._stopping = True
        if self._flying is not None:
            self._flying.send_signal(number)

    def _fly(self, process: FlightProcess, patience_s: float) -> None:
        if self._flying is not None:
            self._flying.close()
        self._flying, self._since_s = process, self._clock()
        self._heard_s = self._looked_s = self._since_s
        self._shown_s, self._is_new = None, True
        self._patience_s = patience_s
        if self._stopping:
            process.send_signal(signal.SIGINT)

    def _watch(self) -> int | None:
        assert self._flying is not None
        code = self._flying.wait(_WATCH_S)
        flown_s = self._clock() - self._since_s
        wanted = code is None and self._standby is None and not self._stopping
        if wanted and flown_s >= self._policy.standby_after_s:
            self._prepare_standby()
        return code

    def _hanging(self) -> str:
        """Name of the component that hangs; "" if none does."""
        assert self._flying is not None
        now_s, beats = self._clock(), self._flying.beats()
        looked_away = now_s - self._looked_s > _LOOKED_AWAY_S
        self._looked_s = now_s
        if looked_away:
            self._awake_s = now_s
        hangs = ""
        if beats:
            last = beats[-1]
            is_ending = last.part == ENDING
            self._heard_s = now_s
            self._patience_s = self._policy.ending_s if is_ending else self._policy.silent_s
            without_turn_s = min(last.age_s, now_s - self._awake_s)
            hangs = last.part[:_PART] if without_turn_s > self._policy.part_s else ""
            self._report_ready(now_s, last)
        elif looked_away:
            self._heard_s = now_s
        elif now_s - self._heard_s > self._patience_s:
            hangs = "process"
        if not hangs:
            self._manager.alive()  # a start, too, which may compile: it has its patience here
        return hangs

    def _report_ready(self, now_s: float, last: Beat) -> None:
        """Report once all components had a cycle since the first sign of life."""
        if self._shown_s is None:
            self._shown_s = now_s
        if self._is_new and last.age_s < now_s - self._shown_s:
            self._is_new = False
            self._manager.ready()
            self._manager.status("flying")

    def _kill(self) -> int:
        assert self._flying is not None
        self._flying.kill()
        return -signal.SIGKILL

    def _prepare_standby(self) -> None:
        """Start a standby. If that fails, only a restart takes longer; the flight continues."""
        if self._clock() < self._no_standby_until_s:
            return
        try:
            self._standby = self._spawn(True)
        except OSError as error:
            self._no_standby_until_s = self._clock() + self._policy.standby_after_s
            _log.warning("no standby can be started: %s", error)

    def _is_hopeless(self, code: int) -> bool:
        """Whether a restart is useless: the configuration is wrong, as reported."""
        return code == _USAGE and not self._deaths and self._standby is None

    def _recover(self, how: ProcessFault, what: Name) -> None:
        """Start the next process, report the death and mark it; starts nothing after `stop`."""
        assert self._flying is not None
        dead, wait_s = self._flying.pid, self._wait_s()
        process, self._standby = self._standby, None
        news = alert(AlertId.COMPANION_RESTARTS, how=how, what=what)
        if process is None and wait_s:
            news = alert(AlertId.COMPANION_WAITS, how=how, what=what, seconds=wait_s)
        _log.error("the flight process: %s", body(news))
        if process is not None:
            # First of all. It opens the links later than this process, which then tells at once.
            process.release()
            self._fly(process, self._policy.released_s)
        _do_in_time("tell", lambda: self._tell(news))
        _do_in_time("mark", lambda: self._mark(dead, body(news)))
        self._manager.status(body(news))
        if process is None:
            self._cold_start(wait_s)

    def _wait_s(self) -> float:
        """Seconds to wait before a cold start; longer after more deaths lately."""
        now_s, policy = self._clock(), self._policy
        self._deaths.append(now_s)
        recent = sum(now_s - at < policy.window_s for at in self._deaths)
        beyond = recent - policy.deaths
        return 0.0 if beyond < 0 else min(2.0 ** min(1 + beyond, 16), policy.wait_s)

    def _cold_start(self, wait_s: float) -> None:
        """Start a process after wait_s, and try again as long as the computer cannot start one."""
        if self._flying is not None:
            self._flying.close()
            self._flying = None
        self._wait(wait_s)
        again_s = 1.0
        while not self._stopping:
            try:
                self._fly(self._spawn(False), self._policy.cold_s)
                return
            except OSError as error:
                _log.error("no flight process can be started: %s", error)
                self._wait(again_s)
                again_s = min(2.0 * again_s, self._policy.wait_s)

    def _wait(self, seconds: float) -> None:
        """Wait, but end at `stop`."""
        slices = math.ceil(seconds / _PAUSE_S)
        for _ in range(slices):
            if self._stopping:
                return
            self._pause(_PAUSE_S)
            self._manager.alive()


def _do_in_time(name: str, do: Callable[[], None]) -> None:
    """Run `do` with a time limit: a report that fails must not delay the restart. The flight
    process may have died of the same disk or port that blocks the report.
    """

    def guarded() -> None:
        try:
            do()
        except Exception:
            _log.exception("the death could not be reported")

    thread = threading.Thread(target=guarded, name=name, daemon=True)
    thread.start()
    thread.join(_WORDS_S)
    if thread.is_alive():
        _log.error("the death could not be reported: to %s it takes too long", name)


def exit_code_text(code: int) -> str:
    """An exit code of `subprocess` in words, as "exit 1" or "SIGKILL"."""
    if code >= 0:
        return f"exit {code}"
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"


def mark_dead(folder: Path, pid: int, text: str) -> None:
    """Set the state `failed` with `text` in the health.json of the process `pid`: in `folder`, or
    in a record beside it whose name begins with the folder's. Does nothing if no such file names
    the process; OSError if the disk refuses.
    """
    for path in folder.parent.glob(f"{glob.escape(folder.name)}*/health.json"):
        report = _report(path)
        if report.get("pid") == pid:
            report.update(level="failed", text=text, time_ns=time.monotonic_ns())
            replace_file(path, json.dumps(report, indent=1), path.stat().st_mode & 0o777)


def _report(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError, RecursionError):
        return {}
