"""Look-at: commands the autopilot to point the gimbal at a position or a target.

MAV_CMD_DO_SET_ROI_LOCATION (195) of the gimbal protocol v2, forwarded to the autopilot as its
gimbal manager; https://mavlink.io/en/services/gimbal_v2.html. ArduCopter turns the whole aircraft
if the mount has no yaw of its own. Off unless `look_at` allows it.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import CommandAnswer, LookAtRefusal
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.messages import TargetReport
from mavlink_bridge.place_hint import place_of
from mavlink_bridge.vehicle.origin import north_east

LOOK_AT_PLACE = mavlink.MAV_CMD_DO_SET_ROI_LOCATION
LOOK_AHEAD = mavlink.MAV_CMD_DO_SET_ROI_NONE
LOOK_AT_TARGET = mavlink.MAV_CMD_USER_4  # ours: param1 is the target's number, 0 ends it
LOOKS = frozenset((LOOK_AT_PLACE, LOOK_AHEAD, LOOK_AT_TARGET))
_AGAIN_NS = 1_000_000_000  # a target that moves is followed so often
_MOVED_M = 1.0
_PATIENCE_NS = 3_000_000_000  # for the autopilot's answer


@dataclass(frozen=True)
class _Place:
    """Position in degrees; altitude in metres above the reference of `frame` (MAV_FRAME)."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    frame: int = int(mavlink.MAV_FRAME_GLOBAL)


class LookAt:
    """Keeps the gimbal's target. Thread-safe; `due` and `answered` are called in the flight
    controller's thread.

    report: sends an alert to the operator.
    """

    def __init__(
        self, config: BridgeConfig, geoid_separation_m: float, report: Callable[[Alert], None]
    ) -> None:
        self._allowed = config.look_at
        self._has_gimbal = config.camera.mount == "gimbal"
        self._geoid_m = geoid_separation_m
        self._report = report
        self._targets: dict[int, TargetReport] = {}
        self._number = 0
        self._wanted: _Place | None = None
        self._ahead = False
        self._sent: _Place | None = None
        self._sent_ns = 0
        self._asked_ns: int | None = None
        self._lock = threading.Lock()

    def report(self, target: TargetReport) -> None:
        """Update the position of a target, which the gimbal may follow or be told to."""
        with self._lock:
            self._targets[target.target_id] = target
            if self._number and target.target_id == self._number:
                self._wanted = self._place_of(target)

    def forget(self, number: int) -> None:
        """Forget a target that has ended. If the gimbal follows this target, it keeps its
        direction, and that is reported.
        """
        with self._lock:
            self._targets.pop(number, None)
            if self._number != number:
                return
            self._number, self._wanted = 0, None
        self._report(alert(AlertId.LOOK_AT_ENDED, number=number))

    def command(self, message: Any) -> int:
        """Process a COMMAND_LONG or COMMAND_INT of `LOOKS`; returns its MAV_RESULT. Refusals are
        reported.
        """
        refused = self._execute(message)
        if refused is None:
            return int(mavlink.MAV_RESULT_ACCEPTED)
        self._report(refused)
        return int(mavlink.MAV_RESULT_DENIED)

    def due(self, now_ns: int) -> tuple[int, int, int, int, float] | None:
        """COMMAND_INT for the autopilot, which counts as sent: command, frame, x and y (1e-7
        degrees), z (m). None if none is due. An answer that is missing for 3 s is reported.
        """
        with self._lock:
            if self._asked_ns is not None and now_ns - self._asked_ns > _PATIENCE_NS:
                self._asked_ns = None
                self._report(alert(AlertId.LOOK_AT_UNANSWERED))
            if self._ahead:
                self._ahead, self._sent = False, None
                self._asked_ns = now_ns
                return (LOOK_AHEAD, int(mavlink.MAV_FRAME_GLOBAL), 0, 0, 0.0)
            wanted = self._wanted
            if wanted is None or not self._is_news(wanted, now_ns):
                return None
            self._sent, self._sent_ns = wanted, now_ns
            self._asked_ns = now_ns if self._asked_ns is None else self._asked_ns
            x, y = round(wanted.latitude_deg * 1e7), round(wanted.longitude_deg * 1e7)
            return (LOOK_AT_PLACE, wanted.frame, x, y, wanted.altitude_m)

    def answered(self, result: int) -> None:
        """Process the autopilot's answer to a look-at. A refusal is reported and the command is not
        repeated. Unexpected answers are ignored.
        """
        with self._lock:
            if self._asked_ns is None:
                return
            self._asked_ns = None
            if result in (mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_IN_PROGRESS):
                return
            self._wanted, self._number = None, 0
        self._report(alert(AlertId.LOOK_AT_DENIED, result=CommandAnswer.of(result)))

    def _execute(self, message: Any) -> Alert | None:
        """Execute the command; returns why it is refused, or None."""
        if not self._allowed:
            return alert(AlertId.LOOK_AT_REFUSED, why=LookAtRefusal.OFF)
        if not self._has_gimbal:
            return alert(AlertId.LOOK_AT_REFUSED, why=LookAtRefusal.FIXED_CAMERA)
        with self._lock:
            if message.command == LOOK_AT_PLACE:
                nowhere = alert(AlertId.LOOK_AT_REFUSED, why=LookAtRefusal.NO_PLACE)
                return self._look(0, _place(message), nowhere)
            number = 0
            if message.command == LOOK_AT_TARGET:
                number = int(message.param1) if math.isfinite(message.param1) else -1
            if number == 0:
                self._number, self._wanted, self._ahead = 0, None, True
                return None
            target = self._targets.get(number)
            place = None if target is None else self._place_of(target)
            return self._look(number, place, alert(AlertId.LOOK_AT_NO_TARGET, number=number))

    def _look(self, number: int, place: _Place | None, refused: Alert) -> Alert | None:
        if place is None:
            return refused
        self._number, self._wanted, self._sent = number, place, None
        return None

    def _place_of(self, target: TargetReport) -> _Place:
        altitude_m = target.height_m - self._geoid_m
        return _Place(target.latitude_deg, target.longitude_deg, altitude_m)

    def _is_news(self, wanted: _Place, now_ns: int) -> bool:
        sent = self._sent
        if sent is None:
            return True
        if wanted == sent or now_ns - self._sent_ns < _AGAIN_NS:
            return False
        north, east = north_east(
            sent.latitude_deg, sent.longitude_deg, wanted.latitude_deg, wanted.longitude_deg
        )
        return math.hypot(north, east, wanted.altitude_m - sent.altitude_m) > _MOVED_M


def _place(message: Any) -> _Place | None:
    """Position of a MAV_CMD_DO_SET_ROI_LOCATION; None if it has none."""
    place = place_of(message)
    if place is None or not abs(place[2]) < 2e4:
        return None
    return _Place(*place, int(getattr(message, "frame", mavlink.MAV_FRAME_GLOBAL)))
