"""How soon the map is found again once it is back in view, from recorded flights.

    python -m benchmarks.relocalization.returned FLIGHT [FLIGHT ...] [--json out.json]

FLIGHT is the folder of a flight of `python -m sitl loop --out`: its companion.yaml, the camera's
true poses (frames.csv) and the companion's estimates. The map that the companion had is rendered,
small, at the true pose of every frame; where it begins to fill a share of the view again that a
registration needs (half) after a time with less, the seconds count from there to the first frame
that is tracked. A flight that tracked before counts as 0, one that never did as none.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.common.arguments import Parser, existing, number, output
from benchmarks.common.figures import show_figures
from benchmarks.common.named_errors import named_errors
from companion.config import load_config
from companion.offline.replay import read_estimates
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose, matrix_from_quaternion
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.render.numba_raster import NumbaRenderer

COLUMNS = ("flight", "without the map, s", "found after, s")
_SIZE = (48, 36)
_LEAST_GAP_S = 5.0  # shorter gaps are a tree's or a turn's


@dataclass(frozen=True)
class Return:
    """Of one gap. gap_s: that the map filled less than the share; found_s: from its end to the
    first tracked frame, none if there was none before the next gap or the end.
    """

    flight: str
    gap_s: float
    found_s: float | None


def returns(
    flight: str, times: Sequence[float], shares: Sequence[float], tracked: Sequence[float],
    least: float,
) -> Iterator[Return]:  # fmt: skip
    """The gaps that end. times (s), shares: of each frame's view that is on the map; tracked: times
    of the frames that were tracked.
    """
    began: float | None = None
    ends: list[tuple[float, float]] = []
    for time, share in zip(times, shares, strict=True):
        if share < least:
            began = time if began is None else began
        elif began is not None:
            if time - began >= _LEAST_GAP_S:
                ends.append((began, time))
            began = None
    for k, (start, end) in enumerate(ends):
        until = ends[k + 1][0] if k + 1 < len(ends) else np.inf
        # The tracker may see the map before it fills the share: what it tracked since the middle.
        late = [t for t in tracked if (start + end) / 2 < t < until]
        found = max(0.0, min(late) - end) if late else None
        yield Return(flight, end - start, found)


def of_flight(folder: Path, least: float) -> list[Return]:
    """Of a recorded flight."""
    config = load_config(folder / "companion.yaml")
    model = config.camera.model
    camera = Camera(model.width, model.height, model.fx, model.fy, model.cx, model.cy)
    times, shares = [], []
    with (
        TileStreamer(TileCache.open(Path(config.map))) as streamer,
        (folder / "frames.csv").open(newline="", encoding="utf-8") as file,
    ):
        renderer = NumbaRenderer(streamer, 1)
        for row in csv.DictReader(file):
            q, t = (
                np.array([float(row[k]) for k in names])
                for names in (("qw", "qx", "qy", "qz"), ("east_m", "north_m", "up_m"))
            )
            pose = Pose(matrix_from_quaternion(q), t)
            view = renderer.render(pose, camera.resized(*_SIZE), wait=True)
            times.append(1e-9 * int(row["exposure_time_ns"]))
            shares.append(float((view.depth > 0).mean()))
        renderer.close()
    estimates = read_estimates(folder / "companion" / "estimates.csv")
    tracked = [1e-9 * e.exposure_time_ns for e in estimates if e.is_tracking]
    return list(returns(folder.name, times, shares, tracked, least))


def main() -> None:
    p = Parser(__doc__)
    p.add_argument("flights", type=existing, nargs="+", metavar="FLIGHT", help="its folder")
    p.add_argument("--least", type=number(0.05, 1), default=0.5, help="share of the view")
    p.add_argument("--json", type=output, help="every return")
    args = p.parse_args()
    found = [r for folder in args.flights for r in of_flight(folder, args.least)]
    rows = [
        (r.flight, f"{r.gap_s:.1f}", "never" if r.found_s is None else f"{r.found_s:.1f}")
        for r in found
    ]
    show_figures(args.json, COLUMNS, rows, {"returns": [asdict(r) for r in found]})


if __name__ == "__main__":
    with named_errors():
        main()
