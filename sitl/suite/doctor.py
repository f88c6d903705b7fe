"""Runs `companion doctor --fix` on a simulated vehicle with wrong parameters."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import yaml

from mavlink_bridge import BridgeConfig
from mavlink_bridge.preflight.doctor import Diagnosis, examine
from sitl.errors import SimulationError
from sitl.suite.record import Doctor

_TIMEOUT_S = 180.0


class DoctorError(SimulationError):
    """`companion doctor` failed."""


def run_doctor(config: BridgeConfig) -> Doctor:
    """Run the doctor, then `companion doctor --fix --yes`, which writes the vehicle's parameters,
    then the doctor again; returns what both runs found. `DoctorError` if nothing was written.

    The exit codes are those of the flight controller's checks only, because a suite has neither map
    nor camera, which `companion doctor` would report as missing.
    """
    before = examine(config)
    found = tuple(f.name for f in before.findings if not f.ok and f.fix is not None)
    _fix(config)
    after = examine(config)
    # A failsafe is the pilot's decision: told, and never written.
    mended = Diagnosis(tuple(f for f in after.findings if f.required or f.fix is not None))
    left = tuple(f"{f.name} {f.found}" for f in mended.findings if not f.ok)
    return Doctor(found, left, before.exit_code, mended.exit_code)


def _fix(config: BridgeConfig) -> None:
    camera = {"width": 640, "height": 480, "fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0}
    with tempfile.TemporaryDirectory(prefix="doctor-") as folder:
        deployment = {
            "map": "no-map",
            "camera": {"source": "no-video", "model": camera},
            "bridge": config.model_dump(mode="json", exclude_none=True),
        }
        path = Path(folder) / "deployment.yaml"
        path.write_text(yaml.safe_dump(deployment), encoding="utf-8")
        command = [sys.executable, "-m", "companion", "doctor", str(path), "--fix", "--yes"]
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False
            )
        except subprocess.TimeoutExpired as error:
            raise DoctorError(f"companion doctor took more than {_TIMEOUT_S:g} s") from error
    if "written" not in done.stdout:
        raise DoctorError(
            f"companion doctor wrote nothing (status {done.returncode}):\n"
            f"{done.stdout[-1500:]}{done.stderr[-500:]}"
        )
