"""Milliseconds of the optimizer on a GPU, beside 0.44 to 0.49 of the paper's kernel (Table 7).

    python -m benchmarks.optimizer.gpu [--json out.json]

Device events, median of many after warm-up. One iteration is (7 iterations - 1) / 6 of a launch,
which starts from the same poses each time.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial

import numpy as np

from benchmarks.common.arguments import Parser, output
from benchmarks.common.figures import show_figures
from benchmarks.common.named_errors import named_errors
from benchmarks.optimizer.problem import SIZES, make_problem, make_swarm
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
    best = found[-1].survivors
    R, c = world_from_camera(best.rotations, best.translations, origin)
    truth = Pose(np.eye(3), np.array([0.0, 0.0, -110.0]))
    error = Pose(R[0], c[0]).distance_to(truth)[0] if len(R) else np.inf
    return (
        float(np.median([f.upload_ms for f in found])),
        float(np.median([f.graph_ms for f in found])),
        float(error),
    )


def measured(device: Device) -> list[tuple[str, ...]]:
    """The rows of `COLUMNS`."""
    problems, swarm = {size: make_problem(size) for size in SIZES}, make_swarm()
    backend = CudaBackend(device)
    print(f"{backend.kernels(32).resources('refine_many')}")
    rows: list[tuple[str, ...]] = [
        ("LM iteration", f"{size} x {size}", f"{fused_ms(backend, problem, swarm):.4f}")
        for size, problem in problems.items()
    ]
    for label, config, anchors in SCHEDULES:
        upload, graph, error = schedule_ms(backend, swarm, config, anchors)
        print(f"registration {label}: off by {error:.3f} m")
        for part, ms in (("upload", upload), ("graph", graph)):
            rows.append((f"registration {label}: {part}", "128, 256, 512", f"{ms:.3f}"))
    backend.close()
    return rows


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("--json", type=output, help="the figures, for benchmarks.site.keep")
    args = parser.parse_args()
    try:
        device = Device()
    except CudaError as error:
        print(f"nothing to measure: {error}")
        sys.exit(2)
    print(f"GPU: {device.name}, {device.multiprocessors} multiprocessors")
    show_figures(args.json, COLUMNS, measured(device))


if __name__ == "__main__":
    with named_errors():
        main()
