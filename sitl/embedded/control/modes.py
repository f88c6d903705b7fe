"""ArduCopter's flight modes, mission execution, EKF check and failsafe."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from math import radians

import numpy as np

from sitl.embedded.control import mission as mis
from sitl.embedded.control.controller import Vector
from sitl.embedded.control.guidance import Guidance
from sitl.embedded.control.mode import Mode
from sitl.embedded.ekf.estimator import Estimator
from sitl.embedded.parameters import Parameters
from sitl.embedded.physics.gimbal import Gimbal
from sitl.embedded.physics.rotation import Array, quaternion, wrap_pi
from sitl.embedded.severity import CRITICAL, INFO
from sitl.geodesy import Location

_CHECKS_TO_FAIL = 10  # consecutive 10 Hz checks before the EKF failsafe
_WARNING_PERIOD_S = 30.0


class EkfCheck:
    """Checks the EKF's variances and innovations; call both methods at 10 Hz.

    failsafe: set by the caller if it acts on a failure. The check clears it, with a text, when the
    EKF is good again.
    """

    def __init__(
        self, parameters: Parameters, estimator: Estimator, notify: Callable[[int, str], None]
    ) -> None:
        self.failsafe = False
        self._parameters = parameters
        self._estimator = estimator
        self._notify = notify
        self._fails = 0
        self._bad = False
        self._ever_good = False
        self._last_warning = -1e9
        self._glitching = False

    def fails(self, time_s: float) -> bool:
        """True once per failure: at the check that completes the required number of failing checks.
        Never before the EKF was good once.
        """
        limit = self._parameters["FS_EKF_THRESH"]
        if self._estimator.origin is None or limit <= 0:
            return False
        passed = self._passes(limit)
        self._ever_good |= passed
        if not self._ever_good:
            return False
        if passed:
            self._fails = max(0, self._fails - 1)
            if self._bad and self._fails == 0:
                self._recover()
            return False
        if self._bad:
            return False
        self._fails += 1
        self._bad = self._fails >= _CHECKS_TO_FAIL
        if self._bad and time_s - self._last_warning > _WARNING_PERIOD_S:
            self._last_warning = time_s
            self._notify(CRITICAL, "EKF variance")
        return self._bad

    def report_glitch(self) -> None:
        """Send a text when GNSS leaves the innovation gate, and when it returns."""
        if self._estimator.gps_glitching is self._glitching:
            return
        self._glitching = not self._glitching
        text = "GPS Glitch or Compass error" if self._glitching else "Glitch cleared"
        self._notify(CRITICAL, text)

    def _passes(self, limit: float) -> bool:
        velocity, position, _, compass = self._estimator.variances
        over = int(compass >= limit) + (2 if velocity >= 2 * limit else int(velocity >= limit))
        bad = over >= 2 or (over >= 1 and position >= limit)
        return not bad and self._estimator.position_valid

    def _recover(self) -> None:
        self._bad = False
        if self.failsafe:
            self.failsafe = False
            self._notify(CRITICAL, "EKF Failsafe Cleared")


class RtlStage(Enum):
    """Stage of a return to launch."""

    CLIMB = "climb"
    RETURN = "return"
    LOITER = "loiter"
    LAND = "land"


@dataclass
class FlightModes:
    """Flight mode logic: target, attitude and thrust of the active mode.

    Above 200 lines: each mode takes a few lines, and all share home, target and landing.
    """

    parameters: Parameters
    estimator: Estimator
    gimbal: Gimbal
    mission: mis.MissionStore
    notify: Callable[[int, str], None]
    on_reached: Callable[[int], None]
    mode: Mode = Mode.STABILIZE
    armed: bool = False
    home: Location | None = None
    on_ground: bool = True
    mission_index: int = 0
    _flying: bool = False
    _rtl: RtlStage = RtlStage.CLIMB
    _stage_since: float = 0.0
    _time: float = 0.0
    _armed_since: float = 0.0
    _ground_since: float = 0.0

    def __post_init__(self) -> None:
        self._guidance = Guidance(self.parameters, self.estimator)
        self.ekf_check = EkfCheck(self.parameters, self.estimator, self.notify)

    # --- requests ----------------------------------------------------------------------------

    def set_mode(self, mode: Mode) -> bool:
        """Change the flight mode; True if it is then the active one. Refused with a STATUSTEXT: a
        mode that needs a position, without one while armed; AUTO without a mission.
        """
        if mode is self.mode:
            return True
        if mode.needs_position and self.armed and not self.estimator.position_valid:
            self.notify(CRITICAL, f"Mode change to {mode.name} failed: requires position")
            return False
        if mode is Mode.AUTO and len(self.mission.items) < 2:
            self.notify(CRITICAL, "Mode change to AUTO failed: init failed")
            return False
        self._enter(mode)
        return True

    def _enter(self, mode: Mode) -> None:
        self.mode = mode
        self._guidance.returning = mode is Mode.RTL
        self._guidance.landing = mode is Mode.LAND
        self._guidance.yaw_target = None
        self._guidance.hold_here()
        if mode is Mode.AUTO:
            self._guidance.speed_override = None
            self.mission_index = 0
            if self.armed:
                self._advance_mission()
        elif mode is Mode.RTL:
            self._begin_rtl()

    def arm(self) -> None:
        """Arm; the caller has run the pre-arm checks."""
        self.armed = self.estimator.sources.armed = True
        self._armed_since = self._ground_since = self._time
        self._flying = False
        self._guidance.reset()
        self._guidance.hold_here()

    def disarm(self) -> None:
        """Stop the motors."""
        self.armed = self.estimator.sources.armed = False
        self._flying = self._guidance.landing = False
        self._guidance.set_point = None

    def takeoff(self, height_m: float) -> bool:
        """MAV_CMD_NAV_TAKEOFF: climb to a height above home. False unless armed on the ground in
        GUIDED.
        """
        if not (self.armed and self.mode is Mode.GUIDED and not self._flying):
            return False
        self._begin_takeoff(height_m)
        return True

    def go_to(self, location: Location, yaw_rad: float | None = None) -> bool:
        """Fly to a location, and turn to yaw_rad if given. False if the vehicle does not fly in
        GUIDED, or has no EKF origin.
        """
        if not self._guided or self.estimator.origin is None:
            return False
        self.go_to_local(self.estimator.origin.ned_of(location), yaw_rad)
        return True

    def go_to_local(self, target: Vector, yaw_rad: float | None = None) -> bool:
        """Fly to NED metres from the EKF origin (yaw_rad None: keep it); False outside GUIDED."""
        if not self._guided:
            return False
        self._guidance.fly(target)
        if yaw_rad is not None:
            self._guidance.yaw_target = yaw_rad
        return True

    def start_mission(self, index: int = 1) -> bool:
        """MAV_CMD_MISSION_START, MISSION_SET_CURRENT: fly the mission from item `index` on. False
        without that item; outside AUTO only item 1 is accepted.
        """
        if not 0 < index < len(self.mission.items):
            return False
        if self.mode is Mode.AUTO:
            self.mission_index = index - 1
            if self.armed:
                self._advance_mission()
            return True
        return index == 1 and self.set_mode(Mode.AUTO)

    def condition_yaw(self, angle_deg: float, direction: float, relative: bool) -> None:
        """MAV_CMD_CONDITION_YAW: hold a heading until the next waypoint. relative: angle_deg counts
        from the present heading, clockwise if direction >= 0.
        """
        angle = radians(angle_deg)
        if relative:
            angle = self._guidance.yaw + (angle if direction >= 0 else -angle)
        self._guidance.yaw_target = wrap_pi(angle)

    def change_speed(self, speed_m_s: float) -> bool:
        """MAV_CMD_DO_CHANGE_SPEED: speed instead of WPNAV_SPEED; False if it is not positive."""
        if speed_m_s <= 0:
            return False
        self._guidance.speed_override = speed_m_s
        return True

    @property
    def flying(self) -> bool:
        """Whether a take-off has begun and no landing ended (STABILIZE: whether it is in the
        air).
        """
        return self._flying

    @property
    def target(self) -> Vector | None:
        """Target position, NED metres about the origin; None without one."""
        return self._guidance.set_point.end if self._guidance.set_point else None

    # --- every tick --------------------------------------------------------------------------

    def update(self, time_s: float) -> Array:
        """Attitude quaternion and total thrust (5,) for the next tick. Called once a tick: it sets
        home before arming, flies the mode, and disarms after a landing.
        """
        self._time = time_s
        self._set_home()
        if self.armed:
            self._watch_ground()
        if self.mode is Mode.STABILIZE:
            self._flying = self.armed and not self.on_ground
        if not (self.armed and self._flying) or self.mode is Mode.STABILIZE:  # sticks are down
            return np.array([*quaternion(0.0, 0.0, self._guidance.yaw), 0.0])
        if self.mode is Mode.AUTO:
            self._run_mission()
        elif self.mode is Mode.RTL:
            self._run_rtl()
        return self._guidance.steer(self._home_ned()[2], level_when_lost=self.mode is Mode.LAND)

    def check_ekf(self) -> None:
        """Run the EKF checks, and the failsafe if they fail: LAND, or a text only if FS_EKF_ACTION
        is 0 or the mode needs no position. Called at 10 Hz.
        """
        if self.ekf_check.fails(self._time) and self.armed:
            self.ekf_check.failsafe = True
            if not self.mode.needs_position or self.parameters["FS_EKF_ACTION"] == 0:
                self.notify(CRITICAL, "EKF Failsafe")
            else:
                self._enter(Mode.LAND)
                self.notify(CRITICAL, "EKF Failsafe: changed to LAND Mode")
        self.ekf_check.report_glitch()

    # --- helpers -----------------------------------------------------------------------------

    @property
    def _guided(self) -> bool:
        return self.mode is Mode.GUIDED and self.armed and self._flying

    def _set_home(self) -> None:
        if not self.armed and self.estimator.position_valid and self.estimator.location:
            if self.home is None:
                self.notify(INFO, "AHRS: EKF3 active")
            self.home = self.estimator.location

    def _home_ned(self) -> Vector:
        if self.home is None or self.estimator.origin is None:
            return 0.0, 0.0, 0.0
        return self.estimator.origin.ned_of(self.home)

    def _begin_takeoff(self, height_m: float) -> None:
        self._flying = True
        self._guidance.climb(self._home_ned()[2] - height_m)

    def _watch_ground(self) -> None:
        """Take note of landing, and disarm on the ground as ArduCopter does."""
        if not self.on_ground:
            self._ground_since = self._time
        settled = self._time - self._ground_since > 1.0
        if self._guidance.landing and settled:
            self.notify(INFO, "Disarming motors")
            self.disarm()
        delay = self.parameters["DISARM_DELAY"]
        if not self._flying and self.on_ground and delay > 0:
            if self._time - self._armed_since > delay:
                self.notify(INFO, "Disarming motors")
                self.disarm()
        elif not self.on_ground:
            self._armed_since = self._time

    # --- return to launch --------------------------------------------------------------------

    def _begin_rtl(self) -> None:
        self._rtl = RtlStage.CLIMB
        north, east, down = self.estimator.position
        top = min(down, self._home_ned()[2] - self.parameters["RTL_ALT"] / 100.0)
        self._guidance.fly((north, east, top))

    def _run_rtl(self) -> None:
        if self._rtl is RtlStage.CLIMB and self._guidance.arrived():
            self._rtl = RtlStage.RETURN
            home = self._home_ned()
            self._guidance.fly((home[0], home[1], self.estimator.position[2]))
        elif self._rtl is RtlStage.RETURN and self._guidance.arrived():
            self._rtl, self._stage_since = RtlStage.LOITER, self._time
        elif (
            self._rtl is RtlStage.LOITER
            and self._time - self._stage_since >= self.parameters["RTL_LOIT_TIME"] / 1000.0
        ):
            self._rtl = RtlStage.LAND
            self._guidance.landing = True

    # --- mission -----------------------------------------------------------------------------

    def _advance_mission(self) -> None:
        """Go to the next navigation item, running the commands on the way to it."""
        while self.mission_index + 1 < len(self.mission.items):
            self.mission_index += 1
            item = self.mission.items[self.mission_index]
            if item.command in mis.NAVIGATION:
                self._start_item(item)
                return
            self._do(item)

    def _start_item(self, item: mis.StoredMissionItem) -> None:
        origin, here = self.estimator.origin, self.estimator.location
        if origin is None or here is None or self.home is None:
            return
        self._stage_since = 0.0
        self.notify(INFO, f"Mission: {self.mission_index} {_NAMES[item.command]}")
        target = origin.ned_of(item.location(here, self.home))
        if item.command == mis.TAKEOFF:
            if self._flying:
                self._guidance.fly((*self.estimator.position[:2], target[2]))
            else:
                self._begin_takeoff(self._home_ned()[2] - target[2])
        elif item.command == mis.RTL:
            self._begin_rtl()
        elif item.command == mis.LAND:
            down = self.estimator.position[2]
            self._guidance.fly((target[0], target[1], down))
        else:
            self._guidance.fly(target)

    def _run_mission(self) -> None:
        if not 0 < self.mission_index < len(self.mission.items):
            return
        item = self.mission.items[self.mission_index]
        if item.command == mis.RTL:
            self._run_rtl()
            return
        if not self._guidance.arrived():
            return
        if item.command == mis.LAND:
            self._guidance.landing = True
            return
        if self._stage_since == 0.0:
            self._stage_since = self._time
        delay = item.parameters[0] if item.command in (mis.WAYPOINT, mis.LOITER_TIME) else 0.0
        last = self.mission_index + 1 >= len(self.mission.items)
        if self._time - self._stage_since >= delay:
            self.on_reached(self.mission_index)
            if last:
                self._stage_since = float("inf")  # reached once; hold here
            else:
                self._advance_mission()

    def _do(self, item: mis.StoredMissionItem) -> None:
        p = item.parameters
        if item.command == mis.CONDITION_YAW:
            self.condition_yaw(p[0], p[2], bool(p[3]))
        elif item.command == mis.CHANGE_SPEED:
            self.change_speed(p[1])
        elif item.command == mis.MOUNT_CONTROL:
            self.gimbal.point(p[0], p[2], yaw_locked=False)
        elif item.command == mis.GIMBAL_PITCHYAW:
            self.gimbal.point(p[0], p[1], yaw_locked=bool(int(item.latitude_deg * 1e7) & 16))
        elif item.command == mis.ROI_NONE:
            self.gimbal.look_at(None)
        elif item.command == mis.ROI_LOCATION and self.estimator.location and self.home:
            self.gimbal.look_at(item.location(self.estimator.location, self.home))


_NAMES = {
    mis.TAKEOFF: "Takeoff",
    mis.WAYPOINT: "WP",
    mis.LOITER_TIME: "LoitTime",
    mis.RTL: "RTL",
    mis.LAND: "Land",
}
