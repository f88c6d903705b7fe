"""The plan of the demo-sized world: what the issue asks to stand in it."""

from collections import Counter

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from localizer.synth.buildings.kinds import build
from localizer.synth.buildings.model import Kind
from localizer.synth.config import WorldConfig
from localizer.synth.plan.layout import assign_zones, plan_world
from localizer.synth.plan.plan import URBAN, WorldPlan
from localizer.synth.plan.streets import make_lattice, make_streets
from localizer.synth.plan.terrain import make_terrain


@pytest.fixture(scope="module", params=[1, 2])
def plan(request: pytest.FixtureRequest) -> WorldPlan:
    return plan_world(WorldConfig(request.param))


def test_relief(plan):
    assert float(np.ptp(plan.terrain.heights)) >= 60.0


def test_buildings_are_many_varied_and_apart(plan):
    kinds = Counter(b.kind for b in plan.buildings)
    houses = sum(n for k, n in kinds.items() if k not in {Kind.SHED, Kind.CONTAINER})
    assert houses >= 800
    assert {Kind.GABLE, Kind.HIP, Kind.L_GABLE, Kind.FLAT, Kind.HALL, Kind.ROW} <= set(kinds)
    assert kinds[Kind.CHURCH] >= 1
    centres = np.array([b.centre for b in plan.buildings])
    away = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    np.fill_diagonal(away, np.inf)
    assert away.min() > 2.0


def test_streets_are_one_net():
    config = WorldConfig(3)
    terrain, lattice = make_terrain(config), make_lattice(config)
    zones = assign_zones(config, lattice, terrain)
    net = make_streets(config, terrain, {c: z in URBAN for c, z in zones.items()}, lattice)
    a, b = (np.array([getattr(s, end) for s in net.streets]) for end in "ab")
    n = len(net.nodes)
    _, label = connected_components(coo_matrix((np.ones(len(a)), (a, b)), shape=(n, n)), False)
    assert len(set(label[a])) == 1
    assert {s.rank for s in net.streets} == {0, 1, 2}


def test_surfaces_face_outwards(plan):
    """Seen from its own middle, every outer wall and roof of a simple house looks away."""
    for building in [b for b in plan.buildings if b.kind is Kind.HIP][:20]:
        middle = np.array([*building.centre, building.base_z + building.eaves_m / 2])
        for surface in build(building)[:8]:
            away = surface.polygon.mean(axis=0) - middle
            assert away @ surface.normal > 0
            np.testing.assert_allclose(
                np.cross(surface.down, surface.right), surface.normal, atol=1e-9
            )
