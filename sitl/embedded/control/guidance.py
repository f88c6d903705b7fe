"""Guidance: follow a straight leg, descend, hold a heading."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import atan2, cos, hypot

import numpy as np

from sitl.embedded.control.controller import Carrot, ControlLimits, PositionController, Vector
from sitl.embedded.ekf.estimator import Estimator
from sitl.embedded.parameters import Parameters
from sitl.embedded.physics.dynamics import TICK_S
from sitl.embedded.physics.rotation import Array, euler, quaternion

_LAND_FINAL_HEIGHT = 10.0  # m; below it LAND_SPEED


@dataclass
class Guidance:
    """Target of the vehicle, and the attitude and thrust that lead to it.

    returning: RTL's speed and heading hold. NED metres about the EKF origin, m/s, radians.
    """

    parameters: Parameters
    estimator: Estimator
    controller: PositionController = field(default_factory=PositionController)
    carrot: Carrot | None = None
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
        """Forget the controller's history and hold the heading."""
        self.controller.reset(self.yaw)

    def hold_here(self) -> None:
        """Stay where the vehicle is."""
        here = self.estimator.position
        self.carrot = Carrot(here, here)

    def climb(self, down: float) -> None:
        """Straight up, with a fresh controller, to a NED down."""
        self.reset()
        north, east, here = self.estimator.position
        self.carrot = Carrot((north, east, here), (north, east, down))
        self.yaw_target = self.yaw

    def fly(self, target: Vector) -> None:
        """Follow a straight leg to a target, NED metres, starting at the last set point."""
        old, here = self.carrot, self.estimator.position
        if old is not None and old.end == target:
            return
        start, speed = here, 0.0
        if old is not None and hypot(old.position[0] - here[0], old.position[1] - here[1]) < 20.0:
            start = old.position
            way = [t - s for t, s in zip(target, start, strict=True)]
            length = max(sum(w * w for w in way) ** 0.5, 1e-6)
            speed = sum(v * w for v, w in zip(old.velocity, way, strict=True)) / length
        self.carrot = Carrot(start, target, max(speed, 0.0))
        north, east = target[0] - start[0], target[1] - start[1]
        behavior = int(self.parameters["WP_YAW_BEHAVIOR"])
        follows = behavior == 1 or (behavior == 2 and not self.returning)
        if follows and hypot(north, east) > 2.0:
            self.yaw_target = atan2(east, north)

    def arrived(self) -> bool:
        """Whether the vehicle is within the waypoint radius of the leg's end."""
        if self.carrot is None:
            return True
        end = self.carrot.end
        radius = self.parameters["WPNAV_RADIUS"] / 100.0
        gap = sum((a - b) ** 2 for a, b in zip(end, self.estimator.position, strict=True)) ** 0.5
        return self.carrot.arrived and gap < radius

    def steer(self, home_down: float, *, level_when_lost: bool) -> Array:
        """Attitude quaternion and thrust (5,) that follow the set point (or descend) and hold the
        heading target. home_down: height of home, NED metres; level_when_lost: without a position
        stay level and drift with the wind.
        """
        limits, position = self.limits, self.estimator.position
        if self.yaw_target is not None:
            self.controller.turn(self.yaw_target, TICK_S)
        carrot = self.carrot or Carrot(position, position)
        carrot.move(position, limits, TICK_S)
        error = tuple(a - b for a, b in zip(carrot.position, position, strict=True))
        wanted = self.controller.velocity_for(
            (error[0], error[1], error[2]), carrot.velocity, limits
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
            wanted, self.estimator.velocity, carrot.acceleration, TICK_S
        )
        return np.array([*self.controller.lean(lean, self.yaw), thrust])

    def _landing_speed(self, home_down: float) -> float:
        p = self.parameters
        height = home_down - self.estimator.position[2]
        if height > _LAND_FINAL_HEIGHT:
            return (p["LAND_SPEED_HIGH"] or p["WPNAV_SPEED_DN"]) / 100.0
        return p["LAND_SPEED"] / 100.0
