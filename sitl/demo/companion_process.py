"""The companion of a demo flight: its deployment file, and `companion run` as a process."""

from __future__ import annotations

import importlib.util
import math
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import yaml

from sitl.demo.assets import FlightAssets
from sitl.demo.scenario import Scenario
from sitl.vehicles.process import VehicleProcess

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


def wait_for_console(port: int, companion: subprocess.Popen[bytes]) -> bool:
    """Wait up to 30 s until the console at `port` accepts connections. Returns False after that
    time, or if the companion has ended.
    """
    end_s = time.monotonic() + _CONSOLE_START_S
    while time.monotonic() < end_s and companion.poll() is None:
        try:
            socket.create_connection(("127.0.0.1", port), 1.0).close()
        except OSError:
            time.sleep(0.2)
        else:
            return True
    return False


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


@contextmanager
def running_companion(
    config: Path, folder: Path, *options: str, program: Sequence[str] = THIS_PROGRAM
) -> Iterator[subprocess.Popen[bytes]]:
    """Context manager: ``companion run`` as a process; at the end SIGINT, after 20 s SIGKILL.
    `folder` exists and receives its log.

    program: the command line before ``run``; options: after the configuration.
    """
    environment = os.environ | {"PYTHONUNBUFFERED": "1", "COLUMNS": "160"}
    with (folder / "companion.log").open("wb") as log:
        process = subprocess.Popen(
            [*program, "run", str(config.resolve()), *options],
            stdout=log, stderr=subprocess.STDOUT, env=environment,
            cwd=Path(__file__).resolve().parents[2],
        )  # fmt: skip
        try:
            yield process
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
            try:
                process.wait(_COMPANION_STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
