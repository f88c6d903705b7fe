"""Legs over a generated world, and the poses along them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from localizer.geometry.camera import Camera
from localizer.geometry.geo import level_camera
from localizer.geometry.pose import Array, Pose
from localizer.synth.appearance.model import CONDITIONS

LENGTH_M = 80.0
FORECASTS, PICTURES = 3, 6  # along a leg; each forecast stands for PICTURES / FORECASTS pictures
_HEIGHTS_M, _PITCHES_DEG = (30.0, 260.0), (-90.0, -35.0)
_REACH = 0.45  # of the world's side: some views leave the map
_CAMERA = Camera.from_fov(1280, 720, 65.0)


@dataclass(frozen=True)
class TestLeg:
    """A straight way at one height. start: (3,) ENU; height_m: above the ground at its start."""

    number: int
    condition: str
    start: Array
    heading_deg: float
    height_m: float
    pitch_deg: float
    camera: Camera

    def poses(self, count: int) -> list[Pose]:
        """World poses of the camera at the middles of so many equal parts."""
        yaw, pitch = np.radians([self.heading_deg, self.pitch_deg])
        along = np.array([np.sin(yaw), np.cos(yaw), 0.0])
        steps = (np.arange(count) + 0.5) * LENGTH_M / count
        return [level_camera(self.start + s * along, float(yaw), float(pitch)) for s in steps]


def draw_legs(
    seed: int, size_m: float, count: int, ground: Callable[[float, float], float]
) -> list[TestLeg]:
    """The legs of a world; ground: height (m) of its terrain at east and north."""
    rng = np.random.default_rng((83, seed))
    legs = []
    for number in range(count):
        east, north = rng.uniform(-_REACH, _REACH, 2) * size_m
        height = float(np.exp(rng.uniform(*np.log(_HEIGHTS_M))))
        half = 0.49 * size_m
        low = ground(*np.clip([east, north], -half, half))
        legs.append(
            TestLeg(
                number,
                CONDITIONS[number % len(CONDITIONS)],
                np.array([east, north, low + height]),
                float(rng.uniform(0, 360)),
                height,
                float(rng.uniform(*_PITCHES_DEG)),
                _CAMERA,
            )
        )
    return legs
