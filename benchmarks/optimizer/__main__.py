"""Milliseconds per LM iteration and per registration, beside the paper's Table 7.

    python -m benchmarks.optimizer [--threads 2] [--quick] [--json out.json]

M = 144 hypotheses, N = 500 anchors, C = 32 channels, random smooth features, one process. "naive"
is the obvious batched PyTorch: gather C x 6 Jacobians of every anchor and hypothesis, then einsum;
it needs the extra `train` and is left out without it. One iteration is one cost evaluation with
its normal equations and one 6x6 solution; a registration counts iterations + 1 evaluations a level.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.common.arguments import Parser, output, whole
from benchmarks.common.named_errors import named_errors
from benchmarks.optimizer.gpu import print_tables
from benchmarks.optimizer.problem import (
    ANCHORS,
    CHANNELS,
    HYPOTHESES,
    SIZES,
    Poses,
    make_problem,
    make_swarm,
    naive_torch,
    smooth_features,
)
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.registration import JNGO
from localizer.registration.anchors import morton_code
from localizer.registration.backend import Backend, LevelProblem, LMSettings, sample_bilinear
from localizer.registration.cpu.kernel import NumbaBackend
from localizer.registration.cpu.reference import ReferenceBackend
from localizer.types import Anchors, FeatureLevel, FeaturePyramid, PosePrior

PAPER_TABLE_7 = {
    "paper: ONNX Runtime (RTX)": (8.8, 10.4, 14.9),
    "paper: CUDA fused kernel (RTX)": (0.44, 0.47, 0.49),
}


Problems = dict[int, LevelProblem]


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
    pixels = pixels[np.argsort(morton_code(*pixels.astype(np.int64).T), kind="stable")]
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


Rows = dict[str, list[float | None]]


def iteration_rows(problems: Problems, counts: Sequence[int], *, quick: bool) -> Rows:
    """Milliseconds per LM iteration at `SIZES` of every backend."""
    swarm = make_swarm()
    rows = naive_rows(problems, counts, sizes=(256,) if quick else SIZES)
    few = (swarm[0][:4], swarm[1][:4])
    reference = ReferenceBackend()
    rows[reference.name] = [
        per_iteration(reference, problems[s], few, 3) * HYPOTHESES / len(few[0]) for s in SIZES
    ]
    for threads in counts:
        backend = NumbaBackend(threads)
        rows[backend.name] = [
            per_iteration(backend, problems[s], swarm, repeats_of(quick)) for s in SIZES
        ]
    return rows


def iteration_table(rows: Rows) -> Table:
    """The rows beside the paper's."""
    table = Table(title=f"ms per LM iteration, M={HYPOTHESES} N={ANCHORS} C={CHANNELS}")
    for heading in ("backend", *(f"{s} x {s}" for s in SIZES), "times faster than naive at 256"):
        table.add_column(heading, justify="right")
    naive = [values[1] for name, values in rows.items() if name.startswith("naive")]
    baseline = naive[-1] if naive else None
    for name, values in rows.items():
        ratio = f"{baseline / values[1]:.0f}" if baseline and values[1] else "-"
        table.add_row(name, *("-" if v is None else f"{v:.2f}" for v in values), ratio)
    for name, published in PAPER_TABLE_7.items():
        table.add_row(name, *(f"{v:.2f}" for v in published), "-")
    return table


def naive_rows(problems: Problems, counts: Sequence[int], sizes: Sequence[int]) -> Rows:
    """Milliseconds of one naive iteration by threads and size, None of what was not measured; no
    row without PyTorch.
    """
    rows: Rows = {}
    for threads in counts:
        name = f"naive PyTorch ({threads} thread{'s' if threads > 1 else ''})"
        try:
            rows[name] = [
                milliseconds(naive_torch(problems[s], make_swarm(), threads), 3)
                if s in sizes
                else None
                for s in SIZES
            ]
        except ImportError:
            print("PyTorch is not installed (extra `train`): the naive row is left out")
            break
    return rows


def schedule_table(problems: Problems, counts: Sequence[int], repeats: int) -> Table:
    """Milliseconds of the whole schedule at the paper's sizes and at the flight's."""
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
    return table


def registration_table(counts: Sequence[int], repeats: int) -> Table:
    """Milliseconds of `JNGO.register`, tracking and at the start."""
    table = Table(title="ms per JNGO.register, 320 x 240, 4000 anchors, detail level, one image")
    for heading in ("threads", "prior 1 m, 1° (tracking)", "prior 1 m, 8° (start)"):
        table.add_column(heading, justify="right")
    for threads in counts:
        found = [whole_registration(threads, sigma, repeats) for sigma in (1.0, 8.0)]
        table.add_row(str(threads), *(f"{ms:.1f} ({n} evaluations)" for ms, n in found))
    return table


def repeats_of(quick: bool) -> int:
    """Runs of which the least counts."""
    return 5 if quick else 15


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument(
        "--threads", type=whole(1, 256), default=min(2, os.cpu_count() or 1), help="beside one"
    )
    parser.add_argument("--quick", action="store_true", help="fewer repeats, 256 px only for naive")
    parser.add_argument("--json", type=output, help="the iterations' figures (the paper's Table 7)")
    arguments = parser.parse_args()
    problems = {size: make_problem(size) for size in SIZES}
    counts = sorted({1, arguments.threads})
    console = Console()
    load = os.getloadavg()[0]
    console.print(
        f"{os.cpu_count()} cores, load average {load:.1f} at the start: idle is below 0.5"
    )
    repeats = repeats_of(arguments.quick)
    rows = iteration_rows(problems, counts, quick=arguments.quick)
    console.print(iteration_table(rows))
    if arguments.json:
        document = {"sizes": SIZES, "iteration_ms": rows, "paper_ms": PAPER_TABLE_7, "load": load}
        arguments.json.write_text(json.dumps(document, indent=1) + "\n")
    console.print(schedule_table(problems, counts, repeats))
    console.print(registration_table(counts, repeats))
    print_tables(console, problems, make_swarm())


if __name__ == "__main__":
    with named_errors():
        main()
