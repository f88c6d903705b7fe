"""The parameters that the vehicle knows, with names, types and defaults of ArduPilot and PX4.

With PX4's parameters, whose integers travel as bytes in the float, the vehicle is the same aircraft
with PX4's interface: modes, messages, position aiding.

From PX4's public source and documentation (EKF2's `aux_global_position`, `external_vision` and
`gps_control`, November 2026), written anew. Shared with PX4: HEARTBEAT and mode numbers, parameters
that travel as bytes, TIMESYNC asked for by the autopilot, what ODOMETRY, VISION_POSITION_ESTIMATE
and GLOBAL_POSITION_SENSOR must hold, gates and timeouts of GNSS, external vision and the first
auxiliary position, and Descend when no position is left.

Not PX4's: the inertial filter, the control loops and the mission (those of the ArduPilot model),
EVENT, the other instances of the auxiliary position, heights from anything but the barometer, and a
pilot's sticks: COM_POSCTL_NAVL other than 1 has no effect. Hold takes the part of GUIDED, take-off
included. SIM_* and SIM_STATE are the simulator's. It is no PX4 SITL: a flight on it shows that the
bridge speaks PX4's dialect, not what PX4 does.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

from localizer.plain_files import plain_text
from sitl.errors import ParameterFileError

# MAV_PARAM_TYPE as ArduPilot reports them (values travel as float in every case).
INT8, INT16, INT32, REAL32 = 2, 4, 6, 9

_DEFAULTS: dict[str, tuple[float, int]] = {
    "ARMING_CHECK": (1, INT32),
    "AHRS_EKF_TYPE": (3, INT8),
    "EK3_ENABLE": (1, INT8),
    "EK3_GYRO_P_NSE": (0.015, REAL32),
    "EK3_ACC_P_NSE": (0.35, REAL32),
    "EK3_GBIAS_P_NSE": (0.001, REAL32),
    "EK3_ABIAS_P_NSE": (0.02, REAL32),
    "EK3_POSNE_M_NSE": (0.5, REAL32),
    "EK3_VELNE_M_NSE": (0.3, REAL32),
    "EK3_VELD_M_NSE": (0.5, REAL32),
    "EK3_ALT_M_NSE": (2.0, REAL32),
    "EK3_YAW_M_NSE": (0.5, REAL32),
    "EK3_NOAID_M_NSE": (10.0, REAL32),
    "EK3_POS_I_GATE": (500, INT16),
    "EK3_VEL_I_GATE": (500, INT16),
    "EK3_HGT_I_GATE": (500, INT16),
    "EK3_YAW_I_GATE": (300, INT16),
    "EK3_GLITCH_RAD": (25, INT8),
    "EK3_VIS_VERR_MIN": (0.1, REAL32),
    "EK3_VIS_VERR_MAX": (0.9, REAL32),
    "EK3_SRC1_POSXY": (3, INT8),
    "EK3_SRC1_VELXY": (3, INT8),
    "EK3_SRC1_POSZ": (1, INT8),
    "EK3_SRC1_VELZ": (3, INT8),
    "EK3_SRC1_YAW": (1, INT8),
    "EK3_SRC2_POSXY": (0, INT8),
    "EK3_SRC2_VELXY": (0, INT8),
    "EK3_SRC2_POSZ": (1, INT8),
    "EK3_SRC2_VELZ": (0, INT8),
    "EK3_SRC2_YAW": (0, INT8),
    "EK3_SRC3_POSXY": (0, INT8),
    "EK3_SRC3_VELXY": (0, INT8),
    "EK3_SRC3_POSZ": (1, INT8),
    "EK3_SRC3_VELZ": (0, INT8),
    "EK3_SRC3_YAW": (0, INT8),
    "FS_EKF_ACTION": (1, INT8),
    "FS_EKF_THRESH": (0.8, REAL32),
    "GPS1_TYPE": (1, INT8),
    "GPS1_DELAY_MS": (0, INT16),
    "GPS2_TYPE": (0, INT8),
    "GPS2_DELAY_MS": (0, INT16),
    "GPS_AUTO_SWITCH": (1, INT8),
    "GPS_HDOP_GOOD": (140, INT16),
    "VISO_TYPE": (0, INT8),
    "VISO_DELAY_MS": (10, INT16),
    "VISO_POS_M_NSE": (0.2, REAL32),
    "VISO_VEL_M_NSE": (0.1, REAL32),
    "VISO_YAW_M_NSE": (0.2, REAL32),
    "VISO_QUAL_MIN": (0, INT8),
    "VISO_SCALE": (1.0, REAL32),
    "VISO_POS_X": (0.0, REAL32),
    "VISO_POS_Y": (0.0, REAL32),
    "VISO_POS_Z": (0.0, REAL32),
    "WPNAV_SPEED": (1000, REAL32),
    "WPNAV_SPEED_UP": (250, REAL32),
    "WPNAV_SPEED_DN": (150, REAL32),
    "WPNAV_RADIUS": (200, REAL32),
    "WPNAV_ACCEL": (250, REAL32),
    "WPNAV_ACCEL_Z": (100, REAL32),
    "WP_YAW_BEHAVIOR": (2, INT8),
    "RTL_ALT": (1500, INT32),
    "RTL_SPEED": (0, INT16),
    "RTL_LOIT_TIME": (5000, INT32),
    "LAND_SPEED": (50, INT16),
    "LAND_SPEED_HIGH": (0, INT16),
    "DISARM_DELAY": (10, INT8),
    "MNT1_TYPE": (0, INT8),
    "MNT1_DEFLT_MODE": (3, INT8),
    "MNT1_ROLL_MIN": (-30, INT16),
    "MNT1_ROLL_MAX": (30, INT16),
    "MNT1_PITCH_MIN": (-90, INT16),
    "MNT1_PITCH_MAX": (20, INT16),
    "MNT1_YAW_MIN": (-180, INT16),
    "MNT1_YAW_MAX": (180, INT16),
    "MNT1_NEUTRAL_X": (0, REAL32),
    "MNT1_NEUTRAL_Y": (0, REAL32),
    "MNT1_NEUTRAL_Z": (0, REAL32),
    "SERVO9_FUNCTION": (0, INT16),
    "SERVO10_FUNCTION": (0, INT16),
    "SERVO11_FUNCTION": (0, INT16),
    "SYSID_THISMAV": (1, INT16),
    "SIM_GPS1_ACC": (0.5, REAL32),
    "SIM_GPS1_ENABLE": (1, INT8),
    "SIM_GPS1_GLTCH_X": (0, REAL32),
    "SIM_GPS1_GLTCH_Y": (0, REAL32),
    "SIM_GPS1_JAM": (0, INT8),
    "SIM_GPS1_LAG_MS": (100, INT16),
    "SIM_SPEEDUP": (1, REAL32),
    "SIM_WIND_SPD": (2.0, REAL32),
    "SIM_WIND_DIR": (180, REAL32),
    "SIM_WIND_TURB": (0.4, REAL32),
}


class Parameters:
    """A parameter table: values by name, in a fixed order."""

    is_px4 = False

    def __init__(self, overrides: dict[str, float] | None = None) -> None:
        self._values = {name: value for name, (value, _) in _DEFAULTS.items()}
        for name, value in (overrides or {}).items():
            self.set(name, value)

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __len__(self) -> int:
        return len(self._values)

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def set(self, name: str, value: float) -> bool:
        """Set a parameter, rounded if it is an integer. Returns False, and changes nothing, if the
        vehicle has no parameter of this name.
        """
        if name not in self._values:
            return False
        self._values[name] = value if self.type_of(name) == REAL32 else float(round(value))
        return True

    def type_of(self, name: str) -> int:
        """MAV_PARAM_TYPE of a known parameter."""
        return _DEFAULTS[name][1]

    def encode_value(self, name: str) -> float:
        """Value of a parameter as PARAM_VALUE carries it."""
        return self[name]

    def decode_value(self, _name: str, value: float) -> float:
        """Value of a parameter from a PARAM_SET message's float."""
        return value

    def name_at(self, index: int) -> str | None:
        """Name of the parameter at a list index; None outside the list."""
        names = list(self)
        return names[index] if 0 <= index < len(names) else None

    def index_of(self, name: str) -> int:
        """A parameter's place in the list."""
        return list(self).index(name)


def read_parameter_file(path: Path) -> dict[str, float]:
    """Values of an ArduPilot .parm file: name and value, split by blanks or comma; # comments.
    `ParameterFileError` if the file cannot be read or a line is malformed.
    """
    values: dict[str, float] = {}
    try:
        lines = plain_text(path).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ParameterFileError(f"cannot read the parameter file {path}: {error}") from error
    for number, line in enumerate(lines, start=1):
        words = line.split("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            values[words[0]] = float(words[1])
        except (IndexError, ValueError) as error:
            raise ParameterFileError(
                f"{path}, line {number}: expected 'NAME VALUE', found {line.strip()!r}"
            ) from error
    return values


_PX4_DEFAULTS: dict[str, tuple[float, int]] = {
    "COM_POSCTL_NAVL": (1, INT32),
    "COM_POS_FS_EPH": (5.0, REAL32),
    "COM_POS_LOW_ACT": (3, INT32),
    "EKF2_AGP0_CTRL": (0, INT32),
    "EKF2_AGP0_DELAY": (0.0, REAL32),
    "EKF2_AGP0_GATE": (3.0, REAL32),
    "EKF2_AGP0_ID": (0, INT32),
    "EKF2_AGP0_MODE": (0, INT32),
    "EKF2_AGP0_NOISE": (1.0, REAL32),
    "EKF2_DELAY_MAX": (200.0, REAL32),
    "EKF2_EV_CTRL": (0, INT32),
    "EKF2_EV_DELAY": (0.0, REAL32),
    "EKF2_EV_NOISE_MD": (0, INT32),
    "EKF2_EV_POS_X": (0.0, REAL32),
    "EKF2_EV_POS_Y": (0.0, REAL32),
    "EKF2_EV_POS_Z": (0.0, REAL32),
    "EKF2_EV_QMIN": (0, INT32),
    "EKF2_EVP_GATE": (5.0, REAL32),
    "EKF2_EVP_NOISE": (0.1, REAL32),
    "EKF2_EVV_NOISE": (0.1, REAL32),
    "EKF2_GPS_CTRL": (7, INT32),
    "EKF2_GPS_MODE": (0, INT32),
    "EKF2_GPS_P_GATE": (5.0, REAL32),
    "EKF2_GPS_P_NOISE": (0.5, REAL32),
    "EKF2_NOAID_TOUT": (5_000_000, INT32),
    "GF_ACTION": (2, INT32),
    "GF_MAX_VER_DIST": (0.0, REAL32),
    "MAV_SYS_ID": (1, INT32),
}


class Px4Parameters(Parameters):
    """PX4's parameters. The vehicle model's own can be set, but only SIM_* are listed."""

    is_px4 = True

    def __init__(self) -> None:
        super().__init__()
        self._shown = [*_PX4_DEFAULTS, *(name for name in self._values if name.startswith("SIM_"))]
        self._values |= {name: value for name, (value, _) in _PX4_DEFAULTS.items()}

    def __len__(self) -> int:
        return len(self._shown)

    def __iter__(self) -> Iterator[str]:
        return iter(self._shown)

    def __contains__(self, name: str) -> bool:
        return name in self._shown

    def type_of(self, name: str) -> int:
        """See `Parameters.type_of`; the simulator's own are floats."""
        return _PX4_DEFAULTS[name][1] if name in _PX4_DEFAULTS else REAL32

    def encode_value(self, name: str) -> float:
        """See `Parameters.encode_value`."""
        if self.type_of(name) == REAL32:
            return self[name]
        return float(struct.unpack("<f", struct.pack("<i", int(self[name])))[0])

    def decode_value(self, name: str, value: float) -> float:
        """See `Parameters.decode_value`."""
        if self.type_of(name) == REAL32:
            return value
        return float(struct.unpack("<i", struct.pack("<f", value))[0])
