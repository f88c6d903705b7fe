"""What the errors left in a calibrated lens put into the position of the flight after it.

    python -m benchmarks.calibration.carried FOLDER... [--json out.json]

FOLDERs are of `python -m benchmarks.calibration`, with the flights after it. Of every draw the
found lens looks at ground with houses from 60, 95 and 125 m, 0 to 40 degrees off the vertical: true
pixels of the true lens, the pose by which the found lens explains them (least squares, all six
numbers free), and how far it is off; by each group of the lens's numbers, and by all of them.
Beside it: by how much the flight after it was worse than with the true deployment, as the root of
the difference of squares.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from benchmarks.calibration.draws import drawn, true_camera
from benchmarks.calibration.run import read
from benchmarks.common.arguments import Parser, output
from benchmarks.common.figures import write_figures
from benchmarks.common.named_errors import named_errors
from companion.calibrate import unknowns as u
from companion.calibrate.evidence import changed_camera
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, so3_exp
from sitl.demo.scenario import CameraSpec

COLUMNS = (
    "draw", "after it, over the true deployment's", "worse by, m", "all of the lens, m",
    "focal length, m", "principal point, m", "distortion, m",
)  # fmt: skip
_HEIGHTS_M, _OFF_DEG = (60.0, 95.0, 125.0), (0.0, 15.0, 30.0, 40.0)
_POINTS = 400
_HOUSES, _HOUSE_M = 0.3, (3.0, 15.0)  # share of the points, and their heights
_GROUPS: dict[str, list[int]] = {
    "all": list(range(*u.OPTICS.indices(u.COUNT))),
    "focal": [u.FOCAL],
    "centre": list(range(*u.CENTRE.indices(u.COUNT))),
    "bend": list(range(*u.BEND.indices(u.COUNT))),
}


def moved_m(true: Camera, believed: Camera, height_m: float, off_deg: float, seed: int) -> float:
    """How far the believed lens puts the camera from where the true one is, m."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform((0.0, 0.0), (true.width, true.height), (_POINTS, 2))
    looks = so3_exp([np.radians(off_deg), 0.0, 0.0])
    rays = true.rays(pixels) @ looks.T
    houses = rng.uniform(size=_POINTS) < _HOUSES
    depths = height_m - np.where(houses, rng.uniform(*_HOUSE_M, _POINTS), 0.0)
    points = rays / rays[:, 2:] * depths[:, None]
    seen = believed.rays(pixels)
    seen = seen[:, :2] / seen[:, 2:]

    def off(x: Array) -> Array:
        q = (points - x[:3]) @ (so3_exp(x[3:]) @ looks)
        away: Array = (q[:, :2] / q[:, 2:] - seen).ravel() * believed.fx
        return away

    found = least_squares(off, np.zeros(6), x_scale=[1.0] * 3 + [0.01] * 3)
    return float(np.linalg.norm(found.x[:3]))


def carried_m(row: dict[str, Any], which: list[int]) -> float:
    """The median over the views, of a draw and some of the lens's numbers."""
    left = np.array(row["found"]) - np.array(row["truth"])
    of_these = np.zeros(u.COUNT)
    of_these[which] = left[which]
    true = true_camera(CameraSpec(), drawn(int(row["seed"])))
    believed = changed_camera(true, of_these)
    views = [(h, off) for h in _HEIGHTS_M for off in _OFF_DEG]
    return float(np.median([moved_m(true, believed, *v, k) for k, v in enumerate(views)]))


def main() -> None:
    p = Parser(__doc__)
    p.add_argument("folder", nargs="+", type=Path, help="of a run with its flights after it")
    p.add_argument("--json", type=output, help="the table")
    args = p.parse_args()
    rows = [r for folder in args.folder for r in read(folder / "draws.jsonl") if "again" in r]
    made = []
    for row in rows:
        found, true = (row["again"][name]["median"] for name in ("found", "true"))
        worse = float(np.sqrt(max(found**2 - true**2, 0.0)))
        carried = {name: carried_m(row, which) for name, which in _GROUPS.items()}
        made.append({"seed": row["seed"], "ratio": found / true, "worse_m": worse, **carried})
    cells = [
        (
            f"{r['seed']}", f"{r['ratio']:.2f}",
            *(f"{r[key]:.3f}" for key in ("worse_m", "all", "focal", "centre", "bend")),
        )
        for r in made
    ]  # fmt: skip
    worse_m, all_m = (np.array([r[key] for r in made]) for key in ("worse_m", "all"))
    alike = float(np.corrcoef(worse_m, all_m)[0, 1]) if len(made) > 2 else float("nan")
    cells.append(("correlation with the excess", "-", "-", f"{alike:.2f}", *["-"] * 3))
    for line in cells:
        print(*line, sep=" | ")
    if args.json:
        write_figures(args.json, COLUMNS, cells, {"draws": made, "correlation": alike})


if __name__ == "__main__":
    with named_errors():
        main()
