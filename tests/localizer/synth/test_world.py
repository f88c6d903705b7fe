"""A generated world as the files that others read, by an independent reader of 3D Tiles."""

import hashlib
import json
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import trimesh

from localizer.errors import MapSourceError
from localizer.geometry.camera import Camera
from localizer.geometry.geo import ecef_from_geodetic
from localizer.geometry.pose import Pose
from localizer.synth import world
from localizer.synth.config import WorldConfig
from localizer.synth.heightfield.render import render
from localizer.synth.heightfield.scene import Land, LitScene, Prism, SkyLight, compose, light_scene
from localizer.synth.plan.layout import plan_world
from localizer.synth.plan.planner import WorldPlan
from localizer.synth.visits.visit import (
    Changes,
    SurveyErrors,
    apply_changes,
    survey_and_flight_visits,
)
from localizer.synth.world import WorldInfo, build_world

TERRAIN_FACES = 2 * 20 * 20  # of a leaf, first in its face list


@dataclass
class Content:
    positions: np.ndarray  # (V, 3) in the tile's z-up frame
    faces: np.ndarray
    image: np.ndarray


@dataclass
class Tile:
    name: str
    depth: int
    ecef_from_tile: np.ndarray  # (4, 4)
    box: np.ndarray  # (12,)
    error: float
    content: Content
    json: dict
    parent: "Tile | None"


def read_tileset(folder: Path) -> list[Tile]:
    document = json.loads((folder / "tileset.json").read_text())
    assert document["asset"]["version"] == "1.1"
    return list(_walk(folder, document["root"], np.eye(4), None))


def _walk(folder: Path, tile: dict, above: np.ndarray, parent: Tile | None) -> Iterator[Tile]:
    own = np.array(tile.get("transform", np.eye(4).T.ravel())).reshape(4, 4).T
    uri = tile["content"]["uri"]
    this = Tile(
        uri,
        0 if parent is None else parent.depth + 1,
        above @ own,
        np.array(tile["boundingVolume"]["box"]),
        tile["geometricError"],
        read_glb(folder / uri),
        tile,
        parent,
    )
    yield this
    for child in tile.get("children", []):
        yield from _walk(folder, child, this.ecef_from_tile, this)


def read_glb(path: Path) -> Content:
    (mesh,) = trimesh.load_scene(path, process=False).geometry.values()
    x, y, z = np.asarray(mesh.vertices, float).T
    image = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
    return Content(np.stack([x, -z, y], -1), np.asarray(mesh.faces), image)  # glTF is y-up


def box_half(tile) -> tuple[np.ndarray, np.ndarray]:
    box = tile.box.reshape(4, 3)
    assert np.count_nonzero(box[1:] - np.diag(np.diag(box[1:]))) == 0
    return box[0], np.diag(box[1:])


def to_enu(info: WorldInfo, tile, points: np.ndarray) -> np.ndarray:
    T = tile.ecef_from_tile
    return info.frame.ecef_from_enu.inverse.apply(points @ T[:3, :3].T + T[:3, 3])


@pytest.fixture(scope="module")
def survey(small_world):
    folder, info = small_world["survey"]
    return info, read_tileset(folder)


def hashes(folder: Path) -> dict[str, str]:
    files = sorted(p for p in folder.iterdir() if p.is_file())
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture(scope="module")
def painted_here(small_world, tmp_path_factory):
    """The same survey once more, by this process alone: folder, what was built, CPU seconds."""
    folder, known = tmp_path_factory.mktemp("again"), small_world["survey"][1]
    start = time.process_time()  # the machine may be busy
    info = build_world(known.seed, folder, size_m=known.size_m, processes=1)
    return folder, info, time.process_time() - start


def test_same_seed_gives_the_same_bytes_in_any_number_of_processes(small_world, painted_here):
    assert hashes(painted_here[0]) == hashes(small_world["survey"][0])


def test_a_world_that_is_interrupted_paints_no_more_blocks(tmp_path, monkeypatch):
    """It went on for minutes: every block was waited for."""
    pools = []

    class Pool(ThreadPoolExecutor):
        def __init__(self, _workers, _context, **_more):
            super().__init__(1)
            self.ending, self.painted = threading.Event(), []
            pools.append(self)

        def submit(self, fn, /, *args, **kwargs):
            return super().submit(self._paint, *args)

        def _paint(self, place):
            self.painted.append(place)
            self.ending.wait(60)

        def shutdown(self, wait=True, *, cancel_futures=False):
            super().shutdown(wait=False, cancel_futures=cancel_futures)
            self.ending.set()
            super().shutdown(wait=wait)

    monkeypatch.setattr(world, "ProcessPoolExecutor", Pool)
    places = [(column, 0) for column in range(20)]
    with (
        pytest.raises(KeyboardInterrupt),
        world.painted_blocks(None, tmp_path, places, processes=2),
    ):
        raise KeyboardInterrupt
    assert len(pools[0].painted) <= 1


def test_tileset_is_a_quadtree_of_four_levels_on_earth(survey):
    info, tiles = survey
    depths = [t.depth for t in tiles]
    assert [depths.count(d) for d in range(4)] == [1, 1, 4, 16]
    for tile in tiles:
        assert tile.json["refine"] == "REPLACE"
        R = tile.ecef_from_tile[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        if tile.parent is not None:
            assert tile.error <= tile.parent.error
    leaf_errors = [t.error for t in tiles if t.depth == 3]
    assert max(leaf_errors) == 0.0
    centre = tiles[0].ecef_from_tile[:3, 3]
    o = info.origin
    origin = ecef_from_geodetic(o.latitude_deg, o.longitude_deg, o.height_m)
    assert np.linalg.norm(centre - origin) < 60.0


def test_boxes_hold_their_content_and_their_children(survey):
    info, tiles = survey
    for tile in tiles:
        centre, half = box_half(tile)
        assert (np.abs(tile.content.positions - centre) <= half + 1e-3).all()
        if tile.parent is None:
            continue
        above, reach = box_half(tile.parent)
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
        corners = to_enu(info, tile, centre + signs * half)
        T = np.linalg.inv(tile.parent.ecef_from_tile)
        ecef = info.frame.ecef_from_enu.apply(corners)
        inside = ecef @ T[:3, :3].T + T[:3, 3]
        assert (np.abs(inside - above) <= reach + 1e-3).all()


def test_leaf_terrain_is_the_ground_that_the_world_info_tells(survey):
    info, tiles = survey
    for tile in tiles:
        if tile.depth != 3:
            continue
        used = np.unique(tile.content.faces[:TERRAIN_FACES])
        enu = to_enu(info, tile, tile.content.positions[used])
        height = info.ground_height(enu[:, 0], enu[:, 1])
        np.testing.assert_allclose(enu[:, 2], height, atol=2e-3)


def test_live_is_the_same_place_in_another_light(small_world):
    survey = {t.name: t for t in read_tileset(small_world["survey"][0])}
    live = {t.name: t for t in read_tileset(small_world["live"][0])}
    assert survey.keys() == live.keys()
    for name, tile in survey.items():
        other = live[name]
        np.testing.assert_array_equal(tile.content.positions[:400], other.content.positions[:400])
        ground = np.s_[16:416, 16:416]
        a, b = (t.content.image[ground].astype(float) for t in (tile, other))
        assert np.abs(a - b).mean() > 6.0
    assert small_world["survey"][1].targets[0].name == small_world["live"][1].targets[0].name


@pytest.mark.parametrize("size", [0.0, 300.0, -400.0])
def test_a_size_that_tiles_cannot_cover_is_refused(size):
    with pytest.raises(MapSourceError, match="multiple of 400"):
        WorldConfig(1, size)


# --- heightfield --------------------------------------------------------------------------------


N, CELL = 128, 0.5
NADIR = np.diag([1.0, -1.0, -1.0])
NOON = SkyLight((0.0, 0.0, 1.0), 0.7, 0.3)


def land(height: np.ndarray | None = None) -> Land:
    z = np.zeros((N, N), np.float32) if height is None else height.astype(np.float32)
    return Land(z, np.full((N, N, 3), 0.5, np.float32), CELL)


def lit(prisms: list[Prism], light: SkyLight = NOON) -> LitScene:
    return light_scene(compose(land(), prisms), light, (0.5, 0.6, 0.7))


def house(height: float = 10.0, ridge: float = 0.0) -> Prism:
    corners = np.array([[40, 40], [80, 40], [80, 70], [40, 70]], np.float32)
    return Prism(corners, height, ridge, (0.8, 0.1, 0.1), (0.2, 0.2, 0.8), 3.0)


def test_depth_over_flat_ground_is_the_height() -> None:
    camera = Camera.from_fov(64, 48, 60)
    depth = render(lit([]), Pose(NADIR, np.array([32.0, 32.0, 50.0])), camera)[1]
    np.testing.assert_allclose(depth, 50.0, atol=0.02)


def test_depth_of_an_oblique_view_is_on_the_plane() -> None:
    camera = Camera.from_fov(64, 48, 50)
    c, s = np.cos(np.radians(40)), np.sin(np.radians(40))
    rotation = np.array([[1, 0, 0], [0, -s, c], [0, -c, -s]])
    pose = Pose(rotation, np.array([30.0, 5.0, 40.0]))
    depth = render(lit([]), pose, camera)[1]
    v, u = np.mgrid[0:48, 0:64] + 0.5
    points = pose.apply(camera.rays(np.stack([u, v], -1)) * depth[..., None])
    np.testing.assert_allclose(points[..., 2], 0.0, atol=0.02)


def test_a_building_stands_up_and_has_its_colours() -> None:
    camera = Camera.from_fov(96, 96, 40)
    image, depth = render(lit([house()]), Pose(NADIR, np.array([30.0, 27.5, 70.0])), camera)
    assert depth[48, 48] == pytest.approx(60.0, abs=0.05)
    assert image[48, 48, 0] > 2 * image[48, 48, 2]
    c, s = np.cos(np.radians(25)), np.sin(np.radians(25))
    oblique = Pose(np.array([[1, 0, 0], [0, -s, c], [0, -c, -s]]), np.array([30.0, -15.0, 20.0]))
    wall = render(lit([house()]), oblique, camera)[0].reshape(-1, 3).astype(int)
    assert (wall[:, 2] > 2 * wall[:, 0]).sum() > 200


def test_shadows_fall_away_from_the_sun() -> None:
    sun = SkyLight((np.cos(np.radians(30)), 0.0, np.sin(np.radians(30))), 1.0, 0.3)
    camera = Camera.from_fov(128, 128, 60)
    # Columns grow with x: the sun stands in the east, so the shadow is west of the house.
    pose = Pose(NADIR, np.array([30.0, 27.5, 60.0]))
    image = render(lit([house()], sun), pose, camera)[0].astype(int).sum(-1)
    middle = 64
    west, east = image[middle, 20:30].mean(), image[middle, 100:108].mean()
    assert west < 0.7 * east


# --- Two visits to one place: what changed between them, and what a survey makes of it ----------


@pytest.fixture(scope="module")
def plan() -> WorldPlan:
    return plan_world(WorldConfig(5, 400.0))


def test_what_is_built_later_stands_on_free_ground(plan: WorldPlan) -> None:
    assert len(plan.sites) >= 4
    for site in plan.sites:
        for other in [*plan.buildings, *(s for s in plan.sites if s is not site)]:
            away = np.hypot(*np.subtract(site.centre, other.centre))
            assert away > 0.5 * min(site.width, other.width)


def test_buildings_go_change_and_come_in_the_shares_that_are_said(plan: WorldPlan) -> None:
    after = apply_changes(plan, Changes(gone=0.2, rebuilt=0.2, new=0.04, felled=0.3, seed=3))
    before = {b.centre: b for b in plan.buildings}
    count = len(before)
    kept = [b for b in after.buildings if before.get(b.centre) == b]
    rebuilt = [b for b in after.buildings if b.centre in before and before[b.centre] != b]
    new = [b for b in after.buildings if b.centre not in before]
    assert len(new) == min(round(0.04 * count), len(plan.sites))
    assert count - len(kept) - len(rebuilt) == pytest.approx(0.2 * count, rel=0.5)
    assert len(rebuilt) == pytest.approx(0.2 * count, rel=0.5)
    assert all(b.eaves_m != before[b.centre].eaves_m for b in rebuilt)
    assert len(after.trees.xy) == pytest.approx(0.7 * len(plan.trees.xy), rel=0.15)
    assert after.trees.radius.mean() > plan.trees.radius.mean()
    assert after.shapes is plan.shapes  # streets and fields stay
    again = apply_changes(plan, Changes(gone=0.2, rebuilt=0.2, new=0.04, felled=0.3, seed=3))
    assert again.buildings == after.buildings


def test_a_survey_moves_its_surface_smoothly_and_by_what_is_said() -> None:
    survey = SurveyErrors(bumps_m=0.1, seed=4)
    points = np.random.default_rng(0).uniform(-200, 200, (4000, 3))
    off = survey.displaced(points) - points
    np.testing.assert_allclose(off.std(axis=0), 0.1, rtol=0.35)
    beside = survey.displaced(points + 0.2) - points - 0.2
    assert np.abs(beside - off).max() < 0.1  # no tears
    assert SurveyErrors().displaced(points) is points


def test_every_place_is_surveyed_and_lived_in_its_own_way() -> None:
    pairs = [survey_and_flight_visits(WorldConfig(seed, 400.0)) for seed in range(6)]
    assert len({survey.survey for survey, _ in pairs}) == 6
    for survey, live in pairs:
        assert survey.changes is None
        assert live.survey is None
        assert min(live.changes.gone, live.changes.rebuilt, live.changes.new) >= 0.01
        assert live.look.changed_buildings == 0.0
