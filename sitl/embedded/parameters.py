"""The ArduPilot parameters that the vehicle knows, with ArduPilot's names, types and defaults."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from localizer.plain_files import plain_text
from sitl.embedded.errors import ParameterFileError

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
