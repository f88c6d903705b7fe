"""Files of a simulated flight: map cache (survey) and live cache (what the camera sees).

By default the live world has changed since the survey, and the survey has errors. The ideal world
differs from its map by light, season and cars only.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from localizer.map.building.build import build_cache
from localizer.map.cache.cache import TileCache
from localizer.synth.config import Character, WorldConfig, look_of
from localizer.synth.visits.visit import Visit, survey_and_flight_visits
from localizer.synth.world import WorldInfo, build_visits
from sitl.demo.satellite import build_satellite_map
from sitl.demo.scenario import SatelliteMap

# Raised when generated worlds change, so that old ones are not flown by mistake.
_GENERATION, _IDEAL_GENERATION = 2, 1
_PAINTED = 0.8  # of the time that a world takes, its two imports being the rest


@dataclass(frozen=True)
class FlightAssets:
    """A generated world. map_cache: the companion's map; live_cache: what the camera sees."""

    world: WorldInfo
    map_cache: Path
    live_cache: Path


def _import(folder: Path, progress: Callable[[float], None], number: int) -> None:
    """Import a visit's tileset (`folder`) into the cache beside it. progress: receives the share
    done. number: 0 or 1, which of the two imports this is.
    """
    each = (1.0 - _PAINTED) / 2
    begun = _PAINTED + each * number
    build_cache(
        folder / "tileset.json",
        folder.with_name(f"{folder.name}-cache"),
        progress=lambda done, total: progress(begun + each * done / max(total, 1)),
    )


def default_folder() -> Path:
    """Folder of generated worlds: PILOT_CACHE, otherwise the user's cache folder."""
    base = os.environ.get("PILOT_CACHE")
    if base:
        return Path(base)
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "pilot-companion"


def prepare(
    seed: int,
    folder: Path | None = None,
    progress: Callable[[str, float], None] = lambda _phase, _share: None,
    size_m: float = 1600.0,
    ideal: bool = False,
    character: Character = "mixed",
    satellite: SatelliteMap | None = None,
) -> FlightAssets:
    """Generate the world of a seed and import it as tile caches; existing parts are reused.

    folder: None: `default_folder`. ideal: map and live world have the same geometry and texture.
    satellite: the map is this satellite mosaic; None: the survey. progress: called with the step
    and the share done, 0 to 1; not called if nothing is missing.
    """
    generation = _IDEAL_GENERATION if ideal else _GENERATION
    name = f"world-{generation}-{seed}-{size_m:.0f}"
    home = (folder or default_folder()) / (name if character == "mixed" else f"{name}-{character}")
    done = home / "complete"
    survey, live = home / "survey", home / "live"
    if not done.exists():
        shutil.rmtree(home, ignore_errors=True)
        home.mkdir(parents=True)
        config = WorldConfig(seed, size_m, character=character)
        if ideal:
            then, now = Visit("survey", look_of("survey")), Visit("live", look_of("live"))
        else:
            then, now = survey_and_flight_visits(config)
        visits = {survey: then, live: now}
        generating = f"generating world {seed} (a few minutes, once)"
        progress(generating, 0.0)
        build_visits(config, visits, progress=lambda share: progress(generating, _PAINTED * share))
        for number, visit in enumerate(visits):
            _import(visit, partial(progress, f"importing the {visit.name} tileset"), number)
        done.touch()
    caches = (home / "survey-cache", home / "live-cache")
    world = WorldInfo.load(survey)
    if satellite is not None:
        caches = (home / f"{satellite.name}-cache", caches[1])
        if not caches[0].exists():
            painting = "painting the satellite map"
            build_satellite_map(
                world, home / "survey-cache", satellite, caches[0], partial(progress, painting)
            )
    for cache in caches:
        TileCache.open(cache)  # a damaged cache is named before the flight, not in it
    return FlightAssets(world, *caches)
