"""The optimizer benchmark's problem: levels and hypotheses."""

from __future__ import annotations

import cv2
import numpy as np

from localizer.geometry.pose import so3_exp
from localizer.registration.backend import LevelProblem, sample_bilinear

HYPOTHESES, ANCHORS, CHANNELS = 144, 500, 32
SIZES = (128, 256, 512)
Poses = tuple[np.ndarray, np.ndarray]


def make_problem(size: int, channels: int = CHANNELS) -> LevelProblem:
    """Smooth random unit features; anchors at 80 to 160 m; the truth is the identity rotation."""
    rng = np.random.default_rng(size)
    f = smooth_features(rng, size, channels)
    uv = rng.uniform(0.05 * size, 0.95 * size, (ANCHORS, 2))
    # Morton-like order: the anchors of a real view come sorted along the Z curve.
    cell = (uv * 32 / size).astype(int)
    code = sum(((cell[:, i] >> b) & 1) << (2 * b + i) for b in range(5) for i in (0, 1))
    uv = uv[np.argsort(code)]
    depth = rng.uniform(80, 160, ANCHORS)
    focal, centre = float(size), (size / 2 - 0.5, size / 2 - 0.5)
    points = np.column_stack([(uv - centre) / focal * depth[:, None], depth])
    points[:, 2] -= 110.0
    return LevelProblem(
        f,
        rng.uniform(0.3, 1, (size, size)).astype(np.float32),
        (focal, focal),
        centre,
        np.ascontiguousarray(points.T, dtype=np.float32),
        sample_bilinear(f, uv[:, 0], uv[:, 1]).astype(np.float32),
        rng.uniform(0.3, 1, ANCHORS).astype(np.float32),
    )


def smooth_features(rng: np.random.Generator, size: int, channels: int) -> np.ndarray:
    """Unit features (size, size, C) with structure of four pixels."""
    coarse = rng.standard_normal((channels, size // 4, size // 4)).astype(np.float32)
    f = np.dstack([cv2.resize(c, (size, size), interpolation=cv2.INTER_CUBIC) for c in coarse])
    return np.ascontiguousarray(f / (np.linalg.norm(f, axis=-1, keepdims=True) + 1e-6))


def make_swarm() -> Poses:
    """The paper's box of rotations about the camera and N(0, 1 m)."""
    rng, count = np.random.default_rng(0), HYPOTHESES
    turns = np.radians(np.column_stack([rng.uniform(-11, 11, (count, 2)), rng.normal(0, 1, count)]))
    rotations = np.stack([so3_exp(t) for t in turns])
    # The camera turns about its own centre, 110 m above the local origin.
    return rotations, rotations @ np.array([0.0, 0.0, 110.0]) + rng.normal(0, 1, (count, 3))
