"""The six places: each is surveyed once, and visited twice later, kept in a folder.

The first visit has what changes between two visits; the second one is years later: another season,
and twice as much built, taken down and felled (`season`, the outdated map).
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

from localizer.map.building.build import build_cache
from localizer.map.building.options import BuildOptions
from localizer.synth.config import Character, WorldConfig
from localizer.synth.visits.visit import Changes, Visit, draw_look, survey_and_flight_visits
from localizer.synth.world import WorldInfo, build_visits

WORLD_M = 400.0
SURVEY, LIVE, OUTDATED = "survey", "live", "outdated"
_YEARS = Changes(gone=0.08, rebuilt=0.08, new=0.08, felled=0.15)


@dataclass(frozen=True)
class GeneratedPlace:
    """A generated place; the seeds are of no training, test or demo."""

    name: str
    seed: int
    character: Character = "mixed"
    relief_m: float | None = None

    @property
    def config(self) -> WorldConfig:
        """What the place is generated from."""
        return WorldConfig(self.seed, WORLD_M, self.relief_m, character=self.character)


PLACES = (
    GeneratedPlace("village", 3_100_001),
    GeneratedPlace("dense town", 3_100_002, "dense"),
    GeneratedPlace("industrial", 3_100_003, "industrial"),
    GeneratedPlace("fields", 3_100_004, "fields"),
    GeneratedPlace("forest", 3_100_005, "forest"),
    GeneratedPlace("hills", 3_100_006, relief_m=90.0),
)


@dataclass(frozen=True)
class PlaceFolder:
    """A place on disk. map_cache: what every method gets; seen_cache: what the camera sees."""

    place: GeneratedPlace
    world: WorldInfo
    map_cache: Path
    seen_cache: Path


def visits(place: GeneratedPlace) -> dict[str, Visit]:
    """The survey and both later visits, drawn from the place's seed."""
    config = place.config
    survey, live = survey_and_flight_visits(config)
    rng = config.rng(63)
    look = replace(draw_look(rng), changed_buildings=0.0)
    changes = replace(_YEARS, seed=int(rng.integers(1 << 30)))
    return {SURVEY: survey, LIVE: live, OUTDATED: Visit(OUTDATED, look, changes)}


def open_place(place: GeneratedPlace, folder: Path, seen: str, processes: int = 1) -> PlaceFolder:
    """Build what is missing of a place as seen at one visit; the rest is reused."""
    home = folder / "worlds" / f"{place.name.replace(' ', '-')}-{place.seed}"
    wanted = {name: visit for name, visit in visits(place).items() if name in (SURVEY, seen)}
    for name, visit in wanted.items():
        done = home / f"{name}.done"
        if done.exists():
            continue
        tiles = home / name
        shutil.rmtree(tiles, ignore_errors=True)
        info = build_visits(place.config, {tiles: visit}, processes)[0]
        options = BuildOptions(origin=info.origin, workers=1, overwrite=True)
        build_cache(tiles, home / f"{name}.cache", options)
        done.touch()
    info = WorldInfo.load(home / SURVEY)
    return PlaceFolder(place, info, home / f"{SURVEY}.cache", home / f"{seen}.cache")
