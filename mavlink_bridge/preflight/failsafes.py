"""What ArduPilot does once vision ends: told before the flight, and never written.

The vehicle's failsafes are its pilot's decision. Values are those of ArduCopter's own parameter
descriptions; the times were measured in SITL (docs/explanation/integrity.md).
"""

from __future__ import annotations

from dataclasses import dataclass

from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.preflight.rules import Read

_COPTER_LANDS = {
    0.0: "nothing: it drifts on, only reported",
    1.0: "LAND 5 to 8 s after the last position",
    2.0: "ALT_HOLD 5 to 8 s after the last position",
    3.0: "LAND, out of ALT_HOLD and STABILIZE too",
}


@dataclass(frozen=True)
class Failsafe:
    """One line of the doctor's table, which is advice: what is set, what should be, and why."""

    name: str
    found: str
    needed: str
    why: str
    ok: bool


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


PARAMETERS = (*(wanted.name for wanted in _WANTED), "FENCE_TYPE", "FENCE_ACTION")
"""What `failsafes` reads."""


def failsafes(config: BridgeConfig, read: Read) -> list[Failsafe]:
    """What is set; a parameter that the vehicle does not have gives no line."""
    if config.mode == "off":
        return []
    lines = []
    for wanted in _WANTED:
        value = read(wanted.name)
        if value is not None:
            needed = " or ".join(f"{v:g}" for v in wanted.allowed)
            ok = any(abs(value - v) < 1e-6 for v in wanted.allowed)
            lines.append(Failsafe(wanted.name, f"{value:g}", needed, wanted.why, ok))
    lines += _fence(read)
    action = read("FS_EKF_ACTION")
    if action is not None:
        found = _COPTER_LANDS.get(action, f"FS_EKF_ACTION {action:g}")
        why = "also when the companion dies; a supervised one is back sooner (integrity.md)"
        ok = action in (1.0, 2.0)
        lines.append(Failsafe("when vision ends", found, "as the pilot expects", why, ok))
    return lines


def _fence(read: Read) -> list[Failsafe]:
    """Only of a fence that is on: of another it does not matter."""
    kind, action = read("FENCE_TYPE"), read("FENCE_ACTION")
    if not read("FENCE_ENABLE") or kind is None or action is None:
        return []
    by_height = bool(int(kind) & _HEIGHT_FENCE)
    why = "bit 0, maximum height: the one fence that needs no position"
    lines = [Failsafe("FENCE_TYPE", f"{kind:g}", "bit 0 set", why, by_height)]
    why = "RTL would fly home by the position that is doubted"
    needed = " or ".join(f"{v:g}" for v in _FENCE_LAND)
    lines.append(Failsafe("FENCE_ACTION", f"{action:g}", needed, why, action in _FENCE_LAND))
    return lines
