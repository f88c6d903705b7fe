"""How fast the dual-thread engine is on recorded video, with nothing beside it.

    python -m benchmarks.throughput record FOLDER [--seed 0]
    python -m benchmarks.throughput run FOLDER [--widths 320 640] [--cores 1 2] [--json out.json]

`record` renders 60 frames a second over the demo's world of a seed (made if it is missing):
straight on, a corner, straight on, with a rolling shutter and an erring calibration. `run` measures
the engine for each width and number of cores: in real time, with 10, 30 and 60 frames a second, as
far as recorded; with the next of 30 offered as soon as the last is done; and with two of them in
the engine all the time, so that one is registered while the other's features are extracted; and, on
one thread, each stage. Run it on an idle machine; figures of a loaded one say nothing. The share is
the processor time used over what the cores had. The memory is the process's, without the decoded
frames.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from benchmarks.common.arguments import Parser, number, output, whole
from benchmarks.common.figures import show_figures
from benchmarks.common.named_errors import named_errors
from benchmarks.throughput.settings import OFFERED, one_setting
from sitl.demo.assets import prepare
from sitl.demo.kinematic import record_scenario
from sitl.demo.scenario import CameraSpec, Scenario, ScenarioLeg

COLUMNS = (
    "width", "cores", "frames offered", "frames", "frames/s", "latency p50 / p95, ms",
    "CPU ms a frame", "share of the cores", "peak memory, MiB", "median / p95 error, m",
)  # fmt: skip


def scenario(rate_hz: float) -> Scenario:
    """Ten seconds and more: one corner, 100 m above ground."""
    return Scenario(
        takeoff_height_m=100,
        speed_m_s=10,
        legs=(
            ScenarioLeg(east_m=0, north_m=35, height_m=100, gimbal_pitch_deg=-75),
            ScenarioLeg(east_m=40, north_m=35, height_m=105, gimbal_pitch_deg=-65),
        ),
        camera=CameraSpec(rate_hz=rate_hz),
        cars=10,
        people=10,
    )


def record(args: argparse.Namespace) -> None:
    """The sequence, and which map it is of."""
    assets = prepare(args.seed)
    args.folder.mkdir(parents=True, exist_ok=True)
    count = record_scenario(assets, scenario(args.rate), args.seed, args.folder)
    (args.folder / "map.txt").write_text(f"{assets.map_cache}\n")
    print(f"{count} frames")


def run(args: argparse.Namespace) -> None:
    """Every width and number of cores, one process after the other."""
    found: list[dict[str, Any]] = []
    for width in args.widths:
        for cores in args.cores:
            for how in (*OFFERED, *(["stages"] if cores == max(args.cores) else [])):
                with ProcessPoolExecutor(1, get_context("spawn")) as pool:
                    job = pool.submit(
                        one_setting, args.folder, width, cores, args.frames, args.shift, how
                    )
                    found += (rows := job.result())
                for row in rows:
                    print(json.dumps(row), flush=True)
    show_figures(args.json, COLUMNS, cells(found), {"rows": found})


def cells(rows: Sequence[dict[str, Any]]) -> list[tuple[str, ...]]:
    """The engine's rows as `COLUMNS` names them, without the stages, which are of another shape."""
    return [
        (
            str(r["width"]), str(r["cores"]), r["offered"],
            f"{r['frames_answered']} of {r['frames_offered']}", f"{r['frames_per_s']:.1f}",
            f"{r['latency_p50_ms']:.0f} / {r['latency_p95_ms']:.0f}",
            f"{r['cpu_ms_per_frame']:.1f}", f"{r['share_percent']:.0f} %", f"{r['peak_mib']:.0f}",
            f"{r['median_m']:.2f} / {r['p95_m']:.2f}",
        )
        for r in rows if "stage" not in r
    ]  # fmt: skip


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("what", choices=("record", "run"), help="see above")
    parser.add_argument("folder", type=Path, help="of the sequence")
    parser.add_argument("--seed", type=whole(0, 10**6), default=0, help="of the world")
    parser.add_argument("--rate", type=number(1, 60), default=60.0, help="frames/s to record")
    parser.add_argument("--widths", type=whole(64, 2048), nargs="+", default=[320, 640], help="px")
    parser.add_argument("--cores", type=whole(1, 256), nargs="+", default=[1, 2], help="each")
    parser.add_argument(
        "--shift", type=number(0, 100), help="reference_shift_px of `run`; none: the default"
    )
    parser.add_argument("--frames", type=whole(60, 10_000), default=600, help="at most")
    parser.add_argument("--json", type=output, help="every figure")
    args = parser.parse_args()
    {"record": record, "run": run}[args.what](args)


if __name__ == "__main__":
    with named_errors():
        main()
