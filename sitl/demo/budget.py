"""Draws the calibration and map errors of one flight from the ranges in its scenario."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from localizer.geometry.camera import Camera
from sitl.camera.detector import DetectorErrors
from sitl.camera.realism import CameraRealism
from sitl.demo.scenario import Scenario


@dataclass(frozen=True)
class FlightErrors:
    """True values that differ from the deployment file.

    camera: the true intrinsics. lever_arm_m: the camera's true position, body axes (the file says
    zero). map_shift_m: offset of the map from the world (east, north, up).
    """

    camera: Camera
    lever_arm_m: tuple[float, float, float]
    map_shift_m: tuple[float, float, float]
    realism: CameraRealism
    detector: DetectorErrors


def draw_errors(scenario: Scenario, seed: int) -> FlightErrors:
    """Draw the errors of a flight from its scenario's standard deviations. Each error has its own
    random generator, so that disabling one does not change the others.
    """
    spec, nominal = scenario.errors, scenario.camera.camera()

    def normal(key: int, count: int) -> np.ndarray:
        return np.random.default_rng([seed, 41, key]).normal(size=count)

    c = scenario.camera
    rolls = c.readout_ms > 0
    readout_ms = max(c.readout_ms + spec.readout_ms * float(normal(6, 1)[0]), 0.0) if rolls else 0.0
    scale = 1.0 + 0.01 * spec.focal_percent * float(normal(0, 1)[0])
    principal = spec.principal_px * normal(1, 2)
    bend = spec.distortion * normal(2, 5) * (1.0, 1.0, 0.1, 0.1, 0.0)
    k1, k2, p1, p2, k3 = (float(x) for x in np.asarray(nominal.distortion) + bend)
    camera = Camera(
        nominal.width, nominal.height, nominal.fx * scale, nominal.fy * scale,
        nominal.cx + float(principal[0]), nominal.cy + float(principal[1]), (k1, k2, p1, p2, k3),
        readout_ms,
    )  # fmt: skip
    rng = np.random.default_rng([seed, 41, 4])
    away, bearing = rng.uniform(*spec.map_shift_m), rng.uniform(0, 2 * np.pi)
    up = spec.map_shift_up_m * float(rng.normal())
    arm = spec.lever_arm_m * normal(3, 3)
    realism = CameraRealism(
        readout_ms, c.vibration_deg, c.auto_exposure, c.supersample, c.packet_loss,
        spec.stamp_offset_ms * float(normal(5, 1)[0]), spec.stamp_jitter_ms,
    )  # fmt: skip
    detector = DetectorErrors(
        spec.detector_px, spec.detector_missed, spec.detector_false, spec.detector_swapped,
        spec.detector_box_centre,
    )  # fmt: skip
    return FlightErrors(
        camera,
        (float(arm[0]), float(arm[1]), float(arm[2])),
        (float(away * np.sin(bearing)), float(away * np.cos(bearing)), up),
        realism,
        detector,
    )
