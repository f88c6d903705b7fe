"""Curvature of the cost at the best pose (equation 11a), computed on the device."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from localizer.geometry.pose import Array
from localizer.registration.backend import LevelProblem, LMSettings
from localizer.registration.covariance import curvature_ratio, curvature_steps, mean_motion
from localizer.registration.cpu.reference import in_view, project, projection_jacobian, retractions
from localizer.registration.cuda import layout
from localizer.registration.cuda.backend import CudaBackend
from localizer.registration.cuda.memory import PROBES, FrameMemory
from localizer.registration.cuda.steps import KernelLaunch
from localizer.types import Float32


def level_without_features(
    points: Float32,
    focal: tuple[float, float],
    centre: tuple[float, float],
    shape: tuple[int, ...],
) -> LevelProblem:
    """A level with (h, w) and points (3, N) in the local frame, without features."""
    none = np.zeros((0, 0, 0), np.float32)
    blank = np.broadcast_to(np.float32(0), shape)
    return LevelProblem(none, blank, focal, centre, points, none, none)


def winner_motion(problem: LevelProblem, rotation: Array, translation: Array) -> Array:
    """`CovarianceSums.motion` of a level's geometry at a pose camera_from_local."""
    x, uv = project(problem, rotation, translation)
    visible = in_view(problem, x, uv)
    return mean_motion(projection_jacobian(problem, x[visible], translation))


def winner_curvature(  # noqa: PLR0913
    backend: CudaBackend,
    memory: FrameMemory,
    scoring: KernelLaunch,
    channels: int,
    pose: tuple[Array, Array],
    motion: Array,
    hessian: Array,
    distance_px: float,
) -> float:
    """Curvature ratio (equation 11a) at a pose camera_from_local (rotation, translation). scoring:
    the launch that scores `memory.probes`. The caller holds the backend's lock.
    """
    device, steps = backend.device, curvature_steps(motion, distance_px)
    rotations, translations = retractions(*pose, steps)
    state = np.zeros((), dtype=layout.STATE)
    state["count"] = PROBES
    for address, values in (
        (int(memory.probes["rotations"]), np.ascontiguousarray(rotations)),
        (int(memory.probes["translations"]), np.ascontiguousarray(translations)),
        (memory.probe_state, state),
    ):
        device.upload(address, values)
    arguments = scoring.arguments.copy()
    arguments["state"] = memory.probe_state
    backend.kernels(channels).launch(scoring.kernel, PROBES, scoring.threads, arguments)
    scores = np.empty(PROBES)
    device.download(scores, int(memory.probes["scores"]))
    device.synchronize()
    return curvature_ratio(scores, steps, hessian)


def last_settings(settings: LMSettings, scale: float) -> LMSettings:
    """Loss of the final refinement steps; scale: 0 without sharpening."""
    return replace(settings, scale=scale, redescending=True) if scale > 0 else settings
