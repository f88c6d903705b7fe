"""How long `companion plan` takes for five kilometres, from the command to its report.

    python -m benchmarks.planning.timed FOLDER [--json out.json]

The mission goes to and fro over a generated world of 1.6 km (legs of 900 m, 60 m apart). Each run
is the command itself in a process of its own: imports, kernels, pictures and page are in its time.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import yaml

from benchmarks.common.arguments import Parser, output
from benchmarks.common.figures import write_figures
from benchmarks.common.named_errors import named_errors
from localizer.map.cache.cache import TileCache
from sitl.demo.assets import prepare
from sitl.demo.scenario import CameraSpec

WANTED_S = 60.0
_LEG_M, _APART_M, _HEIGHT_M = 900.0, 60.0, 100.0
_LEGS = 5
_RUNS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("as it comes", ()),
    ("no alternatives", ("--no-alternatives",)),
)
COLUMNS = ("options", "mission, m", "places", "seconds", "wanted", "processors")


def waypoints(cache: TileCache) -> str:
    """A mission file (QGC WPL 110) of 5 km over the middle of a map."""
    rows = []
    for leg in range(_LEGS):
        north = (leg - _LEGS / 2) * _APART_M
        for end in (-0.5, 0.5) if leg % 2 == 0 else (0.5, -0.5):
            rows.append((end * _LEG_M, north))
    rows.append((rows[-1][0], rows[-1][1] - 240.0))  # and 240 m home
    lines = ["QGC WPL 110"]
    for number, (east, north) in enumerate([(0.0, 0.0), *rows]):
        place = cache.frame.position([east, north, 0.0])
        at = f"{place.latitude_deg:.8f}\t{place.longitude_deg:.8f}\t{_HEIGHT_M:.1f}"
        lines.append(f"{number}\t{int(not number)}\t3\t16\t0\t0\t0\t0\t{at}\t1")
    return "\n".join(lines) + "\n"


def run(folder: Path, options: tuple[str, ...]) -> dict[str, Any]:
    """One run of the command; what it says of its mission, and how long it took."""
    out = folder / "plan"
    command = [
        sys.executable, "-m", "companion", "plan", str(folder / "mission.waypoints"), "--config",
        str(folder / "deployment.yaml"), "--out", str(out), *options,
    ]  # fmt: skip
    begun = time.monotonic()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    seconds = time.monotonic() - begun
    if done.returncode not in (0, 1):  # 1: vision will not do somewhere
        raise RuntimeError(f"{' '.join(command)}: {done.stderr.strip()[-500:]}")
    said = json.loads((out / "plan.json").read_text(encoding="utf-8"))
    places = sum(len(leg["samples"]) for leg in said["legs"])
    return {"length_m": float(said["length_m"]), "places": places, "seconds": seconds}


def main() -> None:
    p = Parser(__doc__)
    p.add_argument("folder", type=Path, help="of the mission and the reports")
    p.add_argument("--json", type=output, help="the times")
    args = p.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    assets = prepare(1)
    (args.folder / "mission.waypoints").write_text(waypoints(TileCache.open(assets.map_cache)))
    deployment = {
        "map": str(assets.map_cache.resolve()),
        "camera": {"source": "udp://127.0.0.1:5600", "model": CameraSpec().camera().to_dict()},
    }
    (args.folder / "deployment.yaml").write_text(yaml.safe_dump(deployment))
    rows = [(name, run(args.folder, options)) for name, options in _RUNS]
    processors = len(os.sched_getaffinity(0))
    cells = [
        (
            name, f"{made['length_m']:.0f}", f"{made['places']}", f"{made['seconds']:.0f}",
            f"{WANTED_S:.0f}", f"{processors}",
        )
        for name, made in rows
    ]  # fmt: skip
    for row in cells:
        print(*row, sep=" | ")
    if args.json:
        write_figures(args.json, COLUMNS, cells, {"runs": dict(rows)})


if __name__ == "__main__":
    with named_errors():
        main()
