"""PX4's parameters, with its names, types and defaults; integers travel as bytes in the float.

With them the vehicle is the same aircraft with PX4's interface: modes, messages, position aiding.

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

from sitl.embedded.parameters import INT32, REAL32, Parameters

_DEFAULTS: dict[str, tuple[float, int]] = {
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
        self._shown = [*_DEFAULTS, *(name for name in self._values if name.startswith("SIM_"))]
        self._values |= {name: value for name, (value, _) in _DEFAULTS.items()}

    def __len__(self) -> int:
        return len(self._shown)

    def __iter__(self) -> Iterator[str]:
        return iter(self._shown)

    def __contains__(self, name: str) -> bool:
        return name in self._shown

    def type_of(self, name: str) -> int:
        """See `Parameters.type_of`; the simulator's own are floats."""
        return _DEFAULTS[name][1] if name in _DEFAULTS else REAL32

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
