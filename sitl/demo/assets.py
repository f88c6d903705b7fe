"""What a flight needs on disk: the world as surveyed and as it is today, and the caches of both.

By default what is flown over is another visit than the survey, with what changes between two visits
and with a survey's own errors. The ideal world differs from its map by light, season and cars only.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from localizer.map.building.build import build_cache
from localizer.map.cache.cache import TileCache
from localizer.synth.config import Character, WorldConfig, look_of
from localizer.synth.visits.visit import Visit, surveyed_and_lived
from localizer.synth.world import WorldInfo, build_visits

# Raised when generated worlds change, so that old ones are not flown by mistake.
_GENERATION, _IDEAL_GENERATION = 2, 1


@dataclass(frozen=True)
class FlightAssets:
    """A world on disk. map_cache: what the companion gets; live_cache: what its camera sees."""

    world: WorldInfo
    map_cache: Path
    live_cache: Path


def default_folder() -> Path:
    """Where worlds are kept: PILOT_CACHE, else the user's cache folder."""
    base = os.environ.get("PILOT_CACHE")
    if base:
        return Path(base)
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "pilot-companion"


def prepare(
    seed: int,
    folder: Path | None = None,
    say: Callable[[str], None] = lambda _: None,
    size_m: float = 1600.0,
    ideal: bool = False,
    character: Character = "mixed",
) -> FlightAssets:
    """Build what is missing of a world, by the importer that users use; the rest is reused.

    ideal: the map shares geometry and fine texture with what is flown over.
    """
    generation = _IDEAL_GENERATION if ideal else _GENERATION
    name = f"world-{generation}-{seed}-{size_m:.0f}"
    home = (folder or default_folder()) / (name if character == "mixed" else f"{name}-{character}")
    done = home / "complete"
    survey, live = home / "survey", home / "live"
    if not done.exists():
        shutil.rmtree(home, ignore_errors=True)
        home.mkdir(parents=True)
        say(f"generating world {seed} (a few minutes, once)")
        config = WorldConfig(seed, size_m, character=character)
        if ideal:
            then, now = Visit("survey", look_of("survey")), Visit("live", look_of("live"))
        else:
            then, now = surveyed_and_lived(config)
        visits = {survey: then, live: now}
        build_visits(config, visits)
        for visit in visits:
            say(f"importing the {visit.name} tileset")
            build_cache(visit / "tileset.json", home / f"{visit.name}-cache")
        done.touch()
    caches = (home / "survey-cache", home / "live-cache")
    for cache in caches:
        TileCache.open(cache)  # a damaged cache is named before the flight, not in it
    return FlightAssets(WorldInfo.load(survey), *caches)
