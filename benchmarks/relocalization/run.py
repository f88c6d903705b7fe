"""One search per view: what was found, what was accepted, what it cost."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.basin.views import View
from benchmarks.common.shares import exact_interval
from localizer.config import LocalizerConfig
from localizer.evaluation.places import KnownOfPlace
from localizer.map.cache.cache import TileCache
from localizer.relocalization.relocalizer import OpenRelocalizer, open_relocalizer
from localizer.types import Frame

NEAR_M = 15.0  # from which a registration finds the place
RIGHT_M, RIGHT_DEG = 3.0, 3.0


@dataclass(frozen=True)
class Outcome:
    """One view. rank: of the first candidate within 15 m, -1 without; found: accepted and right;
    false: accepted and not right; area_km2: of the map; cpu_s, wall_s: of the whole search.
    """

    set: str
    heading_known: bool
    condition: str
    height_m: float
    area_km2: float
    rank: int
    found: bool
    false: bool
    error_m: float | None
    quality: float | None
    search_cpu_s: float
    verify_cpu_s: float
    wall_s: float


def run(
    name: str, views: Sequence[View], config: LocalizerConfig, *, heading_known: bool, seed: int
) -> Iterator[Outcome]:
    """Every view on the map of its own place, the whole of it."""
    known = KnownOfPlace(prior=False, heading=heading_known, seed=seed)
    maps: dict[Path, OpenRelocalizer] = {}
    try:
        for k, view in enumerate(views):
            if view.map_cache not in maps:
                opened = open_relocalizer(TileCache.open(view.map_cache), config)
                if opened is None:
                    raise RuntimeError("an overview that nobody stopped was not made")
                maps[view.map_cache] = opened
            yield _one(name, view, maps[view.map_cache], known, k)
    finally:
        for opened in maps.values():
            opened.close()


def _one(name: str, view: View, opened: OpenRelocalizer, known: KnownOfPlace, k: int) -> Outcome:
    relocalizer = opened.relocalizer
    query = known.query(Frame(view.query, 1, view.camera, k), view.truth, k)
    wall, cpu = time.perf_counter(), time.process_time()
    candidates = relocalizer.search(query)
    searched = time.process_time()
    found = relocalizer.confirm(query, candidates)
    verified, wall = time.process_time(), time.perf_counter() - wall
    places = np.array([c.world_from_camera.translation[:2] for c in candidates]).reshape(-1, 2)
    near = np.linalg.norm(places - view.truth.translation[:2], axis=1) <= NEAR_M
    right, error = False, None
    if found is not None:
        metres, degrees = found.world_from_camera.distance_to(view.truth)
        right, error = metres <= RIGHT_M and degrees <= RIGHT_DEG, metres
    return Outcome(
        name, known.heading, view.condition, view.height, relocalizer.overview.area_km2,
        int(np.argmax(near)) if near.any() else -1,
        right, found is not None and not right, error,
        None if found is None else found.quality,
        searched - cpu, verified - searched, wall,
    )  # fmt: skip


def table(outcomes: Sequence[Outcome]) -> str:
    """One line per condition and for all, each with the exact interval."""
    rows = [
        "| set | heading | condition | frames | candidates hold it | found and confirmed | false "
        "| CPU s: search, confirm | wall s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, known in dict.fromkeys((o.set, o.heading_known) for o in outcomes):
        mine = [o for o in outcomes if (o.set, o.heading_known) == (name, known)]
        for condition in [*dict.fromkeys(o.condition for o in mine), "all"]:
            some = [o for o in mine if condition in (o.condition, "all")]
            rows.append(_row(name, known, condition, some))
    return "\n".join(rows)


def _row(name: str, known: bool, condition: str, some: Sequence[Outcome]) -> str:
    n, hits = len(some), sum(o.found for o in some)
    low, high = exact_interval(hits, n)
    cpu, confirm, wall = (
        float(np.median([getattr(o, k) for o in some]))
        for k in ("search_cpu_s", "verify_cpu_s", "wall_s")
    )
    return (
        f"| {name} | {'15°' if known else 'unknown'} | {condition} | {n} "
        f"| {sum(o.rank >= 0 for o in some)} | {hits} ({low:.0f} to {high:.0f} %) "
        f"| {sum(o.false for o in some)} | {cpu:.2f}, {confirm:.2f} | {wall:.2f} |"
    )


def with_threads(config: LocalizerConfig, threads: int) -> LocalizerConfig:
    """The configuration with so many threads for a search."""
    places = config.relocalization.model_copy(update={"threads": threads})
    return config.model_copy(update={"relocalization": places})
