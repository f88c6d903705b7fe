"""Checks the autopilot's failsafe parameters for the end of vision; never writes them.

The failsafes are the pilot's decision. ArduCopter's times were measured in SITL
(docs/explanation/integrity.md); PX4 was not flown.
"""

from __future__ import annotations

from dataclasses import dataclass

from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.preflight.rules import DoctorFinding, Read

_COPTER_LANDS = {
    0.0: "nothing: it drifts on, only reported",
    1.0: "LAND 5 to 8 s after the last position",
    2.0: "ALT_HOLD 5 to 8 s after the last position",
    3.0: "LAND, out of ALT_HOLD and STABILIZE too",
}


@dataclass(frozen=True)
class _Wanted:
    name: str
    allowed: tuple[float, ...]
    why: str


_WANTED = (
    _Wanted(
        "FS_EKF_ACTION",
        (1.0, 2.0),
        "1 lands, 2 leaves it to the pilot in ALT_HOLD; 3 takes that way out, 0 does nothing",
    ),
    _Wanted("FS_EKF_THRESH", (0.8, 0.6, 1.0), "else the EKF failsafe comes late or never"),
    _Wanted(
        "FS_DR_ENABLE", (0.0, 1.0), "RTL would fly home on an estimate of the wind: 0, or 1 (land)"
    ),
    _Wanted("FENCE_ENABLE", (1.0,), "bounds how far a wrong position can lead"),
)
_FENCE_LAND = (2.0, 4.0)
_HEIGHT_FENCE = 1


_PX4_ENDS = {0.0: "altitude mode: the pilot flies", 1.0: "LAND, without a height termination"}
_PX4_LONGEST_US = 5e6  # EKF2_NOAID_TOUT as it comes
_PX4_WANTED = (
    _Wanted("COM_POS_LOW_ACT", (5.0, 2.0, 1.0), "3 flies home by the position that is doubted"),
    _Wanted("GF_ACTION", (5.0, 2.0), "0 and 1 bound nothing, 3 flies home by the doubted position"),
)
PX4_PARAMETERS = (
    *(wanted.name for wanted in _PX4_WANTED),
    "EKF2_NOAID_TOUT",
    "COM_POS_FS_EPH",
    "GF_MAX_VER_DIST",
    "COM_POSCTL_NAVL",
    "EKF2_GPS_CTRL",
)
"""What `px4_failsafes` reads."""

PARAMETERS = (*(wanted.name for wanted in _WANTED), "FENCE_TYPE", "FENCE_ACTION")
"""What `failsafes` reads."""


def failsafes(config: BridgeConfig, read: Read) -> list[DoctorFinding]:
    """Check ArduPilot's failsafe parameters: advice only. Missing ones are skipped; [] in mode
    ``off``.
    """
    if config.mode == "off":
        return []
    lines = [*_listed(_WANTED, read), *_fence(read)]
    action = read("FS_EKF_ACTION")
    if action is not None:
        found = _COPTER_LANDS.get(action, f"FS_EKF_ACTION {action:g}")
        why = "also when the companion dies; a supervised one is back sooner (integrity.md)"
        ok = action in (1.0, 2.0)
        lines.append(_advice("when vision ends", found, "as the pilot expects", why, ok))
    return lines


def px4_failsafes(config: BridgeConfig, read: Read) -> list[DoctorFinding]:
    """Check PX4's failsafe parameters (1.15 and later); as `failsafes`."""
    if config.mode == "off":
        return []
    lines = _listed(_PX4_WANTED, read)
    alert_m = config.injection.alert_limit_m
    bounds = (
        ("EKF2_NOAID_TOUT", 1e6, _PX4_LONGEST_US, "us without vision before the EKF says so"),
        ("COM_POS_FS_EPH", 0.1, alert_m, "m; beyond it the position is lost; never where negative"),
        ("GF_MAX_VER_DIST", 1.0, 1e4, "m; a fence by height needs no position; 0 is none"),
    )
    for name, least, most, why in bounds:
        value = read(name)
        if value is not None:
            needed, ok = f"{least:g} to {most:g}", least <= value <= most
            lines.append(_advice(name, f"{value:g}", needed, why, ok))
    gnss = read("EKF2_GPS_CTRL")
    if gnss is not None and config.injection.message != "global_position_sensor":
        why = "beside GNSS, EKF2 fits an offset to vision and keeps it when GNSS ends"
        needed, ok = "bit 0 clear, or message: global_position_sensor", not int(gnss) & 1
        lines.append(_advice("EKF2_GPS_CTRL", f"{gnss:g}", needed, why, ok))
    action = read("COM_POSCTL_NAVL")
    if action is not None:
        found = _PX4_ENDS.get(action, f"COM_POSCTL_NAVL {action:g}")
        why = "from PX4's documentation, not flown; also when the companion dies (integrity.md)"
        ok = action in _PX4_ENDS
        lines.append(_advice("when vision ends", found, "as the pilot expects", why, ok))
    return lines


def _listed(all_wanted: tuple[_Wanted, ...], read: Read) -> list[DoctorFinding]:
    lines = []
    for wanted in all_wanted:
        value = read(wanted.name)
        if value is not None:
            needed = " or ".join(f"{v:g}" for v in wanted.allowed)
            ok = any(abs(value - v) < 1e-6 for v in wanted.allowed)
            lines.append(_advice(wanted.name, f"{value:g}", needed, wanted.why, ok))
    return lines


def _fence(read: Read) -> list[DoctorFinding]:
    """Findings about the fence; [] if it is off."""
    kind, action = read("FENCE_TYPE"), read("FENCE_ACTION")
    if not read("FENCE_ENABLE") or kind is None or action is None:
        return []
    by_height = bool(int(kind) & _HEIGHT_FENCE)
    why = "bit 0, maximum height: the one fence that needs no position"
    lines = [_advice("FENCE_TYPE", f"{kind:g}", "bit 0 set", why, by_height)]
    why = "RTL would fly home by the position that is doubted"
    needed = " or ".join(f"{v:g}" for v in _FENCE_LAND)
    lines.append(_advice("FENCE_ACTION", f"{action:g}", needed, why, action in _FENCE_LAND))
    return lines


def _advice(name: str, found: str, needed: str, why: str, ok: bool) -> DoctorFinding:
    return DoctorFinding(name, found, needed, why, ok, required=False)
