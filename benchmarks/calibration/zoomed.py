"""A stream that zooms in flight without saying so: how soon the calibration watch tells it.

    python -m benchmarks.calibration.zoomed FOLDER [--minutes 5]
    python -m benchmarks.calibration.zoomed FOLDER --report [--json out.json]

Shadow flights of 110 s on a simulated clock (`sitl.desk`) with a right deployment; after 60 s the
stream's focal length changes by 5 to 20 %, at once or within 3 s. The pictures are registered as in
flight, and what is accepted goes through `companion.calibration_watch` with the autopilot's own
messages (`benchmarks.calibration.watched`). Flights without a zoom are its false alarms. A run goes
on where the last one ended.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.calibration.draws import Draw, Sortie, fly
from benchmarks.calibration.run import read
from benchmarks.calibration.watched import Errors, watch_flight
from benchmarks.common.arguments import Parser, number, output
from benchmarks.common.deadline import deadline
from benchmarks.common.figures import write_figures
from benchmarks.common.named_errors import named_errors
from localizer.geometry.camera import Camera
from localizer.map.cache.cache import TileCache
from sitl.camera.gimbal_error import GimbalError
from sitl.demo.assets import FlightAssets, prepare
from sitl.desk.film import Exposed, Localized, exposures, write_record

SECONDS, ZOOMS_AT_S, SLOWLY_S, STEPS = 110.0, 60.0, 3.0, 4
SHARES = (0.1, -0.1, 0.05, -0.05, 0.2, -0.2, 0.0)
_FIRST = 400  # seed
COLUMNS = (
    "the stream zooms by", "within, s", "told", "pictures accepted afterwards", "their error, m",
)  # fmt: skip
_NAMES = ("focal length", "boresight", "time")
_RIGHT = Draw(0.0, (0.0, 0.0), (0.0,) * 4, 0.0, (0.0,) * 3, (0.0,) * 3, (0.0,) * 3, 0.0)


def longer(camera: Camera, share: float) -> Camera:
    """The camera after its focal length grew by a share."""
    return replace(camera, fx=camera.fx * (1.0 + share), fy=camera.fy * (1.0 + share))


def pictures(sortie: Sortie, seed: int, share: float, lasts_s: float) -> Iterator[Exposed]:
    """Of a camera that zooms from `ZOOMS_AT_S` on, for so long."""
    cache = TileCache.open(sortie.deployment.map)
    begin_ns, end_ns = sortie.flown.begin_ns, sortie.flown.end_ns
    ends_s = ZOOMS_AT_S + lasts_s * (np.arange(STEPS) if lasts_s else np.zeros(1)) / STEPS
    edges = [begin_ns, *(begin_ns + round(1e9 * s) for s in ends_s), end_ns]
    shares = np.linspace(0.0, share, len(edges) - 1)
    for (low, high), grown in zip(itertools.pairwise(edges), shares, strict=True):
        eye = replace(sortie.eye, camera=longer(sortie.eye.camera, float(grown)))
        part = replace(sortie.flown, begin_ns=low, end_ns=high)
        yield from exposures(eye, part, cache, seed)


def run_one(
    assets: FlightAssets, number: int, share: float, lasts_s: float, folder: Path
) -> dict[str, Any]:
    """One flight: what the watch told, and what was accepted after the zoom."""
    seed = _FIRST + number
    sortie = fly(assets, _RIGHT, seed, folder, gimbal=GimbalError(seed), seconds=SECONDS)
    start_ns, _ = sortie.clocks
    begun_s = (sortie.flown.begin_ns - start_ns) * 1e-9
    true = 1.0 / (1.0 + share) - 1.0
    zoomed_s = begun_s + ZOOMS_AT_S
    (folder / "errors.json").write_text(json.dumps(asdict(Errors(true, from_s=zoomed_s))))
    seen = write_record(
        pictures(sortie, seed, share, lasts_s), sortie.deployment, folder / "flight.tlog",
        sortie.clocks,
    )  # fmt: skip
    watched = watch_flight(folder)
    after_ns = start_ns + round(1e9 * (zoomed_s + lasts_s))
    known = [x for x in seen if x.estimate is not None]
    after = [x for x in known if x.estimate and x.estimate.exposure_time_ns >= after_ns]
    before = [x for x in known if x.estimate and x.estimate.exposure_time_ns < after_ns]
    return {
        "seed": seed, "zoom": share, "lasts_s": lasts_s, "watched": asdict(watched),
        "after": _accepted(after), "before": _accepted(before),
    }  # fmt: skip


def _accepted(seen: list[Localized]) -> dict[str, float]:
    """Of pictures: how many, the share that was accepted, and the median error, m."""
    off = [
        x.estimate.world_from_camera.distance_to(x.truth)[0]
        for x in seen
        if x.estimate is not None and x.estimate.accepted
    ]
    median = float(np.median(off)) if off else float("nan")
    return {"pictures": len(seen), "accepted": len(off) / max(len(seen), 1), "median_m": median}


def flights() -> list[tuple[float, float]]:
    """Zoom and seconds that it lasts, of every flight."""
    return [(share, lasts_s) for share in SHARES for lasts_s in ((0.0, SLOWLY_S) if share else
                                                                 (0.0, 0.0))]  # fmt: skip


def rows_of(rows: list[dict[str, Any]]) -> list[tuple[str, ...]]:
    """Cells under `COLUMNS`, a row a flight."""
    cells: list[tuple[str, ...]] = []
    for row in sorted(rows, key=lambda row: int(row["seed"])):
        times = zip(_NAMES, row["watched"]["told_s"], strict=True)
        told = ", ".join(f"{name} after {t:.0f} s" for name, t in times if t is not None)
        after = row["after"]
        accepted = f"{100 * after['accepted']:.0f} % of {after['pictures']}"
        cells.append(
            (
                f"{100 * row['zoom']:+.0f} %" if row["zoom"] else "no zoom", f"{row['lasts_s']:g}",
                told or "nothing", accepted, f"{after['median_m']:.2f}",
            )
        )  # fmt: skip
    return cells


def main() -> None:
    p = Parser(__doc__)
    p.add_argument("folder", type=Path, help="of flights and outcomes")
    p.add_argument("--minutes", type=number(0.1, 1e4), default=5.0, help="until it pauses")
    p.add_argument("--report", action="store_true", help="of what is there; no run")
    p.add_argument("--json", type=output, help="the report")
    args = p.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    path = args.folder / "zoomed.jsonl"
    if not args.report:
        more_time, assets = deadline(args.minutes), prepare(1)
        done = {row["seed"] - _FIRST for row in read(path)}
        for k, (share, lasts_s) in enumerate(flights()):
            if k in done or not more_time():
                continue
            row = run_one(assets, k, share, lasts_s, args.folder / f"{_FIRST + k}")
            with path.open("a") as file:
                file.write(json.dumps(row) + "\n")
            print(*rows_of([row])[0], sep=" | ", flush=True)
    rows = read(path)
    for cells in rows_of(rows):
        print(*cells, sep=" | ")
    if args.json:
        write_figures(args.json, COLUMNS, rows_of(rows), {"each": rows})


if __name__ == "__main__":
    with named_errors():
        main()
