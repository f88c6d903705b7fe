"""How fast the dual-thread engine is on recorded video, with nothing beside it.

    python -m benchmarks.throughput record FOLDER [--seed 0]
    python -m benchmarks.throughput accuracy FOLDER [--map CACHE] [--shifts 8 16] [--json out.json]
    python -m benchmarks.throughput run FOLDER [--widths 320 640] [--cores 1 2] [--json out.json]

`record` renders 300 frames, 30 a second, over the demo's world of a seed (made if it is missing):
straight on, a corner, straight on, with a rolling shutter and an erring calibration. `run` measures
the engine for each width and number of cores: in real time, and with the next frame offered as soon
as the last is done; and, on one thread, the processor time of each stage. Run it on an idle
machine; figures of a loaded one say nothing. The share is the processor time used over what the
cores had. `accuracy` compares, frame by frame, references that serve several frames with one for
every frame; FOLDER may be any sequence with its map.
"""

from __future__ import annotations

import argparse
import json
import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from benchmarks.common.arguments import Parser, existing, number, output, whole
from benchmarks.common.named_errors import named_errors
from benchmarks.throughput.accuracy import paired
from benchmarks.throughput.engine import engine_run
from benchmarks.throughput.stages import stage_times
from localizer.config import LocalizerConfig
from localizer.errors import SequenceError
from localizer.evaluation.sequences import Sequence, load_sequence
from localizer.tracking.opening import MapStack
from sitl.demo.assets import prepare
from sitl.demo.kinematic import record_scenario
from sitl.demo.scenario import CameraSpec, Leg, Scenario

_STAGE_FRAMES = 60


def scenario(rate_hz: float = 30.0) -> Scenario:
    """Ten seconds and more: one corner, 100 m above ground."""
    return Scenario(
        takeoff_height_m=100,
        speed_m_s=10,
        legs=(
            Leg(east_m=0, north_m=35, height_m=100, gimbal_pitch_deg=-75),
            Leg(east_m=40, north_m=35, height_m=105, gimbal_pitch_deg=-65),
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


def accuracy(args: argparse.Namespace) -> None:
    """One line for each limit of `reference_shift_px`."""
    config = LocalizerConfig(width=args.widths[0], threads=1, renderer="numba", device="cpu")
    stack = MapStack(args.map or _map_of(args.folder), config)
    found: list[dict[str, object]] = []
    try:
        sequence = load_sequence(args.folder, stack.cache.frame).first(args.frames)
        for row in paired(stack, sequence, config, args.shifts):
            found.append({"width": args.widths[0], **row})
            print(json.dumps(found[-1]), flush=True)
    finally:
        stack.close()
    if args.json:
        args.json.write_text(json.dumps({"rows": found}, indent=1) + "\n")


def _map_of(folder: Path) -> Path:
    try:
        return Path((folder / "map.txt").read_text().strip())
    except OSError as error:
        raise SequenceError(f"{folder}: no map.txt: give --map, or run `record`") from error


def one_setting(
    folder: Path, width: int, cores: int, frames: int, shift_px: float | None, stages: bool
) -> list[dict[str, object]]:
    """Every figure of one width on so many cores; in a process of its own, which is bound first."""
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
    map_cache = _map_of(folder)
    found: list[dict[str, object]] = []
    config = LocalizerConfig(width=width, threads=cores, renderer="numba", device="cpu")
    if shift_px is not None:
        config = config.model_copy(update={"reference_shift_px": shift_px})
    for paced in (True, False):
        stack = MapStack(map_cache, config)
        try:
            sequence = _sequence(folder, stack, frames)
            figures = engine_run(stack, sequence, config, paced=paced)
        finally:
            stack.close()
        how = "real time" if paced else "next when done"
        share = 100 * figures["cores_used"] / cores
        found.append(
            {
                "width": width,
                "cores": cores,
                "offered": how,
                "share_percent": share,
                "reference_shift_px": config.reference_shift_px,
                **figures,
            }
        )
    if stages:
        single = config.model_copy(update={"threads": 1})
        stack = MapStack(map_cache, single)
        try:
            spent = stage_times(stack, _sequence(folder, stack, _STAGE_FRAMES), single)
        finally:
            stack.close()
        found.append({"width": width, "cores": 1, "offered": "stages", "stage_ms": spent})
    return found


def _sequence(folder: Path, stack: MapStack, frames: int) -> Sequence:
    sequence = load_sequence(folder, stack.cache.frame).first(frames)
    if len(sequence.images) < _STAGE_FRAMES:
        raise SequenceError(f"{folder}: needs {_STAGE_FRAMES} frames: run `record` first")
    return sequence


def run(args: argparse.Namespace) -> None:
    """Every width and number of cores, one process after the other."""
    found: list[dict[str, object]] = []
    for width in args.widths:
        for cores in args.cores:
            stages = cores == max(args.cores)
            with ProcessPoolExecutor(1, get_context("spawn")) as pool:
                job = pool.submit(
                    one_setting, args.folder, width, cores, args.frames, args.shift, stages
                )
                found += job.result()
            for row in found[-2 - stages :]:
                print(json.dumps(row), flush=True)
            if args.json:
                args.json.write_text(json.dumps({"rows": found}, indent=1) + "\n")


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("what", choices=("record", "accuracy", "run"), help="see above")
    parser.add_argument("folder", type=Path, help="of the sequence")
    parser.add_argument("--seed", type=whole(0, 10**6), default=0, help="of the world")
    parser.add_argument("--rate", type=number(1, 60), default=30.0, help="frames/s to record")
    parser.add_argument("--widths", type=whole(64, 2048), nargs="+", default=[320, 640], help="px")
    parser.add_argument("--cores", type=whole(1, 256), nargs="+", default=[1, 2], help="each")
    parser.add_argument(
        "--shift", type=number(0, 100), help="reference_shift_px of `run`; none: the default"
    )
    parser.add_argument("--frames", type=whole(60, 10_000), default=300, help="at most")
    parser.add_argument("--map", type=existing, help="cache of another sequence")
    parser.add_argument("--shifts", type=number(0.1, 100), nargs="+", default=[8.0], help="px")
    parser.add_argument("--json", type=output, help="every figure")
    args = parser.parse_args()
    {"record": record, "accuracy": accuracy, "run": run}[args.what](args)


if __name__ == "__main__":
    with named_errors():
        main()
