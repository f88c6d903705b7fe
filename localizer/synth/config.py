"""Configuration of a generated world: seed, size, and the look of one visit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from localizer.errors import MapSourceError

Variant = Literal["survey", "live"]
Character = Literal["mixed", "forest", "fields", "industrial", "dense"]

LEAF_M = 100.0  # finest tile
BLOCK_M = 200.0  # middle tile, also the unit of work of one process
TOP_M = 400.0  # coarse tile below the root
LEAF_GSD_M = 0.125  # texel size of the finest tiles
TERRAIN_SPACING_M = 5.0


@dataclass(frozen=True)
class WorldConfig:
    """A world's geometry. relief_m: None: derived from size and seed.

    character: use of nearly all cells; mixed: a town surrounded by open country.
    """

    seed: int
    size_m: float = 1600.0
    relief_m: float | None = None
    geoid_separation_m: float = 47.5
    character: Character = "mixed"

    def __post_init__(self) -> None:
        if self.size_m < TOP_M or self.size_m % TOP_M:
            raise MapSourceError(
                f"world size must be a positive multiple of {TOP_M:.0f} m, got {self.size_m}"
            )

    def rng(self, *key: int) -> np.random.Generator:
        """An independent generator for one part of the world; the same one for the same key."""
        return np.random.default_rng([self.seed, *key])

    @property
    def half_m(self) -> float:
        """Half the side length; the world spans [-half, half] east and north."""
        return self.size_m / 2


@dataclass(frozen=True)
class VisitLook:
    """Light, season and movable objects at one visit.

    Sun angles in degrees (azimuth clockwise from north); `sun_rgb` and `sky_rgb` are the irradiance
    of a surface that faces the sun, and of one that sees the whole sky, 1 = albedo as painted.
    `dryness` bleaches grass, `crop` moves fields from soil (0) over green (0.5) to ripe (1),
    `leaf` moves foliage from fresh (0) to autumn (1). `occupancy` is the share of parking slots in
    use and `parking_seed` says which. `changed_buildings` is the share of buildings that the map
    has and this visit does not.
    """

    sun_azimuth_deg: float = 150.0
    sun_elevation_deg: float = 52.0
    sun_rgb: tuple[float, float, float] = (0.92, 0.88, 0.80)
    sky_rgb: tuple[float, float, float] = (0.33, 0.36, 0.42)
    dryness: float = 0.15
    crop: float = 0.45
    leaf: float = 0.25
    occupancy: float = 0.6
    parking_seed: int = 1
    changed_buildings: float = 0.0

    @property
    def sun_direction(self) -> np.ndarray:
        """Unit vector (3,) from the ground to the sun, ENU."""
        az, el = np.radians([self.sun_azimuth_deg, self.sun_elevation_deg])
        return np.array([np.sin(az) * np.cos(el), np.cos(az) * np.cos(el), np.sin(el)])


SURVEY = VisitLook()
LIVE = VisitLook(
    sun_azimuth_deg=238.0,
    sun_elevation_deg=38.0,
    sun_rgb=(1.02, 0.92, 0.76),
    sky_rgb=(0.28, 0.32, 0.40),
    dryness=0.45,
    crop=0.75,
    leaf=0.45,
    occupancy=0.5,
    parking_seed=2,
)


def look_of(variant: Variant) -> VisitLook:
    """The default look of a variant."""
    return {"survey": SURVEY, "live": LIVE}[variant]
