"""One image without a prior: found on the whole map, with roll, pitch and height reported.

Each image is also searched on a map that does not hold its place: nothing may be found there.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.real.judged import HEIGHT_SIGMA_M
from benchmarks.real.sets import RealView
from localizer.config import LocalizerConfig
from localizer.evaluation.places import SimulatedPlaceData
from localizer.geometry.pose import Pose
from localizer.map.cache.cache import TileCache
from localizer.relocalization.relocalizer import Relocalizer, open_relocalizer
from localizer.types import Frame

TILT_SIGMA_DEG = 1.0


@dataclass(frozen=True)
class SearchedImage:
    """away: on a map without the place. found: whether there was an answer; horizontal_m: its
    error, inf where the place is not on the map; seconds: on one core.
    """

    set: str
    image: int
    away: bool
    found: bool
    horizontal_m: float
    seconds: float


def searched_images(
    name: str, views: Sequence[RealView], elsewhere: Path | None, width: int,
    progress: Callable[[], None] = lambda: None,
) -> Iterator[SearchedImage]:  # fmt: skip
    """Of every image of a set that has one map. elsewhere: a map without its places, or None."""
    known = SimulatedPlaceData(False, False, TILT_SIGMA_DEG, HEIGHT_SIGMA_M, seed=7)
    config = LocalizerConfig(width=width, renderer="numba")
    for cache in [views[0].map_cache, *([elsewhere] if elsewhere is not None else [])]:
        away = cache != views[0].map_cache
        opened = open_relocalizer(TileCache.open(cache), config)
        assert opened is not None  # nobody asks it to stop
        with opened as relocalizer:
            rise = _ground(relocalizer) - _ground_below(views) if away else 0.0
            for k, view in enumerate(views):
                frame = Frame(view.image(), (k + 1) * 10**9, view.camera, k)
                place = view.truth.translation + np.array([0.0, 0.0, rise])
                query = known.query(frame, Pose(view.truth.rotation, place), k)
                began = time.perf_counter()
                found = relocalizer.find(query)
                seconds = time.perf_counter() - began
                progress()
                error = np.inf
                if found is not None and not away:
                    off = found.world_from_camera.translation - view.truth.translation
                    error = float(np.hypot(*off[:2]))
                yield SearchedImage(name, k, away, found is not None, error, seconds)


def _ground(relocalizer: Relocalizer) -> float:
    return float(np.nanmedian(relocalizer.overview.levels[0].ground))


def _ground_below(views: Sequence[RealView]) -> float:
    """World z of the ground of the set's own map."""
    opened = open_relocalizer(TileCache.open(views[0].map_cache), LocalizerConfig())
    assert opened is not None  # nobody asks it to stop
    with opened as own:
        return _ground(own)
