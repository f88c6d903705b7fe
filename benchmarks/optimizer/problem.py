"""The optimizer benchmark's problem: levels, hypotheses, and the naive way to solve it."""

from __future__ import annotations

from collections.abc import Callable

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


def naive_torch(problem: LevelProblem, swarm: Poses) -> Callable[[], object]:
    """One batched Gauss-Newton iteration with explicit Jacobians, on the GPU."""
    import torch
    from torch.nn.functional import grid_sample

    h, w, _ = problem.features.shape

    def on(array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(array).to("cuda")

    maps = on(problem.features).permute(2, 0, 1)[None].contiguous()
    confidence = on(problem.confidence)[None, None]
    points, anchors = on(problem.points.T.copy()), problem.anchor_features
    reference = on(anchors)[None]
    weights = on(problem.anchor_confidence)[None]
    R, t = (on(x).float() for x in swarm)
    fx, fy = problem.focal
    cx, cy = problem.centre

    def sample(image: torch.Tensor, u: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        grid = torch.stack([2 * u / (w - 1) - 1, 2 * v / (h - 1) - 1], -1)[:, :, None]
        image = image.expand(len(u), -1, -1, -1)
        return grid_sample(image, grid, align_corners=True)[..., 0].transpose(1, 2)

    eye = torch.eye(6, device="cuda")

    def step() -> object:
        with torch.no_grad():
            x = points[None] @ R.transpose(1, 2) + t[:, None]
            z = x[..., 2].clamp(min=0.1)
            u, v = fx * x[..., 0] / z + cx, fy * x[..., 1] / z + cy
            r = sample(maps, u, v) - reference
            gx = 0.5 * (sample(maps, u + 1, v) - sample(maps, u - 1, v))
            gy = 0.5 * (sample(maps, u, v + 1) - sample(maps, u, v - 1))
            zero, arm = torch.zeros_like(z), x - t[:, None]
            a, b, c, d = fx / z, -fx * x[..., 0] / z**2, fy / z, -fy * x[..., 1] / z**2
            X, Y, Z = arm.unbind(-1)
            Ju = torch.stack([a, zero, b, b * Y, a * Z - b * X, -a * Y], -1)
            Jv = torch.stack([zero, c, d, d * Y - c * Z, -d * X, c * X], -1)
            J = gx[..., None] * Ju[:, :, None] + gy[..., None] * Jv[:, :, None]
            norm = r.norm(dim=-1)
            inside = (u >= 0) & (u < w - 1) & (v >= 0) & (v < h - 1)
            weight = weights * sample(confidence, u, v)[..., 0] * inside
            weight = weight * (0.5 / norm.clamp(min=0.5))
            H = torch.einsum("mn,mnci,mncj->mij", weight, J, J)
            g = torch.einsum("mn,mnci,mnc->mi", weight, J, r)
            H = H + 0.03 * torch.diag_embed(torch.diagonal(H, dim1=1, dim2=2)) + 1e-9 * eye
            return torch.linalg.solve(H, -g)

    return step
