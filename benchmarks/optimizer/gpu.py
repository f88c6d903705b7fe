"""The GPU's part of the optimizer benchmark, beside the paper's Table 7; '-' where there is none.

    python -m benchmarks.optimizer.gpu [--json out.json]

Device events, median of many after warm-up. One iteration is (7 iterations - 1) / 6 of a launch,
which starts from the same poses each time.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.common.arguments import Parser, output
from benchmarks.common.figures import write_figures
from benchmarks.common.named_errors import named_errors
from benchmarks.optimizer.problem import SIZES, make_problem, make_swarm, naive_torch
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.registration.backend import (
    LevelProblem,
    LMSettings,
    sample_bilinear,
    world_from_camera,
)
from localizer.registration.config import JNGOConfig
from localizer.registration.cuda.backend import CudaBackend
from localizer.registration.cuda.driver import Device
from localizer.registration.cuda.errors import CudaError
from localizer.registration.cuda.schedule import CudaSchedule
from localizer.types import Anchors, FeatureLevel, FeaturePyramid

REPEATS, WARM_UP = 50, 5
COLUMNS = ("measured on the GPU", "size, pixels", "ms")
SETTINGS = LMSettings(min_overlap=0.01)
_SEARCH = JNGOConfig(
    iterations=(2, 3, 4), sharpen=0, swarm_anchors=(500, 500, 500), min_overlap=0.01,
    duplicate_px=0.0,
)  # fmt: skip
SCHEDULES = (  # label, settings, anchors
    ("2/3/4, 144 -> 64 -> 16, N=500", _SEARCH, 500),
    ("as flown, N=4000 at the end", JNGOConfig(min_overlap=0.01), 4000),
)
Poses = tuple[np.ndarray, np.ndarray]


def median_ms(device: Device, prepare: Callable[[], None], run: Callable[[], None]) -> float:
    """Device time of `run`; `prepare` is outside the events."""
    times = []
    for k in range(WARM_UP + REPEATS):
        prepare()
        start = device.event()
        run()
        stop = device.event()
        if k >= WARM_UP:
            times.append(device.elapsed_ms(start, stop))
    return float(np.median(times))


def fused_ms(backend: CudaBackend, problem: LevelProblem, swarm: Poses) -> float:
    """Milliseconds of one LM iteration of the fused kernel."""
    device, M = backend.device, len(swarm[0])
    kernels = backend.kernels(problem.features.shape[-1])
    found = []
    for iterations in (1, 7):
        arguments = backend.arguments(problem, *swarm, iterations, SETTINGS)
        target = arguments["swarm"]
        fresh = [backend.arena.put(name, np.ascontiguousarray(x)) for name, x in
                 (("fresh R", swarm[0]), ("fresh t", swarm[1]))]  # fmt: skip

        def reset(target: np.ndarray = target, fresh: list[int] = fresh) -> None:
            device.copy(int(target["rotations"]), fresh[0], 72 * M)
            device.copy(int(target["translations"]), fresh[1], 24 * M)

        found.append(
            median_ms(device, reset, partial(kernels.launch, "refine_many", M, 256, arguments))
        )
    return (found[1] - found[0]) / 6


def torch_ms(problem: LevelProblem, swarm: Poses) -> float | None:
    """The naive batched PyTorch on the same GPU; None without a PyTorch that sees it."""
    try:
        import torch
    except ImportError:
        return None
    if not torch.cuda.is_available():
        return None

    step = naive_torch(problem, swarm, 1, "cuda")
    times = []
    for k in range(WARM_UP + REPEATS):
        start, stop = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        step()
        stop.record()
        torch.cuda.synchronize()
        if k >= WARM_UP:
            times.append(start.elapsed_time(stop))
    return float(np.median(times))


def pyramid_problem(
    swarm: Poses, channels: int, anchors: int = 500
) -> tuple[FeaturePyramid, Camera, Anchors, np.ndarray]:
    """One place at 512 px seen at strides 4, 2 and 1: pyramid, camera, anchors, local origin."""

    full = make_problem(512, channels=channels)
    camera = Camera(512, 512, *full.focal, full.centre[0] + 0.5, full.centre[1] + 0.5)
    rng = np.random.default_rng(0)
    picked = rng.integers(0, full.points.shape[1], anchors)
    points = full.points.T[np.sort(picked)].astype(np.float64)
    x = points @ np.eye(3) + [0.0, 0.0, 110.0]
    uv = x[:, :2] / x[:, 2:] * full.focal + np.asarray(full.centre) + 0.5
    levels, features, confidence = [], [], []
    for stride in (4, 2, 1):
        level = make_problem(512 // stride, channels=channels)
        levels.append(FeatureLevel(level.features, level.confidence, stride))
        at = uv / stride - 0.5
        features.append(sample_bilinear(level.features, *at.T).astype(np.float32))
        confidence.append(np.ones(anchors, np.float32))
    pyramid = FeaturePyramid(tuple(levels), 512, 512)
    return (
        pyramid, camera,
        Anchors(points, uv.astype(np.float32), tuple(features), tuple(confidence)), np.zeros(3),
    )  # fmt: skip


def schedule_ms(
    backend: CudaBackend, swarm: Poses, config: JNGOConfig, anchors: int = 500
) -> tuple[float, float, float]:
    """(upload, graph) device milliseconds of a whole schedule, and the winner's distance (m)."""
    query, camera, reference, origin = pyramid_problem(swarm, 32, anchors)
    schedule = CudaSchedule(backend, timed=True)
    found = [
        schedule.run(query, camera, reference, origin, swarm, config)
        for _ in range(WARM_UP + REPEATS)
    ][WARM_UP:]
    R, c = world_from_camera(found[-1].rotations, found[-1].translations, origin)
    truth = Pose(np.eye(3), np.array([0.0, 0.0, -110.0]))
    error = Pose(R[0], c[0]).distance_to(truth)[0] if len(R) else np.inf
    return (
        float(np.median([f.upload_ms for f in found])),
        float(np.median([f.graph_ms for f in found])),
        float(error),
    )


def print_tables(
    console: Console, problems: dict[int, LevelProblem], swarm: Poses
) -> list[tuple[str, ...]]:
    """The GPU tables; without a GPU the same tables with '-' and the reason. The measured figures
    as rows of `COLUMNS`.
    """
    sizes = tuple(problems)
    rows: dict[str, list[float | None]] = {
        name: [None] * len(sizes) for name in ("naive PyTorch", "fused kernel")
    }
    notes = ["GPU: -"]
    schedules: list[tuple[str, ...]] = []
    try:
        device = Device()
    except CudaError as error:
        notes = [f"no GPU column: {error}"]
    else:
        notes = [f"GPU: {device.name}, {device.multiprocessors} multiprocessors"]
        measure(device, problems, swarm, rows, notes, schedules)
    table = Table(title="GPU: ms per LM iteration, device events, median")
    for heading in ("backend", *(f"{s} x {s}" for s in sizes)):
        table.add_column(heading, justify="right")
    for name, values in rows.items():
        table.add_row(name, *("-" if v is None else f"{v:.4f}" for v in values))
    table.add_row("paper: CUDA port (RTX)", "5.21", "5.24", "5.72")
    table.add_row("paper: CUDA fused kernel (RTX)", "0.44", "0.47", "0.49")
    console.print(table)
    table = Table(title="GPU: ms per schedule at 128/256/512 px, M=144, C=32")
    for heading in ("schedule", "upload", "graph", "off by m"):
        table.add_column(heading, justify="right")
    for row in schedules or [("2/3/4, 144 -> 64 -> 16, N=500", "-", "-", "-")]:
        table.add_row(*row)
    console.print(table)
    for note in notes:
        console.print(note)
    return [
        *((f"LM iteration, {name}", f"{size} x {size}", "-" if ms is None else f"{ms:.4f}")
          for name, values in rows.items() for size, ms in zip(sizes, values, strict=True)),
        *((f"registration {label}: {part}", "128, 256, 512", ms)
          for label, *both, _ in schedules
          for part, ms in zip(("upload", "graph"), both, strict=True)),
    ]  # fmt: skip


def measure(
    device: Device,
    problems: dict[int, LevelProblem],
    swarm: Poses,
    rows: dict[str, list[float | None]],
    notes: list[str],
    schedules: list[tuple[str, ...]],
) -> None:
    """Fill the tables."""
    for k, problem in enumerate(problems.values()):
        rows["naive PyTorch"][k] = torch_ms(problem, swarm)
    backend = CudaBackend(device)
    notes.append(f"{backend.kernels(32).resources('refine_many')}")
    for k, problem in enumerate(problems.values()):
        rows["fused kernel"][k] = fused_ms(backend, problem, swarm)
    for label, config, anchors in SCHEDULES:
        upload, graph, error = schedule_ms(backend, swarm, config, anchors)
        schedules.append((label, f"{upload:.3f}", f"{graph:.3f}", f"{error:.3f}"))
    backend.close()


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("--json", type=output, help="the figures, for benchmarks.site.keep")
    args = parser.parse_args()
    problems = {size: make_problem(size) for size in SIZES}
    rows = print_tables(Console(), problems, make_swarm())
    if args.json is not None:
        write_figures(args.json, COLUMNS, rows)


if __name__ == "__main__":
    with named_errors():
        main()
