"""MAVProxy itself on the autopilot's other port: which of our messages it receives and shows.

MAVPROXY names its program, `mavproxy.py` of an environment of its own; without it this is skipped.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge import Bridge, BridgeConfig, TargetReport
from mavlink_bridge.alerts.catalogue import alert, text
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.link.link import sleep_until
from sitl.geodesy import Location
from sitl.vehicles.launch import GIMBAL, ArduPilotSitl, EmbeddedSitl, vision_only_parameters

PROGRAM = shutil.which(os.environ.get("MAVPROXY", "mavproxy.py"))
HOME = Location(47.397742, 8.545594, 488.0)
ALERT = alert(AlertId.HEIGHT_MISMATCH, metres=9.0)
TEXT = text(ALERT)
pytestmark = pytest.mark.skipif(PROGRAM is None, reason="no mavproxy.py (MAVPROXY)")


@pytest.fixture(params=[EmbeddedSitl, pytest.param(ArduPilotSitl, marks=pytest.mark.sitl)])
def vehicle(request: pytest.FixtureRequest) -> Iterator[Any]:
    with request.param(HOME, parameters=GIMBAL | vision_only_parameters()) as process:
        yield process


class Console:
    """MAVProxy with what it printed; `ask` types a command."""

    def __init__(self, folder: Path, endpoint: str) -> None:
        assert PROGRAM is not None
        self._process = subprocess.Popen(
            [PROGRAM, f"--master={endpoint}", "--logfile=flight.tlog", "--force-connected"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            text=True, cwd=folder, env={**os.environ, "HOME": str(folder)}, start_new_session=True,
        )  # fmt: skip
        self.lines: list[str] = []
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        self.lines.extend(self._process.stdout)

    def ask(self, command: str) -> None:
        self._process.stdin.write(command + "\n")
        self._process.stdin.flush()

    def shows(self, part: str) -> bool:
        return any(part in line for line in self.lines)

    def close(self) -> None:
        os.killpg(self._process.pid, signal.SIGKILL)  # it has children of its own
        self._process.wait(20)


def test_mavproxy_receives_figures_targets_and_texts(vehicle: Any, tmp_path: Path) -> None:
    config = BridgeConfig(connection=vehicle.companion_endpoint, named_values=True)
    with Bridge(config, 47.3) as bridge:
        assert sleep_until(lambda: bridge.state().connected, 30.0)
        console = Console(tmp_path, vehicle.spare_endpoint)
        try:
            _converse(bridge, console)
        finally:
            console.close()


def _masks(console: Console) -> list[tuple[int, int]]:
    """Enabled and healthy sensors of SYS_STATUS, as it printed them."""
    pattern = re.compile(r"sensors_enabled : (\d+).*sensors_health : (\d+)")
    found = (pattern.search(line) for line in list(console.lines))
    return [(int(m[1]), int(m[2])) for m in found if m]


def _converse(bridge: Bridge, console: Console) -> None:
    assert sleep_until(lambda: console.shows("online system 1"), 60.0), console.lines
    wanted = ("name : VPS_SIGNAL, value : 2.0", "CAMERA_TRACKING_GEO_STATUS", TEXT)

    def told() -> bool:
        bridge.send_named_values({"VPS_SIGNAL": 2.0})
        bridge.report_alert(ALERT)
        bridge.report(TargetReport(time.monotonic_ns(), 47.398, 8.546, 535.3, h_accuracy_m=2.0))
        console.ask("status NAMED_VALUE_FLOAT*")
        console.ask("status CAMERA_TRACKING_GEO*")
        console.ask("status STATUSTEXT*")
        console.ask("status SYS_STATUS*")
        return all(console.shows(part) for part in wanted) and bool(_masks(console))

    assert sleep_until(told, 60.0, step_s=0.5), console.lines
    assert console.shows("lat : 473980000, lon : 85460000, alt : 488.0, h_acc : 2.0")
    # The autopilot's vision bit is in the numbers only: nothing was injected, so not healthy.
    enabled, health = _masks(console)[-1]
    vision = mavlink.MAV_SYS_STATUS_SENSOR_VISION_POSITION
    assert (enabled & vision, health & vision) == (vision, 0)
    # It keeps the texts of other components, and prints none: `bridge.texts_as_autopilot`.
    assert not any(TEXT in line for line in console.lines if "STATUSTEXT" not in line)
