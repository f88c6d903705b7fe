"""Flight modes, the mission executor and the EKF failsafe, as ArduCopter's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from math import atan2, cos, hypot, radians

import numpy as np

from sitl.embedded import mission as mis
from sitl.embedded.controller import Carrot, Limits, PositionController, Vector
from sitl.embedded.dynamics import GRAVITY, MASS, MOTOR_MAX
from sitl.embedded.estimator import Estimator
from sitl.embedded.geodesy import Location
from sitl.embedded.gimbal import Gimbal
from sitl.embedded.loop import TICK_S
from sitl.embedded.parameters import Parameters
from sitl.embedded.rotation import Array, euler, quaternion, wrap_pi
from sitl.embedded.severity import CRITICAL, INFO

_LAND_FINAL_HEIGHT = 10.0  # m; below it LAND_SPEED
_CHECKS_TO_FAIL = 10  # consecutive 10 Hz checks before the EKF failsafe (ekf_check)


class Mode(IntEnum):
    """ArduCopter custom modes."""

    STABILIZE = 0
    AUTO = 3
    GUIDED = 4
    RTL = 6
    LAND = 9

    @property
    def needs_position(self) -> bool:
        """Whether the mode may only be entered with a position estimate."""
        return self in (Mode.AUTO, Mode.GUIDED, Mode.RTL)

    @property
    def armable(self) -> bool:
        """Whether the vehicle may be armed in it."""
        return self in (Mode.STABILIZE, Mode.GUIDED)


class RtlStage(Enum):
    """Where a return to launch stands."""

    CLIMB = "climb"
    RETURN = "return"
    LOITER = "loiter"
    LAND = "land"


@dataclass(frozen=True)
class RcInput:
    """Stick positions: -1 to 1, throttle 0 to 1."""

    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    throttle: float = 0.0


@dataclass
class FlightModes:
    """What the vehicle is doing, and the attitude and thrust that follow from it."""

    parameters: Parameters
    estimator: Estimator
    gimbal: Gimbal
    mission: mis.MissionStore
    notify: Callable[[int, str], None]
    on_reached: Callable[[int], None]
    mode: Mode = Mode.STABILIZE
    armed: bool = False
    home: Location | None = None
    rc: RcInput = RcInput()
    on_ground: bool = True
    mission_index: int = 0
    _controller: PositionController = field(default_factory=PositionController)
    _carrot: Carrot | None = None
    _velocity_target: Vector | None = None
    _speed_override: float | None = None
    _yaw_target: float | None = None
    _yaw_rate: float | None = None
    _flying: bool = False
    _landing: bool = False
    _rtl: RtlStage = RtlStage.CLIMB
    _stage_since: float = 0.0
    _time: float = 0.0
    _armed_since: float = 0.0
    _ground_since: float = 0.0
    _ekf_fails: int = 0
    _ekf_bad: bool = False
    _ekf_ever_good: bool = False
    _ekf_failsafe: bool = False
    _last_warning: float = -1e9
    _glitching: bool = False

    # --- requests ----------------------------------------------------------------------------

    def set_mode(self, mode: Mode) -> bool:
        """Change mode; refused without a position where one is needed."""
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
        self._velocity_target = None
        self._yaw_rate = None
        self._landing = mode is Mode.LAND
        self._yaw_target = None
        self._hold_here()
        if mode is Mode.AUTO:
            self._speed_override = None
            self.mission_index = 0
            if self.armed:
                self._advance_mission()
        elif mode is Mode.RTL:
            self._begin_rtl()

    def arm(self) -> None:
        """Arm; the caller has run the checks."""
        self.armed = self.estimator.armed = True
        self._armed_since = self._ground_since = self._time
        self._flying = False
        self._controller.reset(self._yaw)
        self._hold_here()

    def disarm(self) -> None:
        """Stop the motors."""
        self.armed = self.estimator.armed = False
        self._flying = self._landing = False
        self._carrot = None

    def takeoff(self, height_m: float) -> bool:
        """MAV_CMD_NAV_TAKEOFF: climb to a height above home; only on the ground in GUIDED."""
        if not (self.armed and self.mode is Mode.GUIDED and not self._flying):
            return False
        self._begin_takeoff(height_m)
        return True

    def go_to(self, location: Location, yaw_rad: float | None = None) -> bool:
        """Fly to a location in GUIDED."""
        if not self._guided or self.estimator.origin is None:
            return False
        self.go_to_local(self.estimator.origin.ned_of(location), yaw_rad)
        return True

    def go_to_local(self, target: Vector, yaw_rad: float | None = None) -> bool:
        """Fly to NED metres about the EKF origin in GUIDED."""
        if not self._guided:
            return False
        self._velocity_target = None
        self._yaw_rate = None
        self._fly(target)
        if yaw_rad is not None:
            self._yaw_target = yaw_rad
        return True

    def fly_velocity(self, velocity: Vector, yaw_rad: float | None, yaw_rate: float | None) -> bool:
        """Fly at a NED velocity in GUIDED."""
        if not self._guided:
            return False
        self._velocity_target = velocity
        self._yaw_rate = yaw_rate
        if yaw_rad is not None:
            self._yaw_target = yaw_rad
        return True

    def start_mission(self, index: int = 1) -> bool:
        """MAV_CMD_MISSION_START, MISSION_SET_CURRENT: (re)start AUTO at an item."""
        if not 0 < index < len(self.mission.items):
            return False
        if self.mode is Mode.AUTO:
            self.mission_index = index - 1
            if self.armed:
                self._advance_mission()
            return True
        return index == 1 and self.set_mode(Mode.AUTO)

    def condition_yaw(self, angle_deg: float, direction: float, relative: bool) -> None:
        """MAV_CMD_CONDITION_YAW: hold a heading until the next waypoint."""
        angle = radians(angle_deg)
        if relative:
            angle = self._yaw + (angle if direction >= 0 else -angle)
        self._yaw_target = wrap_pi(angle)
        self._yaw_rate = None

    def change_speed(self, speed_m_s: float) -> bool:
        """MAV_CMD_DO_CHANGE_SPEED."""
        if speed_m_s <= 0:
            return False
        self._speed_override = speed_m_s
        return True

    @property
    def flying(self) -> bool:
        """Whether the vehicle has left the ground."""
        return self._flying

    @property
    def target(self) -> Vector | None:
        """Where the vehicle is headed, NED metres about the origin."""
        return self._carrot.end if self._carrot else None

    # --- every tick --------------------------------------------------------------------------

    def update(self, time_s: float) -> Array:
        """Attitude quaternion and total thrust (5,) for the next tick."""
        self._time = time_s
        self._set_home()
        if not self.armed:
            return np.array([*quaternion(0.0, 0.0, self._yaw), 0.0])
        self._watch_ground()
        if not self.armed:
            return np.array([*quaternion(0.0, 0.0, self._yaw), 0.0])
        if self.mode is Mode.STABILIZE:
            return self._stabilize()
        if not self._flying:
            return np.array([*quaternion(0.0, 0.0, self._yaw), 0.0])
        if self.mode is Mode.AUTO:
            self._run_mission()
        elif self.mode is Mode.RTL:
            self._run_rtl()
        return self._steer()

    def check_ekf(self) -> None:
        """The 10 Hz EKF check and failsafe (ArduCopter's ekf_check)."""
        limit = self.parameters["FS_EKF_THRESH"]
        if self.estimator.origin is None or limit <= 0:
            return
        velocity, position, _, compass = self.estimator.variances
        over = int(compass >= limit) + (2 if velocity >= 2 * limit else int(velocity >= limit))
        bad = over >= 2 or (over >= 1 and position >= limit)
        passed = not bad and self.estimator.position_valid
        self._ekf_ever_good |= passed
        if not self._ekf_ever_good:
            return
        if passed:
            self._ekf_fails = max(0, self._ekf_fails - 1)
            if self._ekf_bad and self._ekf_fails == 0:
                self._ekf_bad = False
                if self._ekf_failsafe:
                    self._ekf_failsafe = False
                    self.notify(CRITICAL, "EKF Failsafe Cleared")
        elif not self._ekf_bad:
            self._ekf_fails += 1
            if self._ekf_fails >= _CHECKS_TO_FAIL:
                self._ekf_bad = True
                self._fail_ekf()

    def check_glitch(self) -> None:
        """ArduCopter's gpsglitch_check: tells when GNSS leaves the innovation gate, and returns."""
        if self.estimator.gps_glitching is self._glitching:
            return
        self._glitching = not self._glitching
        text = "GPS Glitch or Compass error" if self._glitching else "Glitch cleared"
        self.notify(CRITICAL, text)

    def _fail_ekf(self) -> None:
        if self._time - self._last_warning > 30.0:
            self._last_warning = self._time
            self.notify(CRITICAL, "EKF variance")
        if not self.armed:
            return
        self._ekf_failsafe = True
        if not self.mode.needs_position or self.parameters["FS_EKF_ACTION"] == 0:
            self.notify(CRITICAL, "EKF Failsafe")
            return
        self._enter(Mode.LAND)
        self.notify(CRITICAL, "EKF Failsafe: changed to LAND Mode")

    # --- helpers -----------------------------------------------------------------------------

    @property
    def _guided(self) -> bool:
        return self.mode is Mode.GUIDED and self.armed and self._flying

    @property
    def _yaw(self) -> float:
        return euler(self.estimator.output[0:4])[2]

    @property
    def limits(self) -> Limits:
        """Speeds and accelerations of the present mode."""
        p = self.parameters
        speed = self._speed_override or p["WPNAV_SPEED"] / 100.0
        if self.mode is Mode.RTL and p["RTL_SPEED"] > 0:
            speed = p["RTL_SPEED"] / 100.0
        return Limits(
            speed,
            p["WPNAV_SPEED_UP"] / 100.0,
            p["WPNAV_SPEED_DN"] / 100.0,
            p["WPNAV_ACCEL"] / 100.0,
            p["WPNAV_ACCEL_Z"] / 100.0,
        )

    def _set_home(self) -> None:
        if not self.armed and self.estimator.position_valid and self.estimator.location:
            if self.home is None:
                self.notify(INFO, "AHRS: EKF3 active")
            self.home = self.estimator.location

    def _home_ned(self) -> Vector:
        if self.home is None or self.estimator.origin is None:
            return 0.0, 0.0, 0.0
        return self.estimator.origin.ned_of(self.home)

    def _fly(self, target: Vector) -> None:
        old, here = self._carrot, self.estimator.position
        if old is not None and old.end == target:
            return
        start, speed = here, 0.0
        if old is not None and hypot(old.position[0] - here[0], old.position[1] - here[1]) < 20.0:
            start = old.position
            way = [t - s for t, s in zip(target, start, strict=True)]
            length = max(sum(w * w for w in way) ** 0.5, 1e-6)
            speed = sum(v * w for v, w in zip(old.velocity, way, strict=True)) / length
        self._carrot = Carrot(start, target, max(speed, 0.0))
        north, east = target[0] - start[0], target[1] - start[1]
        behavior = int(self.parameters["WP_YAW_BEHAVIOR"])
        follows = behavior == 1 or (behavior == 2 and self.mode is not Mode.RTL)
        if follows and hypot(north, east) > 2.0:
            self._yaw_target = atan2(east, north)

    def _hold_here(self) -> None:
        here = self.estimator.position
        self._carrot = Carrot(here, here)

    def _begin_takeoff(self, height_m: float) -> None:
        self._flying = True
        self._controller.reset(self._yaw)
        north, east, down = self.estimator.position
        top = self._home_ned()[2] - height_m
        self._carrot = Carrot((north, east, down), (north, east, top))
        self._yaw_target = self._yaw

    def _watch_ground(self) -> None:
        """Take note of landing, and disarm on the ground as ArduCopter does."""
        if not self.on_ground:
            self._ground_since = self._time
        settled = self._time - self._ground_since > 1.0
        if self._landing and settled:
            self.notify(INFO, "Disarming motors")
            self.disarm()
        delay = self.parameters["DISARM_DELAY"]
        idle = self.mode is not Mode.STABILIZE or self.rc.throttle < 0.05
        if not self._flying and self.on_ground and idle and delay > 0:
            if self._time - self._armed_since > delay:
                self.notify(INFO, "Disarming motors")
                self.disarm()
        elif not self.on_ground:
            self._armed_since = self._time

    def _stabilize(self) -> Array:
        rc = self.rc
        self._flying = not self.on_ground
        self._controller.turn(self._controller.yaw_rad + radians(90.0) * rc.yaw * TICK_S, TICK_S)
        lean = radians(30.0)
        q = quaternion(rc.roll * lean, rc.pitch * lean, self._controller.yaw_rad)
        # Half throttle hovers, as with a learnt MOT_THST_HOVER.
        hover = MASS * GRAVITY
        top = 4 * MOTOR_MAX - hover
        thrust = (
            2 * rc.throttle * hover if rc.throttle < 0.5 else hover + (2 * rc.throttle - 1) * top
        )
        return np.array([*q, thrust])

    def _steer(self) -> Array:
        """Follow the carrot (or a velocity, or straight down), holding the heading target."""
        limits, position = self.limits, self.estimator.position
        if self._yaw_rate is not None:
            self._yaw_target = self._controller.yaw_rad + self._yaw_rate * TICK_S
        if self._yaw_target is not None:
            self._controller.turn(self._yaw_target, TICK_S)
        wanted: Vector
        feedforward: Vector = (0.0, 0.0, 0.0)
        if self._velocity_target is not None:
            wanted = self._velocity_target
            self._hold_here()
        else:
            carrot = self._carrot or Carrot(position, position)
            carrot.move(position, limits, TICK_S)
            feedforward = carrot.acceleration
            error = tuple(a - b for a, b in zip(carrot.position, position, strict=True))
            wanted = self._controller.velocity_for(
                (error[0], error[1], error[2]), carrot.velocity, limits
            )
        if self._landing:
            wanted = (wanted[0], wanted[1], self._landing_speed())
        roll, pitch, _ = euler(self.estimator.output[0:4])
        thrust = self._controller.thrust(
            wanted[2], self.estimator.velocity[2], cos(roll) * cos(pitch), TICK_S
        )
        if not self.estimator.position_valid and self.mode is Mode.LAND:
            # Without a position LAND keeps the vehicle level, and the wind takes it.
            return np.array([*quaternion(0.0, 0.0, self._controller.yaw_rad), thrust])
        lean = self._controller.horizontal(wanted, self.estimator.velocity, feedforward, TICK_S)
        return np.array([*self._controller.lean(lean, self._yaw), thrust])

    def _landing_speed(self) -> float:
        p = self.parameters
        height = self._home_ned()[2] - self.estimator.position[2]
        if height > _LAND_FINAL_HEIGHT:
            return (p["LAND_SPEED_HIGH"] or p["WPNAV_SPEED_DN"]) / 100.0
        return p["LAND_SPEED"] / 100.0

    def _arrived(self) -> bool:
        if self._carrot is None:
            return True
        end = self._carrot.end
        radius = self.parameters["WPNAV_RADIUS"] / 100.0
        gap = sum((a - b) ** 2 for a, b in zip(end, self.estimator.position, strict=True)) ** 0.5
        return self._carrot.arrived and gap < radius

    # --- return to launch --------------------------------------------------------------------

    def _begin_rtl(self) -> None:
        self._rtl = RtlStage.CLIMB
        north, east, down = self.estimator.position
        top = min(down, self._home_ned()[2] - self.parameters["RTL_ALT"] / 100.0)
        self._fly((north, east, top))

    def _run_rtl(self) -> None:
        if self._rtl is RtlStage.CLIMB and self._arrived():
            self._rtl = RtlStage.RETURN
            home = self._home_ned()
            self._fly((home[0], home[1], self.estimator.position[2]))
        elif self._rtl is RtlStage.RETURN and self._arrived():
            self._rtl, self._stage_since = RtlStage.LOITER, self._time
        elif (
            self._rtl is RtlStage.LOITER
            and self._time - self._stage_since >= self.parameters["RTL_LOIT_TIME"] / 1000.0
        ):
            self._rtl = RtlStage.LAND
            self._landing = True

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

    def _start_item(self, item: mis.MissionItem) -> None:
        origin, here = self.estimator.origin, self.estimator.location
        if origin is None or here is None or self.home is None:
            return
        self._stage_since = 0.0
        self.notify(INFO, f"Mission: {self.mission_index} {_NAMES[item.command]}")
        target = origin.ned_of(item.location(here, self.home))
        if item.command == mis.TAKEOFF:
            if self._flying:
                self._fly((*self.estimator.position[:2], target[2]))
            else:
                self._begin_takeoff(self._home_ned()[2] - target[2])
        elif item.command == mis.RTL:
            self._begin_rtl()
        elif item.command == mis.LAND:
            down = self.estimator.position[2]
            self._fly((target[0], target[1], down))
        else:
            self._fly(target)

    def _run_mission(self) -> None:
        if not 0 < self.mission_index < len(self.mission.items):
            return
        item = self.mission.items[self.mission_index]
        if item.command == mis.RTL:
            self._run_rtl()
            return
        if not self._arrived():
            return
        if item.command == mis.LAND:
            self._landing = True
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

    def _do(self, item: mis.MissionItem) -> None:
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
