"""Computes loiter circles as the firmware flies them."""

from __future__ import annotations

import math

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.mission.items import LOITERS, LoiterCircle, MissionItem, MissionVehicle

_MOST_ROUNDS = 10  # every round is alike
# Without a radius: ArduPlane's WP_LOITER_RAD, PX4's NAV_LOITER_RAD, ArduCopter's CIRCLE_RADIUS.
_WINGED_M, _PX4_M, _COPTER_M = 60.0, 80.0, 10.0


def circle_of(item: MissionItem, vehicle: MissionVehicle) -> tuple[LoiterCircle | None, list[str]]:
    """The circle of a loiter item, None if the vehicle hovers or flies on; and notes as sentences.

    A multirotor with ArduPilot flies a circle for LOITER_TURNS only; with PX4 it flies none. A
    vehicle of unknown kind is treated as one with wings.
    """
    if item.command not in LOITERS:
        return None, []
    turns = item.command == mavlink.MAV_CMD_NAV_LOITER_TURNS
    if vehicle.is_multirotor and (vehicle.is_px4 or not turns):
        return None, []
    notes, count = [], item.parameters[0]
    radius = item.parameters[LOITERS[item.command]]
    if math.isnan(radius) or radius == 0:
        usual = _PX4_M if vehicle.is_px4 else _WINGED_M
        radius = _COPTER_M if vehicle.is_multirotor else usual
        notes.append(
            f"{item.label} gives no radius: judged on the firmware's default circle of "
            f"{radius:.0f} m."
        )
    rounds = math.ceil(count) if turns and math.isfinite(count) and count > 0 else 1
    if rounds > _MOST_ROUNDS:
        notes.append(f"{item.label}: {_MOST_ROUNDS} of its {rounds} rounds are counted.")
    elif item.command in (mavlink.MAV_CMD_NAV_LOITER_TIME, mavlink.MAV_CMD_NAV_LOITER_UNLIM):
        notes.append(f"{item.label}: one round of its circle is judged, all are equal.")
    return LoiterCircle(radius, min(rounds, _MOST_ROUNDS), vehicle.is_multirotor), notes
