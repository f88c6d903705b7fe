"""What the plan of a world holds: the result of `layout.plan_world`."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array
from localizer.synth.buildings.model import Building
from localizer.synth.config import WorldConfig
from localizer.synth.paint.ground_plan import PlanShape, Regions
from localizer.synth.plan.terrain import Terrain


class Zone(Enum):
    """Use of a lattice cell."""

    CENTRE = "centre"
    HOUSES = "houses"
    BLOCKS = "blocks"
    INDUSTRY = "industry"
    PARK = "park"
    SPORTS = "sports"
    CARPARK = "carpark"
    CHURCH = "church"
    FIELD = "field"
    FOREST = "forest"
    MEADOW = "meadow"
    ORCHARD = "orchard"
    FARM = "farm"
    RIVERSIDE = "riverside"


URBAN = {Zone.CENTRE, Zone.HOUSES, Zone.BLOCKS, Zone.INDUSTRY, Zone.PARK, Zone.SPORTS,
         Zone.CARPARK, Zone.CHURCH}  # fmt: skip


@dataclass(frozen=True)
class Trees:
    """Arrays of length N: position (N, 2) ENU, crown radius, height, species (0 broadleaf,
    1 conifer, 2 fruit tree or shrub), dense (stands in a wood: simpler mesh), seed.
    """

    xy: Array
    radius: Array
    height: Array
    species: NDArray[np.int64]
    dense: NDArray[np.bool_]
    seed: NDArray[np.int64]


@dataclass(frozen=True)
class Hedge:
    """A straight hedge from `a` to `b` (2,), metres."""

    a: Array
    b: Array
    width: float
    height: float
    seed: int


@dataclass(frozen=True)
class PlannedTarget:
    """A named static point on a surface, ENU metres (3,)."""

    name: str
    position: Array


@dataclass(frozen=True)
class WorldPlan:
    """Everything static, before it is meshed and painted. slots: (N, 4) parking places: x, y,
    heading, readiness (share of visits at which it tends to be taken). sites: free ground where
    something may be built later."""

    config: WorldConfig
    terrain: Terrain
    regions: Regions
    shapes: list[PlanShape]
    buildings: list[Building]
    trees: Trees
    hedges: list[Hedge]
    slots: Array
    targets: tuple[PlannedTarget, ...]
    roads: tuple[Array, ...]
    sites: tuple[Building, ...] = ()
