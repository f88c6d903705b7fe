"""Milliseconds per LM iteration and per registration, beside the paper's Table 7.

    python benchmarks/optimizer.py [--threads 2] [--quick]

M = 144 hypotheses, N = 500 anchors, C = 32 channels, random smooth features, one process. "naive"
is the obvious batched PyTorch: gather C x 6 Jacobians of every anchor and hypothesis, then einsum;
it needs the extra `train` and is left out without it. One iteration is one cost evaluation with
its normal equations and one 6x6 solution; a registration counts iterations + 1 evaluations a level.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
from arguments import Parser, whole
from named_errors import named_errors
from optimizer_gpu import print_tables
from rich.console import Console
from rich.table import Table

from localizer.camera import Camera
from localizer.pose import Pose, so3_exp
from localizer.registration import JNGO
from localizer.registration import anchors as anchors_module
from localizer.registration.backend import Backend, LevelProblem, LMSettings, sample_bilinear
from localizer.registration.kernel_numba import NumbaBackend
from localizer.registration.reference import ReferenceBackend
from localizer.types import Anchors, FeatureLevel, FeaturePyramid, PosePrior

HYPOTHESES, ANCHORS, CHANNELS = 144, 500, 32
SIZES = (128, 256, 512)
PAPER_TABLE_7 = {
    "paper: ONNX Runtime (RTX)": (8.8, 10.4, 14.9),
    "paper: CUDA fused kernel (RTX)": (0.44, 0.47, 0.49),
}
Poses = tuple[np.ndarray, np.ndarray]


def make_problem(size: int, width: int | None = None, channels: int = CHANNELS) -> LevelProblem:
    """Smooth random unit features; anchors at 80 to 160 m; the truth is the identity rotation."""
    width = width or size
    rng = np.random.default_rng(size)
    f = smooth_features(rng, size, width, channels)
    uv = rng.uniform([0.05 * width, 0.05 * size], [0.95 * width, 0.95 * size], (ANCHORS, 2))
    # Morton-like order: the anchors of a real view come sorted along the Z curve.
    cell = (uv * 32 / width).astype(int)
    code = sum(((cell[:, i] >> b) & 1) << (2 * b + i) for b in range(5) for i in (0, 1))
    uv = uv[np.argsort(code)]
    depth = rng.uniform(80, 160, ANCHORS)
    focal, centre = float(width), (width / 2 - 0.5, size / 2 - 0.5)
    points = np.column_stack([(uv - centre) / focal * depth[:, None], depth])
    points[:, 2] -= 110.0
    return LevelProblem(
        f,
        rng.uniform(0.3, 1, (size, width)).astype(np.float32),
        (focal, focal),
        centre,
        np.ascontiguousarray(points.T, dtype=np.float32),
        sample_bilinear(f, uv[:, 0], uv[:, 1]).astype(np.float32),
        rng.uniform(0.3, 1, ANCHORS).astype(np.float32),
    )


def smooth_features(rng: np.random.Generator, h: int, w: int, channels: int) -> np.ndarray:
    """Unit features (h, w, C) with structure of four pixels."""
    coarse = rng.standard_normal((channels, max(h // 4, 3), max(w // 4, 3))).astype(np.float32)
    f = np.dstack([cv2.resize(c, (w, h), interpolation=cv2.INTER_CUBIC) for c in coarse])
    return np.ascontiguousarray(f / (np.linalg.norm(f, axis=-1, keepdims=True) + 1e-6))


def whole_registration(threads: int, sigma_deg: float, repeats: int) -> tuple[float, int]:
    """Milliseconds and evaluations of `JNGO.register` as it flies: 320 x 240, 4000 anchors,
    strides 8, 4, 2 with 32 channels and the detail level, prior off by its sigma of 1 m.
    """
    rng = np.random.default_rng(0)
    camera = Camera.from_fov(320, 240, 60.0)
    levels = [
        FeatureLevel(
            smooth_features(rng, 240 // s, 320 // s, c),
            np.ones((240 // s, 320 // s), np.float32),
            s,
        )
        for s, c in ((8, 32), (4, 32), (2, 32), (1, 4))
    ]
    nadir = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 120.0]))
    pixels = rng.uniform([10, 10], [310, 230], (4000, 2))
    pixels = pixels[np.argsort(anchors_module._morton(*pixels.astype(np.int64).T), kind="stable")]
    points = nadir.apply(camera.rays(pixels) * rng.uniform(110, 120, (4000, 1)))
    sampled = [
        sample_bilinear(x.features, *(pixels / x.stride - 0.5).T).astype(np.float32) for x in levels
    ]
    anchors = Anchors(
        points, pixels.astype(np.float32), tuple(sampled),
        tuple(np.ones(4000, np.float32) for _ in levels),
    )  # fmt: skip
    shifted = Pose(nadir.rotation, nadir.translation + np.array([0.7, -0.7, 0.3]))
    covariance = np.diag([1.0] * 3 + [np.radians(sigma_deg) ** 2] * 3)
    prior = PosePrior(shifted, covariance, 0)
    optimizer = JNGO(threads=threads)
    query = FeaturePyramid(tuple(levels), 320, 240)
    found = optimizer.register(query, camera, anchors, prior, motion=prior)
    if nadir.distance_to(found.world_from_camera)[0] > 0.1:
        raise RuntimeError("the benchmark's registration does not converge: its time means nothing")
    run = partial(optimizer.register, query, camera, anchors, prior, motion=prior)
    return milliseconds(run, repeats), found.evaluations


def make_swarm(count: int = HYPOTHESES) -> Poses:
    """The paper's box of rotations about the camera and N(0, 1 m)."""
    rng = np.random.default_rng(0)
    turns = np.radians(np.column_stack([rng.uniform(-11, 11, (count, 2)), rng.normal(0, 1, count)]))
    rotations = np.stack([so3_exp(t) for t in turns])
    # The camera turns about its own centre, 110 m above the local origin.
    return rotations, rotations @ np.array([0.0, 0.0, 110.0]) + rng.normal(0, 1, (count, 3))


def naive_torch(
    problem: LevelProblem, swarm: Poses, threads: int, device: str = "cpu"
) -> Callable[[], object]:
    """One batched Gauss-Newton iteration with explicit Jacobians."""
    import torch
    from torch.nn.functional import grid_sample

    torch.set_num_threads(threads)
    h, w, _ = problem.features.shape

    def on(array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(array).to(device)

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

    eye = torch.eye(6, device=device)

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


def milliseconds(run: Callable[[], object], repeats: int) -> float:
    """Fastest wall time of several, after one call to warm up: the least disturbed one."""
    run()
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        run()
        times.append((time.perf_counter() - started) * 1e3)
    return min(times)


def per_iteration(backend: Backend, problem: LevelProblem, swarm: Poses, repeats: int) -> float:
    """One more iteration's cost: (7 iterations - 1 iteration) / 6."""
    settings = LMSettings(min_overlap=0.01)
    many = milliseconds(lambda: backend.refine(problem, *swarm, 7, settings), repeats)
    one = milliseconds(lambda: backend.refine(problem, *swarm, 1, settings), repeats)
    return (many - one) / 6


def schedule(
    backend: Backend, levels: list[LevelProblem], keep: tuple[int, ...], repeats: int
) -> float:
    """The whole 2/3/4 schedule, survivors by score."""
    swarm, settings = make_swarm(), LMSettings(min_overlap=0.01)

    def run() -> None:
        R, t = swarm
        for problem, iterations, survivors in zip(levels, (2, 3, 4), (*keep, 1), strict=True):
            result = backend.refine(problem, R, t, iterations, settings)
            order = np.argsort(result.scores)[:survivors]
            R, t = result.rotations[order], result.translations[order]

    return milliseconds(run, repeats)


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument(
        "--threads", type=whole(1, 256), default=min(2, os.cpu_count() or 1), help="beside one"
    )
    parser.add_argument("--quick", action="store_true", help="fewer repeats, 256 px only for naive")
    arguments = parser.parse_args()
    repeats = 5 if arguments.quick else 15
    problems = {size: make_problem(size) for size in SIZES}
    swarm = make_swarm()
    few = tuple(x[:4] for x in swarm)
    counts = sorted({1, arguments.threads})
    console = Console()
    load = os.getloadavg()[0]
    console.print(
        f"{os.cpu_count()} cores, load average {load:.1f} at the start: idle is below 0.5"
    )

    table = Table(title=f"ms per LM iteration, M={HYPOTHESES} N={ANCHORS} C={CHANNELS}")
    for heading in ("backend", *(f"{s} x {s}" for s in SIZES), "times faster than naive at 256"):
        table.add_column(heading, justify="right")
    rows: dict[str, list[float]] = {}
    for threads in counts:
        name = f"naive PyTorch ({threads} thread{'s' if threads > 1 else ''})"
        sizes = (256,) if arguments.quick else SIZES
        try:
            rows[name] = [
                milliseconds(naive_torch(problems[s], swarm, threads), 3) if s in sizes else np.nan
                for s in SIZES
            ]
        except ImportError:
            console.print("PyTorch is not installed (extra `train`): the naive row is left out")
            break
    reference = ReferenceBackend()
    rows[reference.name] = [
        per_iteration(reference, problems[s], few, 3) * HYPOTHESES / len(few[0]) for s in SIZES
    ]
    for threads in counts:
        backend = NumbaBackend(threads)
        rows[backend.name] = [per_iteration(backend, problems[s], swarm, repeats) for s in SIZES]
    naive = {t: rows.get(f"naive PyTorch ({t} thread{'s' if t > 1 else ''})") for t in counts}
    baseline = naive[counts[-1]]
    for name, values in rows.items():
        ratio = f"{baseline[1] / values[1]:.0f}" if baseline else "-"
        table.add_row(name, *(f"{v:.2f}" if np.isfinite(v) else "-" for v in values), ratio)
    for name, values in PAPER_TABLE_7.items():
        table.add_row(name, *(f"{v:.2f}" for v in values), "-")
    console.print(table)

    table = Table(title="ms per registration, LM iterations 2 / 3 / 4 coarse to fine")
    for heading in ("backend", "levels", "C", "144 kept", "144 -> 64 -> 16"):
        table.add_column(heading, justify="right")
    cases = [("128/256/512 px", 32, [problems[s] for s in SIZES])]
    small = [make_problem(30 * k, 40 * k, 16) for k in (1, 2, 4)]
    cases.append(("320 x 240 image, strides 8/4/2", 16, small))
    for label, channels, levels in cases:
        for threads in counts:
            backend = NumbaBackend(threads)
            full = schedule(backend, levels, (144, 144), repeats)
            halved = schedule(backend, levels, (64, 16), repeats)
            table.add_row(backend.name, label, str(channels), f"{full:.1f}", f"{halved:.1f}")
    console.print(table)

    table = Table(title="ms per JNGO.register, 320 x 240, 4000 anchors, detail level, one image")
    for heading in ("threads", "prior 1 m, 1° (tracking)", "prior 1 m, 8° (start)"):
        table.add_column(heading, justify="right")
    for threads in counts:
        found = [whole_registration(threads, sigma, repeats) for sigma in (1.0, 8.0)]
        table.add_row(str(threads), *(f"{ms:.1f} ({n} evaluations)" for ms, n in found))
    console.print(table)

    print_tables(console, problems, swarm)


if __name__ == "__main__":
    with named_errors():
        main()
