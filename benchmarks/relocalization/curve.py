"""What a search costs as the map grows: memory, disk and processor time by area.

    python -m benchmarks.relocalization.curve MAP [--areas 1 3 10] [--heading known] [--out O.json]

MAP is a tile cache. Its overview is laid side by side until it covers each area, so that the work
is real and the places are not: nothing is found here, only timed. The query is coloured noise, as
seen from 110 m above the ground: what is compared does not change the work. Processor and wall
seconds of a search, on one thread or several, the map's transforms kept as far as the budget goes.
Beyond the largest area it is linear, since every block is compared with every trial: --on-paper
draws that line.
"""

from __future__ import annotations

import json
import resource
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace

import numpy as np

from benchmarks.common.arguments import Parser, existing, number, output, whole
from benchmarks.common.named_errors import named_errors
from benchmarks.relocalization.run import with_threads
from localizer.config import LocalizerConfig
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose, so3_exp
from localizer.map.cache.cache import TileCache
from localizer.relocalization.correlate import LevelCorrelator
from localizer.relocalization.overview import OverviewLevel
from localizer.relocalization.relocalizer import Relocalizer, open_relocalizer
from localizer.relocalization.search import SearchView, search
from localizer.relocalization.types import PlaceQuery
from localizer.render.topview import DOWN
from localizer.types import Frame

_CAMERA = Camera.from_fov(480, 360, 65.0)
_HEIGHT_M = 110.0
_HEADING_RAD = np.radians(7.5)  # sigma: known to 15 degrees


@dataclass(frozen=True)
class Cost:
    """Of one search. overview_mib: on the disk and in memory, all scales; kept_mib: of the
    transforms that are kept if the budget allows; cpu_s: of the process, wall_s: beside whatever
    else runs; peak_mib: resident, of the process so far; cell_m: of the map's features. Not
    measured: on paper.
    """

    area_km2: float
    heading_known: bool
    overview_mib: float
    kept_mib: float
    blocks: int
    cpu_s: float
    wall_s: float
    peak_mib: float
    cell_m: float
    measured: bool = True
    threads: int = 1


def laid_out(level: OverviewLevel, area_km2: float) -> OverviewLevel:
    """The level beside itself until it covers so much."""
    side = np.sqrt(area_km2) * 1e3 / level.cell_m
    rows, columns = (max(1, round(side / n)) for n in level.shape)
    return replace(
        level,
        features=np.tile(level.features, (1, rows, columns)),
        ground=np.tile(level.ground, (rows, columns)),
    )


def costs(
    relocalizer: Relocalizer, query: PlaceQuery, areas: list[float], config: LocalizerConfig,
    coarser: int = 0, pool: ThreadPoolExecutor | None = None,
) -> Iterator[Cost]:  # fmt: skip
    """One search on each area, after one that fills what is kept. coarser: of the overview's scales
    the finest are left out, as a coarser first stage would.
    """
    c = config.relocalization
    view = SearchView(query.frame.image, _CAMERA)
    for area in areas:
        levels = [laid_out(x, area) for x in relocalizer.overview.levels[coarser:]]
        correlators = tuple(LevelCorrelator(x, c.spectra_mib * 2**20) for x in levels)
        one = replace(query, heading_sigma_rad=1e-3)
        search(view, one, correlators, relocalizer.extractor, c)
        wall, cpu = time.perf_counter(), time.process_time()
        search(view, query, correlators, relocalizer.extractor, c, pool=pool)
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
        blocks = len(correlators[0].blocks())
        yield Cost(
            float(np.prod(levels[0].shape)) * levels[0].cell_m ** 2 / 1e6,
            query.heading_sigma_rad is not None,
            sum(x.features.nbytes + x.ground.nbytes for x in levels) / 2**20,
            blocks * levels[0].features.shape[0] * 256 * 129 * 8 / 2**20,
            blocks,
            cpu,
            wall,
            resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            levels[0].cell_m,
            threads=c.threads,
        )


def on_paper(costs: list[Cost], area_km2: float) -> Cost:
    """A larger area, by the straight line through the two largest of the measured ones."""
    a, b = sorted(costs, key=lambda c: c.area_km2)[-2:]
    share = (area_km2 - b.area_km2) / (b.area_km2 - a.area_km2)

    def at(name: str) -> float:
        low, high = float(getattr(a, name)), float(getattr(b, name))
        return high + share * (high - low)

    return Cost(
        area_km2, b.heading_known, at("overview_mib"), at("kept_mib"), round(at("blocks")),
        at("cpu_s"), at("wall_s"), at("peak_mib"), b.cell_m, measured=False,
    )  # fmt: skip


def line(cost: Cost) -> str:
    """For the reader."""
    return (
        f"{cost.area_km2:.2f} km2{'' if cost.measured else ' (on paper)'}: overview "
        f"{cost.overview_mib:.0f} MiB, transforms {cost.kept_mib:.0f} MiB, process "
        f"{cost.peak_mib:.0f} MiB, {cost.blocks} blocks, {cost.cpu_s:.2f} s of processor, "
        f"{cost.wall_s:.2f} s"
    )


def main() -> None:
    p = Parser(__doc__)
    p.add_argument("map", type=existing, help="tile cache")
    p.add_argument(
        "--areas", nargs="+", type=number(0.01, 1000), default=[1.0, 3.0, 10.0], help="km2"
    )
    p.add_argument(
        "--heading", choices=("known", "unknown"), default="known", help="to 15 degrees, or not"
    )
    p.add_argument("--on-paper", type=number(0.01, 1e5), default=100.0, help="km2, extrapolated")
    p.add_argument("--coarser", type=whole(0, 2), default=0, help="finest scales to leave out")
    p.add_argument("--spectra-mib", type=whole(0, 1 << 20), help="budget of kept transforms")
    p.add_argument("--threads", type=whole(1, 64), default=1, help="of a search")
    p.add_argument("--out", type=output, help="JSON")
    args = p.parse_args()
    config = with_threads(LocalizerConfig(), args.threads)
    if args.spectra_mib is not None:
        places = config.relocalization.model_copy(update={"spectra_mib": args.spectra_mib})
        config = config.model_copy(update={"relocalization": places})
    opened = open_relocalizer(TileCache.open(args.map), config)
    if opened is None:
        raise RuntimeError("an overview that nobody stopped was not made")
    with opened as relocalizer, ThreadPoolExecutor(args.threads) as workers:
        ground = float(np.nanmedian(relocalizer.overview.levels[0].ground))
        image = np.random.default_rng(0).integers(0, 255, (45, 60, 3)).astype(np.uint8)
        image = np.kron(image, np.ones((8, 8, 1), np.uint8))
        pose = Pose(so3_exp((np.radians(20), 0, 0)) @ DOWN, np.array([0, 0, ground + _HEIGHT_M]))
        sigma = _HEADING_RAD if args.heading == "known" else None
        query = PlaceQuery(
            Frame(image, 0, _CAMERA, 0), pose.rotation, 0.01, sigma, ground + _HEIGHT_M, 2.0
        )
        pool = workers if args.threads > 1 else None
        made = []
        for cost in costs(relocalizer, query, args.areas, config, args.coarser, pool):
            made.append(cost)
            print(line(cost), flush=True)
        if len(made) > 1 and args.on_paper > max(c.area_km2 for c in made):
            made.append(on_paper(made, args.on_paper))
            print(line(made[-1]))
        if args.out:
            args.out.write_text(json.dumps([asdict(c) for c in made], indent=1))


if __name__ == "__main__":
    with named_errors():
        main()
