"""Estimates, not measurements: what a frame costs on ARM boards that nobody here has.

    companion self-test --bench --out bench.json
    python -m benchmarks.throughput.boards bench.json [--json boards.json]

Scales the processor time of each stage on one thread of this computer, which must have made
bench.json without OpenVINO. The lower estimate takes the board's documented peak of float32 (two
128-bit multiply-adds a cycle in Cortex-A76 and A78AE) for the network, and as many cycles as here
for other stages. The upper estimate takes for all of them the share of that peak that Linpack
reaches on a Raspberry Pi 5: 30.249 of 76.8 GFLOP/s in float64
(https://github.com/geerlingguy/top500-benchmark/issues/18). This computer's clock and rate of
float32 are measured. The network's multiply-adds and bytes are counted by onnxruntime's profiler,
operator by operator. A frame is every stage once, without odometry and recorded image; the rate
needs all cores of one kind. Heat, which lowers the clock, is left out.
"""

from __future__ import annotations

import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
from numba import njit

from benchmarks.common.arguments import Parser, existing, output
from benchmarks.common.figures import show_figures
from benchmarks.common.named_errors import named_errors
from companion.errors import ReportError
from localizer.features.extractor import SHIPPED_MODEL

_MAC_A_CYCLE = 8  # float32, of a core
_LINPACK = 30.249 / 76.8
_BESIDE = ("odometry, off the map", "encode a recorded image")  # not of every frame


@dataclass(frozen=True)
class Board:
    """A board: its fast cores, and their clock, GHz."""

    name: str
    cores: int
    ghz: float


BOARDS = (
    Board("Raspberry Pi 5, RK3588", 4, 2.4),  # without RK3588's A55
    Board("Jetson Orin Nano", 6, 1.5),  # 1.7 in its mode of most power; GPU left out
)
COLUMNS = ("width", "stage", "here, ms", "here, 10^6 cycles", "10^6 multiply-adds", "MB moved",
           *(f"{board.name}, ms" for board in BOARDS))  # fmt: skip


def network_counts(width: int) -> tuple[float, float]:
    """Millions of multiply-adds, and MB read and written, of the shipped network at a width."""
    image = np.zeros((1, width * 3 // 4, width, 3), np.uint8)
    options = ort.SessionOptions()
    options.enable_profiling = True
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
    with tempfile.TemporaryDirectory() as folder:
        options.profile_file_prefix = f"{folder}/run"
        session = ort.InferenceSession(
            str(SHIPPED_MODEL), options, providers=["CPUExecutionProvider"]
        )
        session.run(None, {"image": image})
        events = json.loads(Path(session.end_profiling()).read_text(encoding="utf-8"))
    macs, moved = 0.0, 0.0
    for node in (e["args"] for e in events if e["name"].endswith("_kernel_time")):
        moved += sum(int(node[f"{kind}_size"]) for kind in ("activation", "parameter", "output"))
        if node["op_name"] == "Conv":
            (_, weights, *_), (given, *_) = (
                [next(iter(shape.values())) for shape in node[f"{kind}_type_shape"]]
                for kind in ("input", "output")
            )
            macs += float(np.prod(weights)) * float(np.prod(given[2:]))
    return macs * 1e-6, moved * 1e-6


def clock_ghz() -> float:
    """Of this processor: a chain of shift (1 cycle), exclusive or (1) and multiplication (3)."""
    _chain(1)
    began, count = time.process_time(), 100_000_000
    _chain(count)
    return 5e-9 * count / (time.process_time() - began)


@njit
def _chain(count):  # type: ignore[no-untyped-def]
    x = np.uint64(0x9E3779B97F4A7C15)
    for _ in range(count):
        x = (x ^ (x >> np.uint64(29))) * np.uint64(6364136223846793005)
    return x


def gmac_s() -> float:
    """Thousand millions of float32 multiply-adds a second of processor time: matrix product."""
    a = np.ones((1024, 1024), np.float32)
    a @ a
    began = time.process_time()
    for _ in range(10):
        a @ a
    return 10 * 1.024**3 / (time.process_time() - began)


def estimates(stages: list[dict[str, Any]]) -> list[tuple[str, ...]]:
    """As `COLUMNS` names them, each width with its sum."""
    clock, rate = clock_ghz(), gmac_s()
    print(f"{clock:.2f} GHz, {rate:.1f} GMAC/s in float32 here")
    rows: list[tuple[str, ...]] = []
    for width in sorted({row["width"] for row in stages}):
        macs, moved = network_counts(width)
        here, least, most = 0.0, np.zeros(len(BOARDS)), np.zeros(len(BOARDS))
        for row in (row for row in stages if row["width"] == width):
            ms, learned = row["cpu_ms"], row["stage"].startswith("features")
            peak = np.array([_MAC_A_CYCLE * board.ghz for board in BOARDS])
            low = ms * (rate / peak if learned else clock / peak * _MAC_A_CYCLE)
            high = ms * rate / peak / _LINPACK
            counts = (f"{macs:.0f}", f"{moved:.0f}") if learned else ("-", "-")
            rows.append(_cells(width, row["stage"], ms, clock, counts, low, high))
            if row["stage"] not in _BESIDE:
                here, least, most = here + ms, least + low, most + high
        counts = (f"{2 * macs:.0f}", f"{2 * moved:.0f}")
        rows.append(_cells(width, "a frame", here, clock, counts, least, most))
        cores = 1e3 * np.array([board.cores for board in BOARDS])
        rates = (f"{a:.1f} to {b:.1f}" for a, b in zip(cores / most, cores / least, strict=True))
        rows.append((str(width), "frames/s, all cores busy", "-", "-", "-", "-", *rates))
    return rows


def _cells(
    width: int, stage: str, ms: float, ghz: float, counts: tuple[str, str],
    low: np.ndarray, high: np.ndarray,
) -> tuple[str, ...]:  # fmt: skip
    ranges = (f"{a:.0f} to {b:.0f}" for a, b in zip(low, high, strict=True))
    return (str(width), stage, f"{ms:.1f}", f"{ms * ghz:.0f}", *counts, *ranges)


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("bench", type=existing, help="of `companion self-test --bench --out`")
    parser.add_argument("--json", type=output, help="the table, for benchmarks.site.keep")
    args = parser.parse_args()
    try:
        data = json.loads(args.bench.read_text(encoding="utf-8"))
        stages, features = data["stages"], data["features"]
    except (ValueError, KeyError, TypeError) as error:
        raise ReportError(f"{args.bench}: not of `companion self-test --bench --out`") from error
    if not stages:
        raise ReportError(f"{args.bench}: no stages: give --bench to `companion self-test`")
    if "onnxruntime, CPU" not in features:
        raise ReportError(f"{args.bench}: {features}: float32 of onnxruntime on the CPU is needed")
    try:
        rows = estimates(stages)
    except (KeyError, TypeError, AttributeError) as error:
        raise ReportError(f"{args.bench}: stages: not of `companion self-test --bench`") from error
    show_figures(args.json, COLUMNS, rows)


if __name__ == "__main__":
    with named_errors():
        main()
