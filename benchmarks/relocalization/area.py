"""Cost of a search by area: generated ground laid side by side, one thread.

    python -m benchmarks.relocalization.area --km2 1 --heading known --views 3 --out area.json
    python -m benchmarks.relocalization.area --report area.json [--json table.json]

The overview of one world of `python -m benchmarks.basin` is repeated, mirrored, until it has the
area: what ground of that size costs, not how often a place is found on it. Index: the overview.
Memory: the process's peak, with index, network and program. A run with --out adds to the file.
"""

from __future__ import annotations

import json
import resource
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.basin.views import load_views
from benchmarks.common.arguments import Parser, existing, number, output, whole
from benchmarks.common.figures import show_figures
from benchmarks.common.named_errors import named_errors
from localizer.config import LocalizerConfig
from localizer.evaluation.places import SimulatedPlaceData
from localizer.map.cache.cache import TileCache
from localizer.relocalization.correlate import LevelCorrelator
from localizer.relocalization.overview import GROUND_CELLS, MapOverview, OverviewLevel
from localizer.relocalization.relocalizer import open_relocalizer
from localizer.relocalization.search import SearchView, search
from localizer.types import Frame

_SIDE_M = 768.0  # of a world: whole ground samples at every level
COLUMNS = ("km²", "heading", "searches", "CPU s", "CPU s a km²", "index, MB a km²", "memory, MB")


@dataclass(frozen=True)
class AreaSearch:
    """One search. index_mb: of the overview; peak_mb: of the process so far."""

    area_km2: float
    heading_known: bool
    cpu_s: float
    index_mb: float
    peak_mb: float


def repeated(level: OverviewLevel, side_m: float) -> OverviewLevel:
    """A level of a square of `side_m`, of mirrored copies of this one's first `_SIDE_M`."""
    one = round(_SIDE_M / level.cell_m)
    cells = round(side_m / level.cell_m / GROUND_CELLS) * GROUND_CELLS

    def wrapped(values: np.ndarray, n: int, total: int) -> np.ndarray:
        inside = values[..., :n, :n]
        edge = (0, total - n)
        return np.pad(inside, [(0, 0)] * (values.ndim - 2) + [edge, edge], mode="symmetric")

    return replace(
        level,
        features=wrapped(level.features, one, cells),
        ground=wrapped(level.ground, one // GROUND_CELLS, cells // GROUND_CELLS),
    )


def measured(folder: Path, data: Path, side_m: float, count: int, known: bool) -> list[AreaSearch]:
    """The first views of the first generated world, each searched once."""
    views = load_views("generated", folder, data, count)
    config = LocalizerConfig()
    place = SimulatedPlaceData(prior=False, heading=known, seed=5)
    opened = open_relocalizer(TileCache.open(views[0].map_cache), config)
    if opened is None:
        raise RuntimeError("an overview that nobody stopped was not made")
    with opened as relocalizer:
        levels = tuple(repeated(x, side_m) for x in relocalizer.overview.levels)
        overview = MapOverview(levels, "repeated")
        budget = config.relocalization.spectra_mib * 2**20
        correlators = tuple(LevelCorrelator(x, budget) for x in levels)
        correlators[0].warm_up()
        found = []
        for k, view in enumerate(views):
            query = place.query(Frame(view.query, 1, view.camera, k), view.truth, k)
            began = time.process_time()
            search(SearchView(view.query, view.camera), query, correlators,
                   relocalizer.extractor, config.relocalization)  # fmt: skip
            cpu_s = time.process_time() - began
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            found.append(AreaSearch(overview.area_km2, known, cpu_s, overview.nbytes / 1e6, peak))
    return found


def cells(found: list[AreaSearch]) -> list[tuple[str, ...]]:
    """A line for each area and heading: medians, and the highest memory."""
    lines: list[tuple[str, ...]] = []
    for area, unknown in sorted({(a.area_km2, not a.heading_known) for a in found}):
        some = [a for a in found if (a.area_km2, a.heading_known) == (area, not unknown)]
        cpu = float(np.median([a.cpu_s for a in some]))
        lines.append((
            f"{area:.1f}", "unknown" if unknown else "15°", str(len(some)), f"{cpu:.2f}",
            f"{cpu / area:.2f}", f"{some[0].index_mb / area:.1f}",
            f"{max(a.peak_mb for a in some):.0f}",
        ))  # fmt: skip
    return lines


def main() -> None:
    p = Parser(__doc__)
    p.add_argument("--km2", type=number(0.1, 400), default=1.0, help="area")
    p.add_argument("--heading", choices=("known", "unknown"), default="known", help="to 15 degrees")
    p.add_argument("--views", type=whole(1, 40), default=3, help="how many")
    p.add_argument("--cache", type=Path, default=Path(".cache/basin"), help="of views and maps")
    p.add_argument("--data", type=Path, default=Path("../shared/data"), help="real sets")
    p.add_argument("--out", type=output, default=Path("area.json"), help="JSON of every search")
    p.add_argument("--report", type=existing, help="table of an earlier file, no run")
    p.add_argument("--json", type=output, help="the table")
    args = p.parse_args()
    path = args.report or args.out
    found = [AreaSearch(**x) for x in json.loads(path.read_text())] if path.exists() else []
    if not args.report:
        side_m = 1000.0 * args.km2**0.5
        found += measured(args.cache, args.data, side_m, args.views, args.heading == "known")
        args.out.write_text(json.dumps([asdict(a) for a in found], indent=1))
    show_figures(args.json, COLUMNS, cells(found))


if __name__ == "__main__":
    with named_errors():
        main()
