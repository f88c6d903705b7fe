"""What is wrong with an installation that was calibrated, surveyed and timed with care."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from localizer.geometry.camera import Camera
from localizer.registration.calibration import CalibrationSigmas

# One standard deviation of each. Map: a survey tied to control points. Boresight, lever arm: set by
# hand. Late: frames stamped on arrival, less the latency that was measured once.
MAP_M = (0.2, 0.2, 0.3)
BORESIGHT_DEG = 0.5
ARM_M = 0.03
LATE_S = 0.010
SPEED_MPS = 15.0  # uniform up to it


@dataclass(frozen=True)
class LensSigmas:
    """One standard deviation of what a camera's numbers are off by: focal, share of the focal
    length; principal, per axis, share of the width; k1. stated: what the deployment says of it.
    """

    focal: float
    principal: float
    k1: float
    stated: CalibrationSigmas


# careful: what a board repeats to and what focus and temperature change afterwards, the corner of a
# picture of 1280 a pixel off; the deployment states nothing of it, so the localizer's defaults.
# calibrated: what `companion calibrate flight` was off by (0.087 % in fresh draws) and some drift.
# overstated: the same lens, whose deployment states the least that a calibration ever states.
LENSES = {
    "careful": LensSigmas(0.003, 0.002, 0.004, CalibrationSigmas()),
    "calibrated": LensSigmas(0.001, 0.0011, 0.003, CalibrationSigmas()),
    "overstated": LensSigmas(
        0.001, 0.0011, 0.003,
        CalibrationSigmas(focal_percent=0.05, principal_percent=0.05, distortion=0.001, stamp_ms=2),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class InstallationFault:
    """One installation's errors. focal: share by which the calibration is long; principal: (2,)
    shares of the width; map_m: east, north, up by which the map lies off; arm_m: the lever arm's
    error, boresight included, body axes turned any way; late_s: of the stamps; velocity: east,
    north, m/s.
    """

    focal: float
    principal: tuple[float, float]
    k1: float
    map_m: tuple[float, float, float]
    arm_m: tuple[float, float, float]
    late_s: float
    velocity: tuple[float, float]

    @property
    def beside_m(self) -> tuple[float, float, float]:
        """East, north, up of what is wrong beside the registration itself."""
        east, north, up = (m + a for m, a in zip(self.map_m, self.arm_m, strict=True))
        vx, vy = self.velocity
        return east - vx * self.late_s, north - vy * self.late_s, up

    def calibrated(self, camera: Camera) -> Camera:
        """The camera as the deployment has it, where `camera` is the true one."""
        k = camera.distortion
        width = camera.width
        return replace(
            camera,
            fx=camera.fx * (1.0 + self.focal),
            fy=camera.fy * (1.0 + self.focal),
            cx=camera.cx + self.principal[0] * width,
            cy=camera.cy + self.principal[1] * width,
            distortion=(k[0] + self.k1, *k[1:]),
        )


def drawn(rng: np.random.Generator, lens: LensSigmas) -> InstallationFault:
    """A fault."""
    share = float(rng.normal(0.0, lens.focal))
    x, y = (float(p) for p in rng.normal(0.0, lens.principal, 2))
    east, north, up = (float(m) for m in rng.normal(0.0, MAP_M))
    arm = rng.normal(0.0, ARM_M, 3) + np.radians(rng.normal(0.0, BORESIGHT_DEG, 3)) * 0.3
    speed, course = rng.uniform(0.0, SPEED_MPS), rng.uniform(0.0, 2.0 * np.pi)
    return InstallationFault(
        share,
        (x, y),
        float(rng.normal(0.0, lens.k1)),
        (east, north, up),
        (float(arm[0]), float(arm[1]), float(arm[2])),
        float(rng.normal(0.0, LATE_S)),
        (float(speed * np.sin(course)), float(speed * np.cos(course))),
    )
