"""Selection and streaming: level of detail, culling, stand-ins, budget, failures."""

from __future__ import annotations

import shutil
import threading
import time
import weakref

import numpy as np
import pytest

from localizer.errors import MapCacheError
from localizer.geometry.camera import Camera
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Pose
from localizer.map.cache.cache import TileCache, TileIndex
from localizer.map.cache.select import DetailLimits, TileSelector, frustum_planes
from localizer.map.cache.stream import TileStreamer

CAMERA = Camera.from_fov(320, 240, 60.0)
DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # x east, y south, z down
NORTH = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # x east, y down, z north


def above(east, north, height) -> Pose:
    return Pose(DOWN, np.array([east, north, height], float))


def until(condition) -> None:
    """Waits, patiently: only a defect takes that long."""
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def footprint(meshes):
    """Ground area of the meshes' boxes, m²."""
    return sum(float(np.prod((m.bounds[1] - m.bounds[0])[:2])) for m in meshes)


@pytest.fixture
def streamer(cache):
    with TileStreamer(cache) as s:
        yield s


def test_near_is_fine_and_far_is_coarse(streamer):
    near = streamer.select(above(0, 0, 60), CAMERA, wait=True)
    far = streamer.select(above(0, 0, 20_000), CAMERA, wait=True)
    assert len(far) == 1
    assert len(near) == 4  # the four leaves that meet below the camera
    assert max(footprint([m]) for m in near) < footprint(far) / 15


def test_every_detail_covers_the_ground_once(streamer):
    for height in (300, 600, 1000, 2000, 5000, 20_000):
        meshes = streamer.select(above(0, 0, height), Camera.from_fov(320, 320, 80), wait=True)
        assert footprint(meshes) == pytest.approx(400 * 400, rel=1e-4)


def test_only_what_is_in_view_is_drawn(streamer):
    meshes = streamer.select(above(150, 150, 60), CAMERA, wait=True)
    centres = np.array([m.world_from_tile.translation for m in meshes])
    assert (centres[:, :2] > 0).all()
    assert streamer.select(above(5000, 0, 60), CAMERA, wait=True) == []


def test_coarse_parents_stand_in_while_children_load(cache, monkeypatch):
    slow = cache.load_tile
    monkeypatch.setattr(cache, "load_tile", lambda i: (time.sleep(0.02), slow(i))[1])
    with TileStreamer(cache) as streamer:
        streamer.select(above(0, 0, 20_000), CAMERA, wait=True)  # the root is there
        camera = Camera.from_fov(320, 320, 80)
        areas = []
        for _ in range(6000):
            meshes = streamer.select(above(0, 0, 300), camera)
            areas.append(footprint(meshes))
            if len(meshes) == 16:
                break
            time.sleep(0.01)
        assert len(meshes) == 16
        assert areas == pytest.approx([400 * 400] * len(areas), rel=1e-4)
        counters = streamer.counters()
        assert counters.stalls == 0
        assert counters.misses > 0
        assert counters.complete >= 2


def test_memory_stays_within_the_budget(cache):
    budget = int(cache.index.size.max() * 7.5)
    with TileStreamer(cache, byte_budget=budget) as streamer:
        for east in np.linspace(-180, 180, 12):
            streamer.select(above(east, east / 2, 60), CAMERA, wait=True)
            assert streamer.counters().resident_bytes <= budget
        assert streamer.counters().evicted > 0


def test_a_view_larger_than_the_budget_gets_coarser(cache):
    camera = Camera.from_fov(320, 320, 80)
    with TileStreamer(cache, byte_budget=int(cache.index.size.max() * 6)) as streamer:
        meshes = streamer.select(above(0, 0, 300), camera, wait=True)
        assert 1 <= len(meshes) <= 6
        assert footprint(meshes) == pytest.approx(400 * 400, rel=1e-4)


def test_a_view_lacks_what_arrived_after_it_was_selected(streamer):
    """A view was empty and the loader idle: the tiles came while it was drawn."""
    assert streamer.select(above(0, 0, 60), CAMERA) == []
    assert streamer.counters().stalls == 1
    until(lambda: streamer.idle)
    assert streamer.lacks_tiles
    assert streamer.select(above(0, 0, 60), CAMERA)
    assert not streamer.lacks_tiles


def test_prefetch_makes_the_next_view_complete(streamer):
    here, there = above(-150, -150, 60), above(150, 150, 60)
    streamer.select(here, CAMERA, wait=True)
    streamer.prefetch([there], CAMERA)
    until(lambda: streamer.idle)
    before = streamer.counters()
    streamer.select(there, CAMERA)
    after = streamer.counters()
    assert after.misses == before.misses
    assert after.complete == before.complete + 1


def test_prefetch_takes_the_views_in_order_and_stays_within_the_budget(cache, monkeypatch):
    order = []
    load = cache.load_tile
    monkeypatch.setattr(cache, "load_tile", lambda i: (order.append(i), load(i))[1])
    here, soon, later = (above(e, e, 60) for e in (-150, 0, 150))
    budget = int(cache.index.size.max() * 5)
    with TileStreamer(cache, byte_budget=budget) as streamer:
        streamer.select(here, CAMERA, wait=True)
        del order[:]
        streamer.prefetch([soon, later], CAMERA)
        until(lambda: streamer.idle)
        nearest = [round(np.abs(cache.world_from_tile[i].translation[:2]).max()) for i in order]
        assert len(order) >= 2
        assert nearest == sorted(nearest)  # around the origin first
        assert streamer.counters().resident_bytes <= budget


def test_the_loader_frees_what_leaves_memory(cache):
    with TileStreamer(cache, byte_budget=int(cache.index.size.max() * 2.5)) as streamer:
        gone = [weakref.ref(m) for m in streamer.select(above(-150, -150, 60), CAMERA, wait=True)]
        for _ in range(3):
            streamer.select(above(150, 150, 60), CAMERA, wait=True)
        streamer.select(above(20, 150, 60), CAMERA, wait=True)
        until(lambda: any(mesh() is None for mesh in gone))


def test_a_damaged_tile_is_named_or_stood_in_for(cache_path, tmp_path):
    copy = TileCache.open(shutil.copytree(cache_path, tmp_path / "copy"))
    leaf = int(copy.index.tile_start[np.flatnonzero(copy.index.child_count == 0)[0]])
    copy.tile_path(leaf).write_bytes(b"damaged")
    centre = copy.world_from_tile[leaf].translation
    pose = above(centre[0], centre[1], 60)
    with TileStreamer(copy) as streamer:
        with pytest.raises(MapCacheError, match=f"tile {leaf}"):
            streamer.select(pose, CAMERA, wait=True)
        streamer.select(above(0, 0, 20_000), CAMERA, wait=True)
        meshes = streamer.select(pose, CAMERA)
        assert footprint(meshes) > 0
        assert streamer.counters().failures == 1


def test_a_tile_that_is_asked_for_again_while_it_fails_is_read_once(cache, monkeypatch):
    load, leaf, read = cache.load_tile, int(np.flatnonzero(cache.index.child_count == 0)[0]), []
    centre = cache.world_from_tile[int(cache.index.tile_start[leaf])].translation
    pose = above(centre[0], centre[1], 60)

    def damaged(tile):
        if tile != cache.index.tile_start[leaf]:
            return load(tile)
        read.append(tile)
        running.select(pose, CAMERA)
        raise MapCacheError("damaged")

    monkeypatch.setattr(cache, "load_tile", damaged)
    with TileStreamer(cache) as running:
        running.select(pose, CAMERA)
        until(lambda: running.counters().failures and running.idle)
        assert len(read) == running.counters().failures == 1


@pytest.mark.parametrize("error", [MapCacheError("gone"), RuntimeError("decoder")])
def test_a_map_that_comes_back_is_read_again_and_nothing_ends_the_loader(cache, monkeypatch, error):
    load, now, read = cache.load_tile, [0.0], []
    pose = above(0, 0, 60)

    def gone(tile):
        read.append(tile)
        raise error

    with TileStreamer(cache, clock=lambda: now[0]) as running:
        running.select(above(0, 0, 20_000), CAMERA, wait=True)
        monkeypatch.setattr(cache, "load_tile", gone)
        for _ in range(5):  # no more often than the wait allows, whoever asks
            running.select(pose, CAMERA)
            until(lambda: running.idle)
        lost = running.counters().unreadable
        assert 0 < lost == running.counters().failures == len(set(read)) == len(read)
        assert running.counters().complete == 1
        monkeypatch.setattr(cache, "load_tile", load)
        running.select(pose, CAMERA)
        until(lambda: running.idle)
        assert running.counters().unreadable == lost  # not yet
        now[0] = 1.0
        assert len(running.select(pose, CAMERA, wait=True)) > 0
        assert running.counters().unreadable < lost


def test_a_disk_that_stands_still_keeps_no_end_waiting(cache, monkeypatch):
    monkeypatch.setattr("localizer.map.cache.stream._CLOSE_S", 0.01)
    asked, still = threading.Event(), threading.Event()

    def stands(*_):
        asked.set()
        still.wait(120.0)
        raise MapCacheError("at last")

    monkeypatch.setattr(TileCache, "load_tile", stands)
    streamer = TileStreamer(cache)
    assert streamer.select(above(0, 0, 100), CAMERA) == []
    assert asked.wait(60.0)
    ending = threading.Thread(target=streamer.close, daemon=True)
    ending.start()
    ending.join(60.0)
    assert not ending.is_alive()
    still.set()


def test_a_closed_streamer_says_so(cache):
    streamer = TileStreamer(cache)
    streamer.close()
    with pytest.raises(RuntimeError, match="closed"):
        streamer.select(above(0, 0, 100), CAMERA)


def test_frustum_planes_agree_with_projection():
    rng = np.random.default_rng(3)
    pose = Pose.exp(rng.normal(size=6))
    camera = Camera(320, 200, 250, 240, 140, 120)
    points = pose.apply(rng.normal(size=(500, 3)) * 3)
    planes = frustum_planes(pose, camera)
    inside = (points @ planes[:, :3].T + planes[:, 3] >= 0).all(axis=1)
    _, visible = camera.project(pose.inverse.apply(points))
    assert np.array_equal(inside, visible)
    assert 10 < visible.sum() < 400


def boxes(*centres: tuple[float, float, float]) -> TileIndex:
    """A root over boxes of 20 m."""
    n = len(centres)
    low = np.array(centres, float) - 10
    low = np.vstack([low.min(axis=0), low])
    high = np.vstack([np.array(centres, float).max(axis=0) + 10, np.array(centres, float) + 10])
    return TileIndex(
        box_min=low,
        box_max=high,
        geometric_error=np.r_[1e9, np.zeros(n)],
        gsd=np.zeros(n + 1),
        refine=np.zeros(n + 1, np.uint8),
        child_start=np.r_[1, np.full(n, n + 1)].astype(np.int32),
        child_count=np.r_[n, np.zeros(n)].astype(np.int32),
        tile_start=np.arange(n + 1, dtype=np.int32),
        tile_count=np.ones(n + 1, np.int32),
        ecef_from_tile=np.tile(np.eye(4), (n + 1, 1, 1)),
        size=np.ones(n + 1, np.int64),
        digest=np.zeros((n + 1, 32), np.uint8),
    )


def test_what_the_earth_hides_is_not_wanted():
    # From 100 m the horizon is 35.7 km away; at 80 km the curvature hides 154 m.
    def sunk(distance, height):
        return (0.0, distance, height - distance**2 / 2 / 6.37e6)

    index = boxes(sunk(10e3, 10), sunk(80e3, 10), sunk(80e3, 300))
    selector = TileSelector(index, LocalFrame(Geodetic(45.0, 8.0, 0.0)))
    pose = Pose(NORTH, np.array([0.0, 0.0, 100.0]))
    choice = selector.select(pose, CAMERA, np.ones(4, bool), DetailLimits())
    assert sorted(choice.wanted) == [1, 3]


def test_texel_size_asks_for_detail_where_errors_are_zero(cache):
    index = cache.index
    flat = TileIndex(**(vars(index) | {"geometric_error": np.zeros(len(index.gsd))}))
    selector = TileSelector(flat, cache.frame)
    everything = np.ones(len(index.gsd), bool)
    near = selector.select(above(0, 0, 200), CAMERA, everything, DetailLimits())
    far = selector.select(above(0, 0, 20_000), CAMERA, everything, DetailLimits())
    assert len(near.wanted) > 1
    assert list(far.wanted) == [0]


def test_add_refinement_draws_parent_and_children(make, tmp_path, build):
    cache = build(make.tileset(tmp_path / "s", refine="ADD"))
    with TileStreamer(cache) as streamer:
        meshes = streamer.select(above(0, 0, 60), CAMERA, wait=True)
        assert len(meshes) == 1 + 4 + 4
