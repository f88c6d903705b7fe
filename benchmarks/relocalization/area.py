"""Searches of a large region that holds a known place: rank of the place, cost by area, one thread.

    python -m benchmarks.relocalization.area --place quito --km2 100 --heading unknown --views 3
    python -m benchmarks.relocalization.area --report area.json [--json table.json]

The region is the overview of one world of `python -m benchmarks.basin`, repeated and mirrored until
it has the area: each piece of ground exists many times, so as many different places would hide the
place better. In its middle is the place's overview in the region's principal components, at the
region's height. Place: another generated world, or a set of `python -m benchmarks.real`. Index: the
overview, on disk. Memory: the process's peak. A run adds to the file --out and goes on after it.
"""

from __future__ import annotations

import json
import multiprocessing
import resource
import shutil
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.basin.views import VIEWS_PER_WORLD, load_views
from benchmarks.common.arguments import Parser, existing, number, output, whole
from benchmarks.common.figures import show_figures
from benchmarks.common.named_errors import named_errors
from benchmarks.real.sets import SETS, RealView, load
from benchmarks.relocalization.run import rank_of
from localizer.config import LocalizerConfig
from localizer.evaluation.places import SimulatedPlaceData
from localizer.map.cache.cache import TileCache
from localizer.relocalization.overview import (
    GROUND_CELLS,
    MapOverview,
    OverviewLevel,
    write_level,
)
from localizer.relocalization.relocalizer import OpenRelocalizer, open_relocalizer
from localizer.types import Frame

_SIDE_M = 768.0  # of a world: whole ground samples at every level
_UNIT_M = 128.0  # the place's corner: likewise
COLUMNS = (
    "km²", "heading", "place", "searches", "first", "among 97", "CPU s", "CPU s a km²",
    "index, MB a km²", "memory, MB",
)  # fmt: skip


@dataclass(frozen=True)
class AreaSearch:
    """One search. rank: of the first candidate that shows the place, -1 without; index_mb: of the
    overview; peak_mb: of the process so far.
    """

    place: str
    area_km2: float
    heading_known: bool
    rank: int
    cpu_s: float
    index_mb: float
    peak_mb: float


def repeated(level: OverviewLevel, side_m: float) -> OverviewLevel:
    """A level of a square of `side_m`, of mirrored copies of this one's first `_SIDE_M`."""
    one = round(_SIDE_M / level.cell_m)
    cells = round(side_m / level.cell_m / GROUND_CELLS) * GROUND_CELLS

    def wrapped(values: np.ndarray, total: int) -> np.ndarray:
        edge = (0, total - values.shape[-1])
        return np.pad(values, [(0, 0)] * (values.ndim - 2) + [edge, edge], mode="symmetric")

    n = one // GROUND_CELLS
    return replace(
        level,
        features=wrapped(level.features[:, :one, :one], cells),
        ground=wrapped(level.ground[:n, :n], cells // GROUND_CELLS),
    )


def hidden(place: OverviewLevel, hay: OverviewLevel, corner_m: float) -> OverviewLevel:
    """`hay` with the known ground of the place from `corner_m` off its north-west corner on, in the
    place's coordinates and at its height.
    """
    first = round(corner_m / hay.cell_m)
    ground, features = hay.ground.copy(), hay.features[:, :, :].copy()
    ground += np.nanmedian(place.ground) - np.nanmedian(ground)
    at, coarse = first, first // GROUND_CELLS
    below = ground[coarse : coarse + len(place.ground), coarse:][:, : place.ground.shape[1]]
    mine = place.ground[: below.shape[0], : below.shape[1]]
    known = np.isfinite(mine)
    below[known] = mine[known]
    fine = known.repeat(GROUND_CELLS, 0).repeat(GROUND_CELLS, 1)
    into = hay.projection.basis.T @ place.projection.basis
    for channel, row in zip(features, into, strict=True):
        values = np.tensordot(row, place.features[:, : fine.shape[0], : fine.shape[1]], 1)
        window = channel[at : at + fine.shape[0], at : at + fine.shape[1]]
        window[fine] = np.rint(values).clip(-127, 127).astype(np.int8)[fine]
    return replace(
        hay,
        features=features,
        ground=ground,
        west=place.west - first * hay.cell_m,
        north=place.north + first * hay.cell_m,
    )


def opened(cache: Path) -> OpenRelocalizer:
    """The relocalizer of a map, with the overview that is beside it."""
    found = open_relocalizer(TileCache.open(cache), LocalizerConfig())
    if found is None:
        raise RuntimeError("an overview that nobody stopped was not made")
    return found


def hide(place: Path, hay: Path, side_m: float, folder: Path) -> None:
    """Make `folder`: the place's tiles, and an overview of the whole region."""
    new = folder.with_suffix(".new")
    shutil.rmtree(new, ignore_errors=True)
    with opened(place) as p, opened(hay) as h:
        shutil.copytree(place, new, ignore=shutil.ignore_patterns("overview"))
        extent = p.overview.levels[-1].shape[0] * p.overview.levels[-1].cell_m
        corner_m = max(0.0, (side_m - extent) / 2 // _UNIT_M * _UNIT_M)
        for mine, around in zip(p.overview.levels, h.overview.levels, strict=True):
            level = hidden(mine, repeated(around, side_m), corner_m)
            path = new / "overview" / p.overview.key / f"{level.gsd_m:g}.safetensors"
            write_level(path, level)
    new.rename(folder)


def hide_apart(place: Path, hay: Path, side_m: float, folder: Path) -> None:
    """As `hide`, unless the folder exists; in another process, for the region as arrays is no part
    of the memory that a search takes.
    """
    if not folder.exists():
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as other:
            other.submit(hide, place, hay, side_m, folder).result()


def views_of(place: str, cache: Path, data: Path) -> list[RealView]:
    """The views of a place, of its first map; of another world than the region's."""
    if place == "generated":
        made = load_views(place, cache, data, 2 * VIEWS_PER_WORLD)[VIEWS_PER_WORLD:]
        return [RealView(v.map_cache, v.camera, v.truth, v.condition, rgb=v.query) for v in made]
    views = load(place, cache, data)
    return [v for v in views if v.map_cache == views[0].map_cache]


def search(
    view: RealView, index: int, place: str, open_map: OpenRelocalizer, heading: bool
) -> AreaSearch:
    """One search of the region."""
    relocalizer = open_map.relocalizer
    overview: MapOverview = relocalizer.overview
    known = SimulatedPlaceData(prior=False, heading=heading, seed=5)
    query = known.query(Frame(view.image(), 1, view.camera, index), view.truth, index)
    ground = float(np.nanmedian(overview.levels[0].ground))
    began = time.process_time()
    candidates = relocalizer.search(query)
    cpu_s = time.process_time() - began
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    height = float(view.truth.translation[2]) - ground
    rank = rank_of(candidates, view.truth, height)
    return AreaSearch(
        place, overview.area_km2, heading, rank, cpu_s, overview.nbytes / 1e6, peak
    )  # fmt: skip


def cells(found: list[AreaSearch]) -> list[tuple[str, ...]]:
    """A line for each area, heading and place: medians, and the highest memory."""
    lines: list[tuple[str, ...]] = []
    for area, unknown, place in sorted(
        {(round(a.area_km2), not a.heading_known, a.place) for a in found}
    ):
        some = [
            a for a in found
            if (round(a.area_km2), not a.heading_known, a.place) == (area, unknown, place)
        ]  # fmt: skip
        cpu = float(np.median([a.cpu_s for a in some]))
        lines.append((
            str(area), "unknown" if unknown else "15°", place, str(len(some)),
            str(sum(a.rank == 0 for a in some)), str(sum(a.rank >= 0 for a in some)),
            f"{cpu:.2f}", f"{cpu / some[0].area_km2:.2f}",
            f"{some[0].index_mb / some[0].area_km2:.1f}", f"{max(a.peak_mb for a in some):.0f}",
        ))  # fmt: skip
    return lines


def main() -> None:
    p = Parser(__doc__)
    p.add_argument("--place", choices=("generated", *SETS), default="generated", help="hidden")
    p.add_argument("--km2", type=number(1, 400), default=1.0, help="area")
    p.add_argument("--heading", choices=("known", "unknown"), default="known", help="to 15 degrees")
    p.add_argument("--views", type=whole(1, 40), default=3, help="how many in all")
    p.add_argument("--cache", type=Path, default=Path(".cache/basin"), help="of views and maps")
    p.add_argument("--data", type=Path, default=Path("../shared/data"), help="real sets")
    p.add_argument("--out", type=output, default=Path("area.json"), help="JSON of every search")
    p.add_argument("--report", type=existing, help="table of an earlier file, no run")
    p.add_argument("--json", type=output, help="the table")
    args = p.parse_args()
    path = args.report or args.out
    found = [AreaSearch(**x) for x in json.loads(path.read_text())] if path.exists() else []
    if not args.report:
        known, side_m = args.heading == "known", 1000.0 * args.km2**0.5
        views = views_of(args.place, args.cache, args.data)
        hay = load_views("generated", args.cache, args.data, 1)[0].map_cache
        folder = args.cache / "area" / f"{args.place}-{args.km2:g}"
        hide_apart(views[0].map_cache, hay, side_m, folder)
        kind = (args.place, known, round(args.km2))
        done = sum((a.place, a.heading_known, round(a.area_km2)) == kind for a in found)
        open_map = opened(folder)
        with open_map:
            for k in range(done, min(args.views, len(views))):
                found.append(search(views[k], k, args.place, open_map, known))
                args.out.write_text(json.dumps([asdict(a) for a in found], indent=1))
    show_figures(args.json, COLUMNS, cells(found))


if __name__ == "__main__":
    with named_errors():
        main()
