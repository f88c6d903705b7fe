"""Starts either simulated vehicle, with parameter sets for flights and tests."""

from __future__ import annotations

import os
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from sitl.geodesy import Location
from sitl.vehicles.process import (
    BASE_PORT,
    PARAMETERS,
    PORTS_PER_INSTANCE,
    VehicleProcess,
    VehicleProcessError,
)

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


VISION_SOURCE = 2  # MAV_CMD_SET_EKF_SOURCE_SET

# A self-stabilising gimbal (MNT1_TYPE 7). Type 1 looks the same but reports servo angles, from
# which the vehicle's lean is subtracted, under flags that claim the earth frame: its reports are
# off by the lean. Servo functions: 7 pitch, 6 yaw, 8 roll.
GIMBAL: dict[str, float] = {
    "MNT1_TYPE": 7,
    "MNT1_DEFLT_MODE": 2,
    "MNT1_PITCH_MIN": -90,
    "MNT1_PITCH_MAX": 20,
    "MNT1_YAW_MIN": -180,
    "MNT1_YAW_MAX": 180,
    "SERVO9_FUNCTION": 7,
    "SERVO10_FUNCTION": 6,
    "SERVO11_FUNCTION": 8,
}

SPEEDS: dict[str, float] = {
    "WPNAV_SPEED": 1000,
    "WPNAV_SPEED_UP": 500,
    "WPNAV_SPEED_DN": 300,
    "WPNAV_ACCEL": 250,
    "LAND_SPEED_HIGH": 300,
}

GPS_OFF: dict[str, float] = {"SIM_GPS1_ENABLE": 0}

# Bits 1 to 19 but for 18, "visual odometry": on the ground the camera sees no map yet, so vision
# cannot be healthy before take-off.
_CHECK_ALL_BUT_VISION = ((1 << 20) - 2) & ~(1 << 18)


def vision_parameters(*, delay_ms: float = 100.0) -> dict[str, float]:
    """Parameters: start on GNSS (source set 1); source set 2 uses vision messages."""
    return {
        "VISO_TYPE": 1,
        "VISO_POS_M_NSE": 0.5,
        "VISO_DELAY_MS": delay_ms,
        **_sources(1, position=3, velocity=3, climb=3),
        **_sources(2, position=6, velocity=6, climb=0),
        "EK3_VIS_VERR_MAX": 2.0,
        "ARMING_CHECK": _CHECK_ALL_BUT_VISION,
    }


def vision_only_parameters() -> dict[str, float]:
    """ArduPilot parameters of a vehicle without a GNSS receiver that navigates on vision. The EKF
    has no position until an origin is sent.
    """
    return {
        "GPS1_TYPE": 0,
        "VISO_TYPE": 1,
        "VISO_POS_M_NSE": 0.5,
        "VISO_DELAY_MS": 100.0,
        **_sources(1, position=6, velocity=0, climb=0),
    }


def gps_input_parameters(*, delay_ms: float = 100.0) -> dict[str, float]:
    """Parameters: a simulated receiver, which GPS_INPUT (gps_id 1) replaces if it fails."""
    return {
        "GPS2_TYPE": 14,
        "GPS2_DELAY_MS": delay_ms,
        # The EKF's buffer, which the delay of the first receiver or of vision sizes, must reach
        # back to what the second receiver says.
        "VISO_TYPE": 1,
        "VISO_DELAY_MS": delay_ms,
        "GPS_AUTO_SWITCH": 1,
        **_sources(1, position=3, velocity=0, climb=0),
        "ARMING_CHECK": _CHECK_ALL_BUT_VISION & ~(1 << 3),  # nor does the second receiver arm
    }


def gps_input_only_parameters() -> dict[str, float]:
    """Parameters of a vehicle whose only receiver is GPS_INPUT (gps_id 0), without velocity."""
    return {
        "GPS1_TYPE": 14,
        "GPS1_DELAY_MS": 100.0,
        **_sources(1, position=3, velocity=0, climb=0),
    }


def _sources(number: int, *, position: int, velocity: int, climb: int) -> dict[str, float]:
    """EK3_SRCn_*: heights from the barometer, heading from the compass."""
    prefix = f"EK3_SRC{number}_"
    return {
        prefix + "POSXY": position,
        prefix + "VELXY": velocity,
        prefix + "POSZ": 1,
        prefix + "VELZ": climb,
        prefix + "YAW": 1,
    }


class EmbeddedSitl(VehicleProcess):
    """The embedded vehicle as a process of its own."""

    kind = "embedded"
    start_timeout_s = 300.0  # the first start compiles the kernels

    def command(self, instance: int) -> list[str]:
        """See `VehicleProcess.command`."""
        return [
            sys.executable,
            "-m",
            "sitl.embedded",
            f"--home={self.home}",
            f"--port={BASE_PORT + PORTS_PER_INSTANCE * instance}",
            f"--params={PARAMETERS}",
            f"--speedup={self.speedup:g}",
            f"--seed={self.seed}",
            *(["--px4"] if self.px4 else []),
        ]


@dataclass(frozen=True)
class VehicleSetup:
    """Start conditions of a vehicle, see `VehicleProcess`."""

    heading_deg: float = 0.0
    parameters: dict[str, float] | None = None
    speedup: float = 1.0
    seed: int = 0
    log: Path | None = None
    px4: bool = False


def open_vehicle(
    kind: Literal["auto", "ardupilot", "embedded"],
    home: Location,
    setup: VehicleSetup | None = None,
) -> VehicleProcess:
    """Create a vehicle that is not started yet; "auto" is ArduPilot if its binary is found, except
    for PX4. `VehicleProcessError` for PX4 on ArduPilot, or without its binary.

    home: altitude AMSL. setup: None: the defaults.
    """
    s = setup or VehicleSetup()
    if s.px4 and kind == "ardupilot":
        raise VehicleProcessError("a scenario of PX4 flies on the embedded vehicle: --fc embedded")
    found = kind == "auto" and not s.px4 and find_arducopter() is not None
    return (ArduPilotSitl if kind == "ardupilot" or found else EmbeddedSitl)(home, **vars(s))
