"""Starts ArduPilot SITL: finds the arducopter binary and runs it in its own folder."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

from sitl.vehicles.process import PARAMETERS, VehicleProcess, VehicleProcessError

# Where a binary and its default parameters lie below ARDUPILOT_HOME: an install folder, or an
# ArduPilot source tree that was built with `waf copter`.
_BINARIES = ("arducopter", "build/sitl/bin/arducopter")
_DEFAULTS = ("copter.parm", "Tools/autotest/default_params/copter.parm")


class ArduPilotNotFoundError(VehicleProcessError):
    """The arducopter binary or its default parameters were not found."""


def find_arducopter() -> Path | None:
    """Path of the SITL binary, below ARDUPILOT_HOME or on PATH; None if there is none."""
    home = os.environ.get("ARDUPILOT_HOME")
    if home:
        for relative in _BINARIES:
            candidate = Path(home) / relative
            if candidate.is_file() and os.access(candidate, os.X_OK):
                return candidate.resolve()
    found = shutil.which("arducopter")
    return Path(found).resolve() if found else None


def find_defaults(binary: Path) -> Path:
    """ArduPilot's default SITL parameters: beside the binary or below ARDUPILOT_HOME.
    `ArduPilotNotFoundError` if there are none.
    """
    folders = [binary.parent, *binary.parents[1:4]]
    home = os.environ.get("ARDUPILOT_HOME")
    if home:
        folders.insert(0, Path(home))
    for folder in folders:
        for relative in _DEFAULTS:
            if (folder / relative).is_file():
                return folder / relative
    raise ArduPilotNotFoundError(
        f"no copter.parm beside {binary}; copy Tools/autotest/default_params/copter.parm of the "
        "ArduPilot sources there, or set ARDUPILOT_HOME to the folder that holds it"
    )


class ArduPilotSitl(VehicleProcess):
    """ArduCopter SITL. `ArduPilotNotFoundError` without its binary."""

    kind = "ardupilot"
    start_timeout_s = 30.0

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        binary = find_arducopter()
        if binary is None:
            raise ArduPilotNotFoundError(
                "no arducopter binary on PATH or below ARDUPILOT_HOME; build ArduPilot with "
                "`./waf configure --board sitl && ./waf copter`, or fly the embedded vehicle"
            )
        self._binary, self._defaults = binary, find_defaults(binary)

    def command(self, instance: int) -> list[str]:
        """See `VehicleProcess.command`; -w forgets parameters of earlier runs."""
        return [
            str(self._binary),
            "--model=quad",
            f"--speedup={self.speedup:g}",
            f"-I{instance}",
            f"--home={self.home}",
            f"--defaults={self._defaults},{PARAMETERS}",
            "--serial0=tcp:0",
            "-w",
        ]
