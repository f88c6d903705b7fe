"""Stretches of flight over a map: true poses, what the sensors say, and what the camera sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from localizer.geometry.camera import Camera
from localizer.geometry.geo import level_camera
from localizer.geometry.pose import Array, Pose, so3_exp
from localizer.registration.priors import (
    PoseConstraint,
    attitude_constraint,
    combine,
    height_constraint,
)

_TURN_RAD_S = float(np.radians(10.0))
_WOBBLE_DEG = 2.5
TILT_SIGMA, HEADING_SIGMA, HEIGHT_SIGMA = float(np.radians(0.4)), float(np.radians(3.0)), 0.5


@dataclass(frozen=True)
class TestStretch:
    """A flight of constant speed. poses: world_from_camera, true; times_s from 0 on; sensed: the
    barometer's height and the attitude by autopilot and gimbal, with their errors.
    """

    seed: int
    condition: str
    poses: tuple[Pose, ...]
    times_s: Array
    sensed: tuple[PoseConstraint, ...]
    velocity: Array

    def flown_m(self, k: int) -> float:
        """Length of the way up to pose k."""
        places = np.array([pose.translation for pose in self.poses[: k + 1]])
        return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


@dataclass(frozen=True)
class StretchPlan:
    """What the stretches of a run have in common. half_m: of the area, east and north."""

    seconds: float
    rate_hz: float
    speed_m_s: float
    height_m: float
    half_m: tuple[float, float]


def make_stretch(plan: StretchPlan, condition: str, seed: int, ground_m: float) -> TestStretch:
    """Begins anywhere in the area, at `height_m` above `ground_m`, and turns back at its edge."""
    rng = np.random.default_rng((seed, 1))
    count = round(plan.seconds * plan.rate_hz) + 1
    times = np.arange(count) / plan.rate_hz
    place, heading = start(plan, seed)
    down = rng.uniform(60, 90)
    phase = rng.uniform(0, 2 * np.pi, 4)
    poses = []
    for t in times:
        swing = _WOBBLE_DEG * np.sin(np.array([0.7, 0.5]) * t + phase[:2])
        height = ground_m + plan.height_m + 2.0 * np.sin(0.15 * t + phase[2])
        level = level_camera(
            np.array([*place, height]), heading, -float(np.radians(down + swing[0]))
        )
        rolled = level.rotation @ so3_exp([0, 0, np.radians(swing[1])])
        poses.append(Pose(rolled, level.translation))
        heading += _steer(place, heading, plan.half_m, 0.02 * np.sin(0.1 * t + phase[3])) / (
            plan.rate_hz
        )
        place = place + plan.speed_m_s / plan.rate_hz * np.array([np.sin(heading), np.cos(heading)])
    velocity = (poses[1].translation - poses[0].translation) * plan.rate_hz
    return TestStretch(seed, condition, tuple(poses), times, _sensed(poses, times, rng), velocity)


def start(plan: StretchPlan, seed: int) -> tuple[Array, float]:
    """East and north (2,) where a stretch begins, and its first heading in radians."""
    rng = np.random.default_rng((seed, 0))
    place = rng.uniform(-1, 1, 2) * np.array(plan.half_m)
    return place, float(rng.uniform(0, 2 * np.pi))


def _steer(place: Array, heading: float, half: tuple[float, float], drift: float) -> float:
    """Turn rate, rad/s: towards the middle where the area ends."""
    if np.all(np.abs(place) <= np.array(half)):
        return drift
    home = np.arctan2(-place[0], -place[1])
    off = (home - heading + np.pi) % (2 * np.pi) - np.pi
    return float(np.clip(off, -_TURN_RAD_S, _TURN_RAD_S))


def _sensed(
    poses: list[Pose], times: Array, rng: np.random.Generator
) -> tuple[PoseConstraint, ...]:
    """What the sensors say, with errors (1 sigma each): the camera's pitch and yaw 0.5 degrees and
    a wander of 0.3, the compass 3 and 1; the barometer 2 m, in a minute 0.3 m more, noise 0.15 m.
    """
    steps = len(poses)
    per_step = np.sqrt(np.diff(times, prepend=times[0]) / 60.0)
    baro = 2.0 * rng.normal() + 0.3 * np.cumsum(rng.normal(size=steps) * per_step)
    fixed = np.radians(rng.normal(0, [0.5, 0.5, 3.0]))
    phase = rng.uniform(0, 2 * np.pi, 3)
    sensed = []
    for k, pose in enumerate(poses):
        wander = np.radians([0.3, 0.3, 1.0]) * np.sqrt(2) * np.sin(0.11 * times[k] + phase)
        off = fixed + wander
        rotation = so3_exp([0, 0, off[2]]) @ pose.rotation @ so3_exp([off[0], off[1], 0])
        attitude = attitude_constraint(rotation, TILT_SIGMA, HEADING_SIGMA)
        height = pose.translation[2] + baro[k] + rng.normal(0, 0.15)
        sensed.append(combine(attitude, height_constraint(float(height), HEIGHT_SIGMA)))
    return tuple(sensed)


def working_pinhole(width: int) -> Camera:
    """4:3 and 65 degrees wide."""
    return Camera.from_fov(width, width * 3 // 4, 65.0)
