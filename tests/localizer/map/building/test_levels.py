"""Tilesets without levels of detail get some, huge tiles are cut; the finest surface stays."""

from __future__ import annotations

import numpy as np
import pytest

from localizer.errors import MapSourceError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.map.building import quadtree, sources
from localizer.map.cache.stream import TileStreamer
from localizer.map.importers.tiles3d import ContentFile
from localizer.map.inspection.inspect import verify
from localizer.render.numba_raster import NumbaRenderer
from tests.localizer.map.conftest import write_tree

DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])


def write(make, folder, children, **root):
    asset = {"version": "1.0", "extras": {"geoid_separation_m": make.separation}}
    box = {"box": [0, 0, 0, 200, 0, 0, 0, 200, 0, 0, 0, 30]}
    about = {"boundingVolume": box, "geometricError": 500.0, "children": children}
    return write_tree(folder, about | root, asset=asset)


@pytest.fixture
def flat(make, tmp_path):
    """16 tiles of 100 m below a root without content, in one level."""
    children = []
    (tmp_path / "s").mkdir()
    for k in range(16):
        west, south = -200 + 100 * (k % 4), -200 + 100 * (k // 4)
        positions, uvs, faces = make.patch(west, south, 100, 10)
        content = make.glb(make.y_up(positions), uvs, faces, make.picture(k))
        (tmp_path / "s" / f"{k}.glb").write_bytes(content)
        box = [west + 50, south + 50, 0, 50, 0, 0, 0, 50, 0, 0, 0, 20]
        volume = {"box": box} if k % 2 else {"sphere": [*box[:3], 75.0]}
        children.append(
            {"boundingVolume": volume, "geometricError": 0, "content": {"uri": f"{k}.glb"}}
        )
    return write(make, tmp_path / "s", children, refine="ADD")


def surface(cache, tile):
    mesh = cache.load_tile(tile)
    return mesh.world_from_tile.apply(mesh.positions)


def test_a_tileset_of_one_level_gets_coarser_ones(flat, make, build):
    cache = build(flat)
    index = cache.index
    assert cache.manifest.levels >= 3
    assert index.tile_count[0] == 1
    leaves = index.child_count == 0
    assert leaves.sum() == 16
    assert cache.manifest.triangles == 16 * 200
    for node in np.flatnonzero(leaves):
        points = surface(cache, int(index.tile_start[node]))
        assert np.abs(points[:, 2] - make.height(points[:, 0], points[:, 1])).max() < 1e-3
    root = surface(cache, int(index.tile_start[0]))
    error = root[:, 2] - make.height(root[:, 0], root[:, 1])
    assert np.median(np.abs(error)) < 0.5
    assert verify(cache).holes == ()
    with TileStreamer(cache, max_error_px=4, max_texel_px=300) as coarse:
        renderer = NumbaRenderer(coarse, threads=1)
        pose = Pose(DOWN, np.array([0.0, 0.0, 320.0]))
        view = renderer.render(pose, Camera.from_fov(320, 320, 60), wait=True)
        assert 1 < len(coarse.current()) < 16
    assert (view.depth > 0).all()  # no crack between what is made
    with TileStreamer(cache) as streamer:
        far = streamer.select(Pose(DOWN, np.array([0, 0, 30e3])), Camera.from_fov(64, 64, 60),
                              wait=True)  # fmt: skip
        near = streamer.select(Pose(DOWN, np.array([50, 50, 60.0])), Camera.from_fov(640, 480, 60),
                               wait=True)  # fmt: skip
    assert (len(far), len(near)) == (1, 1)
    assert near[0].mips[0].shape == (64, 64, 3)


def test_a_bad_tile_costs_only_itself(flat, build):
    (flat.parent / "5.glb").write_bytes(b"glTF")
    with pytest.raises(MapSourceError, match=r"1 tiles cannot[^\n]*\n *5\.glb: GLB is cut"):
        build(flat)
    cache = build(flat, skip_bad_tiles=True)
    assert list(cache.manifest.skipped) == ["5.glb"]
    assert cache.manifest.triangles == 15 * 200


def test_a_huge_leaf_is_cut(make, tmp_path, build, monkeypatch):
    monkeypatch.setattr(sources, "_SMALL_BYTES", 1000)
    monkeypatch.setattr(sources, "MAX_TRIANGLES", 5000)
    monkeypatch.setattr(quadtree, "LEAF_TRIANGLES", 1000)
    folder = tmp_path / "s"
    folder.mkdir()
    positions, uvs, faces = make.patch(-200, -200, 400, 80)
    content = make.glb(make.y_up(positions), uvs, faces, make.picture(3, 256))
    (folder / "all.b3dm").write_bytes(make.b3dm(content))
    cache = build(write(make, folder, [], content={"uri": "all.b3dm"}))
    assert cache.manifest.levels >= 3
    assert cache.manifest.triangles == 2 * 80 * 80
    leaves = np.flatnonzero(cache.index.child_count == 0)
    assert len(leaves) >= 16
    for node in leaves:
        points = surface(cache, int(cache.index.tile_start[node]))
        assert len(points) < 1500
        assert np.abs(points[:, 2] - make.height(points[:, 0], points[:, 1])).max() < 1e-3
    assert verify(cache).holes == ()


def test_weight_tells_triangles_and_texels(make, tmp_path):
    positions, uvs, faces = make.patch(0, 0, 10, 5)
    path = tmp_path / "t.glb"
    path.write_bytes(make.glb(positions, uvs, faces, make.picture(1, 32)))
    content = ContentFile(path, tmp_path, np.eye(4), "Y")
    assert content.weight() == (50, 32 * 32)
