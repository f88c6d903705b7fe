"""A scenario's flight over a known surface: poses as they are and as they are told, and pixels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose, so3_exp
from localizer.targets.locate import RayCaster, ray_in_world
from localizer.targets.track import pixel_of
from localizer.types import PoseEstimate, RegistrationStatus, TrackingState
from sitl.demo.scenario import Scenario

_TOLERANCE = 0.02  # of the distance: as `sitl.camera.detector`, an operator looks past an edge
_MARGIN_PX = 6.0
_EDGE_PX = 4.0  # around an edge's pixel the depth leaps within this
_EDGE_M = 2.0
_RING = np.array([[np.cos(a), np.sin(a)] for a in np.arange(8) * np.pi / 4])


@dataclass(frozen=True)
class PoseErrors:
    """One sigma of what the told poses err by, per axis; wandering with `tau_s`, as registrations
    of neighbouring views err alike. bias_m: of the whole flight, east and north (a shifted map).
    """

    position_m: float = 0.06
    rotation_deg: float = 0.025
    tau_s: float = 2.0
    bias_m: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class FlightStep:
    """One frame: the pose as it is, and the estimate that is told of it."""

    true: PoseEstimate
    told: PoseEstimate


@dataclass(frozen=True)
class Thing:
    """What is looked at. kind: flat, edge or car; positions, velocities: by step, (S, 3)."""

    name: str
    kind: str
    positions: Array
    velocities: Array


def heights_of(scenario: Scenario, height_m: float) -> Scenario:
    """The same legs, all of them at one height above home."""
    legs = tuple(leg.model_copy(update={"height_m": height_m}) for leg in scenario.legs)
    return scenario.model_copy(update={"takeoff_height_m": height_m, "legs": legs})


def steps(
    path: list[tuple[int, Pose]], camera: Camera, errors: PoseErrors, rng: np.random.Generator
) -> list[FlightStep]:
    """Every pose of the path with what a localizer tells of it."""
    sigma = np.repeat([errors.position_m, np.radians(errors.rotation_deg)], 3)
    wander, last_ns = rng.normal(0, sigma), path[0][0]
    made = []
    for time_ns, pose in path:
        keep = float(np.exp(-(time_ns - last_ns) * 1e-9 / errors.tau_s))
        wander = keep * wander + np.sqrt(1 - keep**2) * rng.normal(0, sigma)
        last_ns = time_ns
        off = np.array([*errors.bias_m, 0.0])
        told = Pose(so3_exp(wander[3:]) @ pose.rotation, pose.translation + wander[:3] + off)
        true = PoseEstimate(
            pose, np.diag(sigma**2), 1.0, TrackingState.TRACKING, RegistrationStatus.OK, True,
            time_ns, 0, camera,
        )  # fmt: skip
        made.append(FlightStep(true, replace(true, world_from_camera=told)))
    return made


def standing(
    flown: list[FlightStep], cast: RayCaster, count: int, rng: np.random.Generator
) -> Iterator[Thing]:
    """`count` places on plain surfaces and as many at edges, spread over the way."""
    wanted = {"flat": count, "edge": count}
    for k in range(200 * count):
        if not any(wanted.values()):
            return
        step = flown[int(rng.integers(len(flown) * 8 // 10))].true
        size = np.array([step.camera.width, step.camera.height])
        pixel = (0.1 + 0.8 * rng.random(2)) * size
        around = [*(pixel + _EDGE_PX * _RING), pixel]
        eye = step.world_from_camera.translation
        rays = np.array([ray_in_world(step, (float(u), float(v)))[1] for u, v in around])
        distances = cast(eye, rays).distances
        if not np.isfinite(distances).all():
            continue
        leap = float(np.diff(np.sort(distances)).max())
        kind = "edge" if leap > _EDGE_M else "flat" if leap < 0.3 * _EDGE_M else ""
        if not wanted.get(kind):
            continue
        wanted[kind] -= 1
        place = eye + rays[-1] * distances[-1]
        still = np.zeros((len(flown), 3))
        yield Thing(f"{kind} {k}", kind, still + place, still)


def sightings(
    thing: Thing,
    flown: list[FlightStep],
    cast: RayCaster,
    noise_px: float,
    rng: np.random.Generator,
) -> Iterator[tuple[int, tuple[float, float]]]:
    """(step, pixel with noise) wherever a viewer would say that it is in sight."""
    for k, step in enumerate(flown):
        pixel = pixel_of(step.true, thing.positions[k])
        if pixel is None:
            continue
        size = (step.true.camera.width, step.true.camera.height)
        if not all(_MARGIN_PX < p < s - _MARGIN_PX for p, s in zip(pixel, size, strict=True)):
            continue
        eye = step.true.world_from_camera.translation
        away = thing.positions[k] - eye
        distance = float(np.linalg.norm(away))
        first = float(cast(eye, away[None] / distance).distances[0])
        if np.isfinite(first) and distance > first * (1 + _TOLERANCE) + 0.5:
            continue
        u, v = np.array(pixel) + rng.normal(0.0, noise_px, 2)
        yield k, (float(u), float(v))
