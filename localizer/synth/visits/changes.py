"""Changes since the survey: buildings and trees that were added or removed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from localizer.synth.buildings.model import Building, Kind
from localizer.synth.plan.plan import Trees, WorldPlan

_HOUSES = (Kind.GABLE, Kind.HIP, Kind.FLAT)
_REBUILT_EAVES = (0.6, 1.8)  # of the old wall height
_REBUILT_SIDE = (0.85, 1.1)  # of the old length and width: the plot is the same
_GROWTH = (1.0, 1.2)  # of a crown's radius and height, in a few years


@dataclass(frozen=True)
class Changes:
    """Shares of changed objects. gone, rebuilt, new: shares of the buildings; felled: share of the
    trees (the others have grown); soft ground gets another fine texture. seed: selects the changed
    objects.
    """

    gone: float = 0.03
    rebuilt: float = 0.03
    new: float = 0.03
    felled: float = 0.05
    seed: int = 1


def apply_changes(plan: WorldPlan, changes: Changes) -> WorldPlan:
    """The plan after the changes; ground and streets stay. The fine texture is left to the
    tiles.
    """
    rng = plan.config.rng(61, changes.seed)
    draw = rng.random(len(plan.buildings))
    buildings = []
    for building, chance in zip(plan.buildings, draw, strict=True):
        if chance < changes.gone:
            continue
        again = chance < changes.gone + changes.rebuilt
        buildings.append(_rebuilt(building, rng) if again else building)
    count = min(round(changes.new * len(plan.buildings)), len(plan.sites))
    chosen = rng.choice(len(plan.sites), count, replace=False) if count else np.zeros(0, int)
    new = [plan.sites[k] for k in np.sort(chosen)]
    trees = _grown(plan.trees, changes, new, rng)
    return replace(plan, buildings=buildings + new, trees=trees)


def _rebuilt(building: Building, rng: np.random.Generator) -> Building:
    """Another house on the same plot; a building that is no house keeps its kind."""
    house = building.kind in _HOUSES or building.kind is Kind.L_GABLE
    return replace(
        building,
        kind=_HOUSES[int(rng.integers(len(_HOUSES)))] if house else building.kind,
        length=building.length * float(rng.uniform(*_REBUILT_SIDE)),
        width=building.width * float(rng.uniform(*_REBUILT_SIDE)),
        eaves_m=building.eaves_m * float(rng.uniform(*_REBUILT_EAVES)),
        seed=int(rng.integers(1 << 30)),
    )


def _grown(trees: Trees, changes: Changes, new: list[Building], rng: np.random.Generator) -> Trees:
    count = len(trees.xy)
    growth = rng.uniform(*_GROWTH, (2, count))
    keep = rng.random(count) >= changes.felled
    for building in new:
        reach = 0.5 * float(np.hypot(building.length, building.width)) + 2.0
        keep &= np.linalg.norm(trees.xy - building.centre, axis=1) > reach
    return Trees(
        trees.xy[keep],
        (trees.radius * growth[0])[keep],
        (trees.height * growth[1])[keep],
        trees.species[keep],
        trees.dense[keep],
        trees.seed[keep],
    )
