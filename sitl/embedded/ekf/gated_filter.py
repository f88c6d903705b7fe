"""Measurement updates of the EKF with innovation gates and resets, as in EKF3.

A measurement inside its gate is fused. One outside is rejected until a timeout allows a reset to
it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sitl.embedded.ekf import navigation as nav
from sitl.embedded.parameters import Parameters
from sitl.embedded.physics.rotation import euler, rotate_world, wrap_pi


@dataclass
class TestRatios:
    """Squared ratio of innovation to gate; below 1 a measurement is inside the gate."""

    velocity: float = 0.0
    position: float = 0.0
    height: float = 0.0
    yaw: float = 0.0


@dataclass
class FilterClock:
    """Times of the last events, ms since boot; -1,000,000: never."""

    position_pass: int = -1_000_000
    velocity_pass: int = -1_000_000
    gps_received: int = -1_000_000
    gps_bad: int = 0
    external_stamp: int = -1_000_000
    external_velocity_stamp: int = -1_000_000
    external_received: int = -1_000_000
    position_delta: int = -1_000_000
    innovation_pass: int = 0
    innovation_fail: int = -1_000_000


class GatedFilter:
    """State and covariance with gated updates. Times are ms since boot.

    state: nominal state (16,), cov: (15, 15), see `navigation`, at the delayed time horizon.
    now_ms: the present. position_timeout, velocity_timeout: whether no measurement was inside the
    gate for so long that the next one resets the state.
    """

    def __init__(self, parameters: Parameters) -> None:
        self.parameters = parameters
        self.ratios = TestRatios()
        self.state = np.zeros(nav.NOMINAL_SIZE)
        self.state[nav.Q] = 1.0
        self.cov = np.diag(
            np.repeat([0.02**2, 0.5**2, 0.5**2, 0.005**2, 0.05**2], 3).astype(np.float64)
        )
        self.now_ms = 0
        self.clock = FilterClock()
        self.position_timeout = True
        self.velocity_timeout = True
        self.velocity_aiding = False
        self.innovations_good = True
        self.gps_fix_good = False
        self.source_reset = False
        self.yaw_reset = False

    def fuse_position(
        self,
        position: tuple[float, float],
        sigma: float,
        velocity: tuple[float, float] | None,
    ) -> None:
        """Fuse a position (north, east; m from the origin; sigma m) if it is inside the gate; after
        a timeout, reset the position to it instead. velocity: (north, east) m/s for that reset;
        None: not measured. Sets `ratios.position` and the time of the last pass.
        """
        p = self.parameters
        innovation = [position[i] - float(self.state[nav.P + i]) for i in range(2)]
        variance = self.cov[6, 6] + self.cov[7, 7]
        gate = max(0.01 * p["EK3_POS_I_GATE"], 1.0) ** 2
        ratio = (innovation[0] ** 2 + innovation[1] ** 2) / (gate * (variance + 2 * sigma**2))
        self.ratios.position = ratio
        passed = ratio < 1.0
        if passed:
            self.clock.position_pass = self.now_ms
        if not (passed or self.position_timeout):
            return
        radius = p["EK3_GLITCH_RAD"]
        lost = self.position_timeout or variance > radius**2
        if lost and (not self.velocity_aiding or self.gps_fix_good):
            self.reset_position(*position, (0.5 * radius) ** 2)
            self.position_timeout = False
            self.clock.position_pass = self.now_ms
            self.ratios.position = 0.0
            if self.velocity_timeout:
                self.reset_velocity(velocity or (0.0, 0.0), 0.5**2 if velocity else 25.0**2)
            return
        for i in range(2):
            residual = position[i] - self.state[nav.P + i]
            nav.fuse(self.state, self.cov, 6 + i, residual, sigma**2)

    def fuse_velocity(
        self,
        horizontal: tuple[float, float],
        vertical: float | None,
        sigma: float,
        gate_sigma: float,
    ) -> None:
        """Fuse north, east and (unless None) down velocity, m/s, if it is inside the gate; after a
        timeout, reset the horizontal velocity to it instead. sigma: of the measurement, gate_sigma:
        for the gate, both m/s. Sets `ratios.velocity` and the time of the last pass.
        """
        observed = [*horizontal] if vertical is None else [*horizontal, vertical]
        squared, variance = 0.0, 0.0
        for i, value in enumerate(observed):
            squared += (value - float(self.state[nav.V + i])) ** 2
            variance += self.cov[3 + i, 3 + i] + gate_sigma**2
        gate = max(0.01 * self.parameters["EK3_VEL_I_GATE"], 1.0) ** 2
        self.ratios.velocity = squared / (gate * variance)
        passed = self.ratios.velocity < 1.0
        if passed:
            self.clock.velocity_pass = self.now_ms
        elif self.velocity_timeout:
            self.reset_velocity(horizontal, sigma**2)
            self.ratios.velocity = 0.0
            return
        else:
            return
        for i, value in enumerate(observed):
            nav.fuse(self.state, self.cov, 3 + i, value - self.state[nav.V + i], sigma**2)

    def fuse_height(self, height: float, sigma: float) -> None:
        """Fuse a height above the origin (m, sigma m) if it is inside the gate. Sets
        `ratios.height`.
        """
        innovation = -height - float(self.state[nav.P + 2])
        variance = self.cov[8, 8] + sigma**2
        gate = max(0.01 * self.parameters["EK3_HGT_I_GATE"], 1.0) ** 2
        self.ratios.height = innovation**2 / (gate * variance)
        if self.ratios.height < 1.0:
            nav.fuse(self.state, self.cov, 8, innovation, sigma**2)

    def fuse_yaw(self, yaw_rad: float, sigma: float) -> None:
        """Fuse a heading (radians clockwise from true north, sigma rad) if it is inside the gate.
        Sets `ratios.yaw`.
        """
        innovation = wrap_pi(yaw_rad - euler(self.state[nav.Q : nav.Q + 4])[2])
        variance = self.cov[2, 2] + sigma**2
        gate = max(0.01 * self.parameters["EK3_YAW_I_GATE"], 1.0) ** 2
        self.ratios.yaw = innovation**2 / (gate * variance)
        if self.ratios.yaw < 1.0:
            nav.fuse(self.state, self.cov, 2, innovation, sigma**2)

    def rotate_to(self, yaw_rad: float, sigma: float) -> None:
        """Reset the heading to yaw_rad (clockwise from true north) with the given sigma (rad). Roll
        and pitch stay; a requested yaw reset is done.
        """
        self.yaw_reset = False
        change = wrap_pi(yaw_rad - euler(self.state[nav.Q : nav.Q + 4])[2])
        rotate_world(self.state[nav.Q : nav.Q + 4], 0.0, 0.0, change)
        nav.reset_error(self.cov, 2, 1, sigma**2)

    def reset_position(self, north: float, east: float, variance: float | None) -> None:
        """Set north and east, m. variance None keeps the covariance (EKF3's announced reset)."""
        self.source_reset = False
        self.state[nav.P : nav.P + 2] = (north, east)
        if variance is not None:
            nav.reset_error(self.cov, 6, 2, variance)
            self.clock.position_pass = self.now_ms
            self.position_timeout = False

    def reset_velocity(self, horizontal: tuple[float, float], variance: float) -> None:
        """Set the horizontal velocity (north, east m/s) and its variance."""
        self.state[nav.V : nav.V + 2] = horizontal
        nav.reset_error(self.cov, 3, 2, variance)
        self.velocity_timeout = False
        self.clock.velocity_pass = self.now_ms

    def update_innovation_status(self) -> None:
        """Update `innovations_good`: False after 1 s in which position or velocity was outside the
        gate, True again after 10 s with both inside.
        """
        clock, now = self.clock, self.now_ms
        if self.ratios.position < 1.0 and self.ratios.velocity < 1.0:
            clock.innovation_pass = now
        else:
            clock.innovation_fail = now
        if now - clock.innovation_pass > 1000:
            self.innovations_good = False
        elif now - clock.innovation_fail > 10000:
            self.innovations_good = True
