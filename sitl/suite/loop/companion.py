"""Controls the companion of a flight: start, kill, restart, health."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import time
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

from mavlink_bridge.alerts.ids import AlertId
from sitl.demo.companion_process import running_companion
from sitl.demo.script import FlightError

_START_S = 300.0  # of the companion: its first start on a machine compiles
_FRESH_S = 2.0  # a health report that is written every second


@dataclass(frozen=True)
class Health:
    """Contents of the newest ``health.json``.

    age_s: since it was written; infinite without a file. findings: names of the monitor's active
    findings. rate_hz: localized frames per second. shadow, ready: text and result of the shadow
    check. alerts: ids of active alerts.
    """

    level: str = "starting"
    text: str = ""
    age_s: float = math.inf
    findings: tuple[str, ...] = ()
    rate_hz: float = 0.0
    pid: int = 0
    shadow: str = ""
    ready: bool = False
    alerts: tuple[str, ...] = ()

    @property
    def is_tracking(self) -> bool:
        """Whether the health is ok and the alert TRACKING is active."""
        return self.level == "ok" and AlertId.TRACKING.value in self.alerts


class LoopCompanion:
    """`companion run` with one deployment file; each start logs to its own folder.

    supervised: the supervisor is started, which restarts a killed companion.
    """

    def __init__(
        self, config: Path, out: Path, stack: ExitStack, *, supervised: bool = False
    ) -> None:
        self._supervised = supervised
        self._config, self._out, self._stack = config, out, stack
        self._process: subprocess.Popen[bytes] | None = None
        self._starts = 0

    def start(self) -> None:
        """Start it, and return at once."""
        folder = self._out / f"log-{self._starts}"
        folder.mkdir()
        self._starts += 1
        options = ("--supervised",) if self._supervised else ()
        companion = running_companion(self._config, folder, *options)
        self._process = self._stack.enter_context(companion)

    def wait_up(self) -> None:
        """Wait for a fresh health report; `FlightError` on timeout or if the process ends."""
        started = time.monotonic()
        while self.health().age_s > _FRESH_S:
            self.require()
            if time.monotonic() - started > _START_S:
                raise FlightError(
                    f"the companion is not up after {_START_S:.0f} s: see {self._out}"
                )
            time.sleep(0.2)

    def kill(self) -> None:
        """SIGKILL to the flight process. With a supervisor, which starts a new one, the call does
        not wait; without, it waits until the process has ended. `FlightError` if a supervised
        process has not reported its pid yet.
        """
        if self._supervised:
            os.kill(self._flight_pid(), signal.SIGKILL)
        elif self._process is not None:
            self._process.send_signal(signal.SIGKILL)
            self._process.wait()

    def hang(self) -> None:
        """SIGSTOP to the flight process, so that it hangs. `FlightError` as for `kill`."""
        os.kill(self._flight_pid(), signal.SIGSTOP)

    def _flight_pid(self) -> int:
        pid = self.health().pid
        if pid <= 0:  # signals to 0 reach the caller's own process group
            raise FlightError(f"no health report states the flight process: see {self._out}")
        return pid

    def require(self) -> None:
        """Raise `FlightError` if the started process has ended; nothing before `start`."""
        code = None if self._process is None else self._process.poll()
        if code is not None:
            raise FlightError(f"the companion ended with code {code}: see {self._out}")

    def confine(self, processors: set[int]) -> None:
        """Restrict all its present threads, and their children, to these processors."""
        if self._process is None:
            return
        for thread in Path(f"/proc/{self._process.pid}/task").glob("*"):
            with suppress(ProcessLookupError):  # it may end meanwhile
                os.sched_setaffinity(int(thread.name), processors)

    def health(self) -> Health:
        """The newest health.json of the companion's records, with its age in seconds; the defaults
        of `Health` if there is none yet or it cannot be read.
        """
        try:
            reports = self._out.glob("companion*/health.json")
            newest = max(reports, key=lambda path: path.stat().st_mtime)
            report = json.loads(newest.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return Health()
        age_s = (time.monotonic_ns() - int(report["time_ns"])) * 1e-9
        integrity_monitor = report.get("guardian") or {}
        findings = tuple(integrity_monitor.get("findings", {}))
        return Health(
            str(report["level"]), str(report["text"]), age_s, findings, float(report["rate_hz"]),
            int(report["pid"]), str(report["shadow"]["text"]), bool(report["shadow"]["ready"]),
            tuple(report["alerts"]),
        )  # fmt: skip
