"""Guidance: follow a straight leg, descend, hold a heading."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import atan2, cos, hypot

import numpy as np

from sitl.embedded.control.controller import ControlLimits, PositionController, SetPoint, Vector
from sitl.embedded.ekf.estimator import Estimator
from sitl.embedded.parameters import Parameters
from sitl.embedded.physics.dynamics import TICK_S
from sitl.embedded.physics.rotation import Array, euler, quaternion

_LAND_FINAL_HEIGHT = 10.0  # m; below it LAND_SPEED


@dataclass
class Guidance:
    """Computes attitude and thrust that lead the vehicle to its target.

    Positions are NED metres from the EKF origin; speeds m/s; angles radians. set_point: None before
    take-off. speed_override: replaces WPNAV_SPEED; None: no override. yaw_target: heading to turn
    to; None: keep the heading. landing: descend. returning: use RTL_SPEED.
    """

    parameters: Parameters
    estimator: Estimator
    controller: PositionController = field(default_factory=PositionController)
    set_point: SetPoint | None = None
    speed_override: float | None = None
    yaw_target: float | None = None
    landing: bool = False
    returning: bool = False

    @property
    def yaw(self) -> float:
        """The estimated heading."""
        return euler(self.estimator.output[0:4])[2]

    @property
    def limits(self) -> ControlLimits:
        """Speeds and accelerations of the present mode."""
        p = self.parameters
        speed = self.speed_override or p["WPNAV_SPEED"] / 100.0
        if self.returning and p["RTL_SPEED"] > 0:
            speed = p["RTL_SPEED"] / 100.0
        return ControlLimits(
            speed,
            p["WPNAV_SPEED_UP"] / 100.0,
            p["WPNAV_SPEED_DN"] / 100.0,
            p["WPNAV_ACCEL"] / 100.0,
            p["WPNAV_ACCEL_Z"] / 100.0,
        )

    def reset(self) -> None:
        """Clear the controller's integrators and hold the present heading."""
        self.controller.reset(self.yaw)

    def hold_here(self) -> None:
        """Stay where the vehicle is."""
        here = self.estimator.position
        self.set_point = SetPoint(here, here)

    def climb(self, down: float) -> None:
        """Fly straight up (or down) to `down`, NED metres, with a fresh controller."""
        self.reset()
        north, east, here = self.estimator.position
        self.set_point = SetPoint((north, east, here), (north, east, down))
        self.yaw_target = self.yaw

    def fly(self, target: Vector) -> None:
        """Follow a straight leg to `target`, NED metres. The leg starts at the present set point,
        or at the vehicle if that set point is 20 m away or more. Nothing changes if the present leg
        ends at `target`; a landing goes on. The heading turns to the leg's if WP_YAW_BEHAVIOR wants
        it.
        """
        old, here = self.set_point, self.estimator.position
        if old is not None and old.end == target:
            return
        start, speed = here, 0.0
        if old is not None and hypot(old.position[0] - here[0], old.position[1] - here[1]) < 20.0:
            start = old.position
            way = [t - s for t, s in zip(target, start, strict=True)]
            length = max(sum(w * w for w in way) ** 0.5, 1e-6)
            speed = sum(v * w for v, w in zip(old.velocity, way, strict=True)) / length
        self.set_point = SetPoint(start, target, max(speed, 0.0))
        north, east = target[0] - start[0], target[1] - start[1]
        behavior = int(self.parameters["WP_YAW_BEHAVIOR"])
        follows = behavior == 1 or (behavior == 2 and not self.returning)
        if follows and hypot(north, east) > 2.0:
            self.yaw_target = atan2(east, north)

    def arrived(self) -> bool:
        """Whether set point and vehicle (WPNAV_RADIUS) are at the leg's end; True without a leg."""
        if self.set_point is None:
            return True
        end = self.set_point.end
        radius = self.parameters["WPNAV_RADIUS"] / 100.0
        gap = sum((a - b) ** 2 for a, b in zip(end, self.estimator.position, strict=True)) ** 0.5
        return self.set_point.arrived and gap < radius

    def steer(self, home_down: float, *, level_when_lost: bool) -> Array:
        """Attitude quaternion and total thrust (5,) for the next tick, called once in it. They
        follow the set point, which moves on (in a landing: descend), and hold the heading target.

        home_down: NED down coordinate of home, m. level_when_lost: without a valid position, stay
        level and drift with the wind.
        """
        limits, position = self.limits, self.estimator.position
        if self.yaw_target is not None:
            self.controller.turn(self.yaw_target, TICK_S)
        set_point = self.set_point or SetPoint(position, position)
        set_point.move(position, limits, TICK_S)
        error = tuple(a - b for a, b in zip(set_point.position, position, strict=True))
        wanted = self.controller.velocity_for(
            (error[0], error[1], error[2]), set_point.velocity, limits
        )
        if self.landing:
            wanted = (wanted[0], wanted[1], self._landing_speed(home_down))
        roll, pitch, _ = euler(self.estimator.output[0:4])
        thrust = self.controller.thrust(
            wanted[2], self.estimator.velocity[2], cos(roll) * cos(pitch), TICK_S
        )
        if not self.estimator.position_valid and level_when_lost:
            return np.array([*quaternion(0.0, 0.0, self.controller.yaw_rad), thrust])
        lean = self.controller.horizontal(
            wanted, self.estimator.velocity, set_point.acceleration, TICK_S
        )
        return np.array([*self.controller.lean(lean, self.yaw), thrust])

    def _landing_speed(self, home_down: float) -> float:
        p = self.parameters
        height = home_down - self.estimator.position[2]
        if height > _LAND_FINAL_HEIGHT:
            return (p["LAND_SPEED_HIGH"] or p["WPNAV_SPEED_DN"]) / 100.0
        return p["LAND_SPEED"] / 100.0
