"""One search per view: what was found, what was accepted, what it cost."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.basin.views import BasinView
from benchmarks.common.shares import exact_interval
from localizer.config import LocalizerConfig
from localizer.evaluation.places import SimulatedPlaceData
from localizer.geometry.pose import Array, Pose
from localizer.map.cache.cache import TileCache
from localizer.relocalization.relocalizer import OpenRelocalizer, open_relocalizer
from localizer.relocalization.types import PlaceCandidate
from localizer.types import Frame

NEAR_M = 15.0  # from which a registration finds the place
RIGHT_M, RIGHT_DEG = 3.0, 3.0


@dataclass(frozen=True)
class ViewOutcome:
    """One view. rank: of the first candidate that shows the place, -1 without; found: accepted and
    right; false: accepted and not right; area_km2: of the map; cpu_s, wall_s: of the whole search.
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


@dataclass(frozen=True)
class ViewSearch:
    """What is asked. name: of the views' set; on: another place's map, where no view is."""

    name: str
    config: LocalizerConfig
    heading_known: bool
    seed: int
    on: Path | None = None


def run(asked: ViewSearch, views: Sequence[BasinView], first: int) -> Iterator[ViewOutcome]:
    """Every view from number `first` on, on the whole map of its own place or of another."""
    known = SimulatedPlaceData(prior=False, heading=asked.heading_known, seed=asked.seed)
    maps: dict[Path, OpenRelocalizer] = {}
    try:
        for k, view in enumerate(views[first:], first):
            cache = asked.on or view.map_cache
            if cache not in maps:
                opened = open_relocalizer(TileCache.open(cache), asked.config)
                if opened is None:
                    raise RuntimeError("an overview that nobody stopped was not made")
                maps[cache] = opened
            yield _one(asked, view, maps[cache], known, k)
    finally:
        for opened in maps.values():
            opened.close()


def _one(
    asked: ViewSearch, view: BasinView, opened: OpenRelocalizer, known: SimulatedPlaceData, k: int
) -> ViewOutcome:
    relocalizer = opened.relocalizer
    truth = view.truth
    if asked.on is not None:  # as high above that map's ground as it was above its own
        ground = float(np.nanmedian(relocalizer.overview.levels[0].ground))
        truth = replace(truth, translation=np.array([0.0, 0.0, ground + view.height]))
    query = known.query(Frame(view.query, 1, view.camera, k), truth, k)
    wall, cpu = time.perf_counter(), time.process_time()
    candidates = relocalizer.search(query)
    searched = time.process_time()
    found = relocalizer.confirm(query, candidates)
    verified, wall = time.process_time(), time.perf_counter() - wall
    right, error, rank = False, None, -1
    if asked.on is None:
        rank = rank_of(candidates, view.truth, view.height)
        if found is not None:
            metres, degrees = found.world_from_camera.distance_to(view.truth)
            right, error = metres <= RIGHT_M and degrees <= RIGHT_DEG, metres
    name = asked.name if asked.on is None else f"{asked.name}, not on this map"
    return ViewOutcome(
        name, known.heading, view.condition, view.height, relocalizer.overview.area_km2,
        rank, right, found is not None and not right, error,
        None if found is None else found.quality,
        searched - cpu, verified - searched, wall,
    )  # fmt: skip


def rank_of(candidates: Sequence[PlaceCandidate], truth: Pose, height_m: float) -> int:
    """Of the first candidate that looks at the ground within `NEAR_M` of what the view shows; -1
    without. What lies ahead is found, and the camera follows with its heading's error.
    """
    aim = _aim(truth, height_m)
    aims = np.array([_aim(c.world_from_camera, height_m) for c in candidates]).reshape(-1, 2)
    near = np.linalg.norm(aims - aim, axis=1) <= NEAR_M
    return int(np.argmax(near)) if near.any() else -1


def _aim(pose: Pose, height_m: float) -> Array:
    """East and north (2,) of the ground in the image's middle."""
    axis = pose.rotation[:, 2]
    place: Array = pose.translation[:2] + axis[:2] * height_m / max(-axis[2], 0.2)
    return place


COLUMNS = (
    "set", "heading", "condition", "frames", "candidates hold it", "found and confirmed", "false",
    "CPU s: search, confirm", "wall s",
)  # fmt: skip


def cells(outcomes: Sequence[ViewOutcome]) -> list[tuple[str, ...]]:
    """One line per condition and for all, each with the exact interval."""
    rows = []
    for name, known in dict.fromkeys((o.set, o.heading_known) for o in outcomes):
        mine = [o for o in outcomes if (o.set, o.heading_known) == (name, known)]
        for condition in [*dict.fromkeys(o.condition for o in mine), "all"]:
            some = [o for o in mine if condition in (o.condition, "all")]
            rows.append(_row(name, known, condition, some))
    return rows


def _row(name: str, known: bool, condition: str, some: Sequence[ViewOutcome]) -> tuple[str, ...]:
    n, hits = len(some), sum(o.found for o in some)
    low, high = exact_interval(hits, n)
    cpu, confirm, wall = (
        float(np.median([getattr(o, k) for o in some]))
        for k in ("search_cpu_s", "verify_cpu_s", "wall_s")
    )
    return (
        name, "15°" if known else "unknown", condition, str(n), str(sum(o.rank >= 0 for o in some)),
        f"{hits} ({low:.0f} to {high:.0f} %)", str(sum(o.false for o in some)),
        f"{cpu:.2f}, {confirm:.2f}", f"{wall:.2f}",
    )  # fmt: skip


def with_threads(config: LocalizerConfig, threads: int) -> LocalizerConfig:
    """The configuration with so many threads for a search."""
    places = replace(config.relocalization, threads=threads)
    return config.model_copy(update={"relocalization": places})
