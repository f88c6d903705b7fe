"""Figures, verification, pictures and export of a cache."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import trimesh

from localizer.errors import OutsideMapError
from localizer.geometry.camera import Camera
from localizer.map.building.build import build_cache
from localizer.map.building.options import BuildOptions
from localizer.map.cache.cache import TileCache
from localizer.map.inspection.inspect import (
    camera_pose,
    depth_picture,
    export_glb,
    render_view,
    verify,
)


def test_verify_whole_and_damaged(cache, tmp_path):
    whole = verify(cache)
    assert whole.ok
    assert whole.holes == ()
    assert whole.covered_m2 == pytest.approx(400 * 400, rel=0.02)
    copy = TileCache.open(shutil.copytree(cache.path, tmp_path / "copy"))
    inner = [
        t for t in copy.tile_ids
        if np.abs(copy.world_from_tile[t].translation[:2]).max() < 60 and t > 4
    ]  # fmt: skip
    copy.tile_path(inner[0]).write_bytes(b"x")
    result = verify(copy)
    assert len(result.damaged) == 1
    assert f"tile {inner[0]}" in result.damaged[0]
    assert len(result.holes) == 1
    assert result.holes[0].area_m2 == pytest.approx(100 * 100, rel=0.05)


def test_render_view(cache):
    o = cache.manifest.origin
    camera = Camera.from_fov(64, 48, 60)
    pose = camera_pose(cache, o.latitude_deg, o.longitude_deg, o.height_m + 80)
    view = render_view(cache, pose, camera)
    assert view.depth[24, 32] == pytest.approx(80 - 6, abs=1.0)
    colours = depth_picture(view.depth)
    assert colours.shape == (48, 64, 3)
    assert (colours[view.depth == 0] == 0).all()


def test_export_is_the_same_surface(cache, tmp_path, make):
    count = export_glb(cache, tmp_path / "out.glb")
    scene = trimesh.load_scene(tmp_path / "out.glb")
    assert count == 16 * 128 == sum(len(g.faces) for g in scene.geometry.values())
    points = np.concatenate([g.vertices for g in scene.geometry.values()])
    error = points[:, 1] - make.height(points[:, 0], -points[:, 2])
    assert np.abs(error).max() < 1e-3
    assert export_glb(cache, tmp_path / "coarse.glb", level=0) == 128


def test_a_level_or_a_place_that_the_map_does_not_have_is_named(cache, tmp_path):
    with pytest.raises(OutsideMapError, match=r"no level 9, the finest is [0-9]"):
        export_glb(cache, tmp_path / "e.glb", 9)
    assert not (tmp_path / "e.glb").exists()
    far = camera_pose(cache, 10.0, 8.2, 500.0)
    with pytest.raises(OutsideMapError, match=r"nothing of the map; it lies about 47\.\d+, 8\.\d+"):
        render_view(cache, far, Camera.from_fov(64, 48, 60.0))


def test_dask_builds_the_same_cache(make, tmp_path, build):
    distributed = pytest.importorskip("distributed")
    source = make.tileset(tmp_path / "s", levels=2)
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        options = BuildOptions(scheduler=cluster.scheduler_address)
        manifest = build_cache(source, tmp_path / "c", options)
    assert manifest == build(source).manifest
