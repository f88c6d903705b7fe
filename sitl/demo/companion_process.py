"""The companion of a demo flight: its deployment file, and `companion run` as a process."""

from __future__ import annotations

import importlib.util
import json
import math
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import yaml

from mavlink_bridge.alerts.ids import AlertId
from sitl.demo.assets import FlightAssets
from sitl.demo.scenario import Scenario
from sitl.errors import FlightError
from sitl.vehicles.process import VehicleProcess

_START_S = 300.0  # of the companion: its first start on a machine compiles
_FRESH_S = 2.0  # a health report that is written every second
_COMPANION_STOP_S = 20.0
_CONSOLE_START_S = 30.0
_GNSS_AT_FIRST_S = 2.0

THIS_PROGRAM = (sys.executable, "-m", "companion")
"""The companion of this checkout."""


@dataclass(frozen=True)
class Ports:
    """Local UDP ports of one flight, and the console's TCP port (None: no console)."""

    video: int
    detections: int
    console: int | None = None
    """TCP port of the operator's page; None: no page."""


def free_udp_port() -> int:
    """A free local UDP port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def free_console_port() -> int | None:
    """A free TCP port (8080 if possible); None if the extra `console` is not installed."""
    if any(importlib.util.find_spec(name) is None for name in ("starlette", "uvicorn")):
        return None
    for port in (8080, 0):
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return int(probe.getsockname()[1])
    return None


def write_deployment(
    folder: Path,
    assets: FlightAssets,
    scenario: Scenario,
    vehicle: VehicleProcess,
    ports: Ports,
) -> Path:
    """Write ``companion.yaml`` for `companion run` into the existing folder; returns its path."""
    camera = scenario.camera.camera()
    config: dict[str, Any] = {
        "map": str(assets.map_cache.resolve()),
        "camera": {
            "source": f"udp://127.0.0.1:{ports.video}",
            "model": camera.to_dict(),
            # Drawn from what a calibration leaves, and stated so (`_known_to`).
            "calibrated": datetime.now(timezone.utc).date().isoformat(),
        },
        "localizer": {"width": scenario.localizer_width, "calibration": _known_to(scenario)},
        "bridge": {
            "connection": vehicle.companion_endpoint,
            "tlog": str((folder / "flight.tlog").resolve()),
            "mode": "inject",
            "injection": {
                "message": scenario.injection,
                "delay_ms": scenario.injection_delay_ms,
                "gps_id": 1,
                # Earned by the shadow score while there is GNSS; where there is none at first,
                # nothing could be compared.
                "force": scenario.deny_after_s < _GNSS_AT_FIRST_S,
            },
        },
        "targets": {"detections": f"127.0.0.1:{ports.detections}"},
        "record": {"folder": str((folder / "companion").resolve())},
    }
    if ports.console is not None:
        config["console"] = {"listen": f"127.0.0.1:{ports.console}", "control": True}
    path = folder / "companion.yaml"
    path.write_text(yaml.safe_dump(config, sort_keys=False))
    return path


def _known_to(scenario: Scenario) -> dict[str, float]:
    """The deployment's calibration uncertainty: the standard deviations from which the flight's
    errors are drawn.
    """
    drawn = scenario.errors
    return {
        "focal_percent": drawn.focal_percent,
        "principal_percent": 100.0 * drawn.principal_px / scenario.camera.width,
        "distortion": drawn.distortion,
        "readout_ms": drawn.readout_ms,
        "stamp_ms": math.hypot(drawn.stamp_offset_ms, drawn.stamp_jitter_ms),
    }


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


class FlightCompanion:
    """`companion run` with one deployment file, and its health. Its output is appended to
    ``companion.log`` in `out`; `stack` ends it with SIGINT, after 20 s with SIGKILL.

    supervised: the supervisor is started, which restarts a killed companion. program: the command
    line before ``run``.
    """

    def __init__(
        self, config: Path, out: Path, stack: ExitStack, *, supervised: bool = False,
        program: Sequence[str] = THIS_PROGRAM,
    ) -> None:  # fmt: skip
        self._supervised = supervised
        options = ("--supervised",) if supervised else ()
        self._command = [*program, "run", str(config.resolve()), *options]
        self._out, self._stack = out, stack
        self._log = out / "companion.log"
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it, and return at once."""
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                self._command, stdout=log, stderr=subprocess.STDOUT,
                env=os.environ | {"PYTHONUNBUFFERED": "1", "COLUMNS": "160"},
                cwd=Path(__file__).resolve().parents[2],
            )  # fmt: skip
        self._stack.callback(_end, self._process)

    def wait_up(self, waiting: Callable[[], None] = lambda: None) -> None:
        """Wait for a fresh health report, calling `waiting` meanwhile; the first start on a machine
        compiles for a minute or more. `FlightError` after 300 s, or if the process ends.
        """
        started = time.monotonic()
        while self.health().age_s > _FRESH_S:
            self.require()
            if time.monotonic() - started > _START_S:
                raise FlightError(f"the companion is not up after {_START_S:.0f} s: {self._log}")
            waiting()
            time.sleep(0.2)

    def serves(self, port: int) -> bool:
        """Wait up to 30 s until the console at `port` accepts connections. Returns False after that
        time, or if the companion has ended.
        """
        end_s = time.monotonic() + _CONSOLE_START_S
        while time.monotonic() < end_s and self._code is None:
            try:
                socket.create_connection(("127.0.0.1", port), 1.0).close()
            except OSError:
                time.sleep(0.2)
            else:
                return True
        return False

    @property
    def _code(self) -> int | None:
        """Exit code of the started process; None while it runs, and before `start`."""
        return None if self._process is None else self._process.poll()

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
            raise FlightError(f"no health report states the flight process: {self._log}")
        return pid

    def require(self) -> None:
        """Raise `FlightError` if the started process has ended; nothing before `start`."""
        if self._code is not None:
            tail = self._log.read_text(errors="replace")[-1500:]
            raise FlightError(f"the companion ended with code {self._code}; {self._log}:\n{tail}")

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


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    try:
        process.wait(_COMPANION_STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
