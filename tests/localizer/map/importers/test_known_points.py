"""Triangles of real sources, read and placed by this test, against the imported surface."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path

import DracoPy
import numpy as np
import pytest
from scipy.spatial import cKDTree

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.map.building.build import build_cache
from localizer.map.building.options import BuildOptions
from localizer.map.cache.cache import TileCache
from localizer.map.cache.pick import cast_rays
from localizer.map.cache.stream import TileStreamer
from localizer.render.numba_raster import NumbaRenderer

DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
SAMPLES = 200
LIMIT_M = 0.05


def finest(tileset: Path) -> Iterator[tuple[Path, np.ndarray]]:
    """Files of the tiles that have no file below them, with their ECEF-from-tile transforms."""
    stack = [(json.loads(tileset.read_text())["root"], np.eye(4))]
    while stack:
        node, parent = stack.pop()
        T = parent @ np.reshape(node.get("transform", np.eye(4)), (4, 4)).T
        content = node.get("content", {})
        path = tileset.parent / content.get("uri", content.get("url", "none"))
        below = [c for c in node.get("children", []) if has_file(c, tileset.parent)]
        stack += [(c, T) for c in below]
        if path.is_file() and not below:
            yield path, T


def has_file(node: dict, folder: Path) -> bool:
    content = node.get("content", {})
    if (folder / content.get("uri", content.get("url", "none"))).is_file():
        return True
    return any(has_file(c, folder) for c in node.get("children", []))


def centroids(path: Path) -> np.ndarray:
    """Of the triangles (F, 3) of a Draco b3dm, z up, in its tile's axes."""
    data = path.read_bytes()
    tables = struct.unpack_from("<4I", data, 12)
    rtc = json.loads(data[28 : 28 + tables[0]]).get("RTC_CENTER", (0, 0, 0))
    glb = data[28 + sum(tables) :]
    length = struct.unpack_from("<I", glb, 12)[0]
    document = json.loads(glb[20 : 20 + length])
    binary = glb[28 + length :]
    assert document["nodes"] == [{"mesh": 0}]
    points = []
    for primitive in document["meshes"][0]["primitives"]:
        draco = primitive["extensions"]["KHR_draco_mesh_compression"]
        view = document["bufferViews"][draco["bufferView"]]
        start = view.get("byteOffset", 0)
        mesh = DracoPy.decode(binary[start : start + view["byteLength"]])
        points.append(mesh.points[mesh.faces].mean(axis=1))
    x, y, z = np.concatenate(points).T
    return np.stack([x, -z, y], -1) + rtc


@pytest.mark.real
def test_quito_is_imported_whole_and_in_place(real_data, quito_map):
    cache = TileCache.open(quito_map)
    assert (cache.manifest.tiles, cache.manifest.skipped) == (637, {})
    low, high = cache.manifest.height_range_m
    assert (low, high) == pytest.approx((0.0, 38.06), abs=0.05)  # the data set's description
    check_known_points(real_data("quito") / "tileset.json", cache)


@pytest.mark.real
def test_what_is_there_of_malvern_is_in_place(real_data, tmp_path):
    source = real_data("malvern") / "b3dmtileset.json"
    options = BuildOptions(workers=2, geoid_separation_m=-33.0, skip_bad_tiles=True)
    build_cache(source, tmp_path / "cache", options)
    cache = TileCache.open(tmp_path / "cache")
    assert len(cache.manifest.skipped) == 356
    check_known_points(source, cache)


def check_known_points(tileset: Path, cache: TileCache) -> None:
    """Triangles of some of the finest tiles are in the cache, and where rays and renders see it."""
    rng = np.random.default_rng(0)
    tiles = list(finest(tileset))
    camera = Camera.from_fov(640, 480, 50.0)
    apart, cast, rendered = [], [], []
    with TileStreamer(cache) as streamer:
        renderer = NumbaRenderer(streamer, threads=1)
        for i in rng.choice(len(tiles), min(len(tiles), 6), replace=False):
            path, ecef_from_tile = tiles[i]
            ecef = centroids(path) @ ecef_from_tile[:3, :3].T + ecef_from_tile[:3, 3]
            enu = cache.frame.ecef_from_enu.inverse.apply(ecef)
            points = enu[rng.choice(len(enu), min(len(enu), SAMPLES), replace=False)]
            centre = points.mean(axis=0)
            view = Pose(DOWN, np.array([centre[0], centre[1], points[:, 2].max() + 25.0]))
            picture = renderer.render(view, camera, wait=True)
            meshes = streamer.current()
            corners = [m.world_from_tile.apply(m.positions)[m.faces] for m in meshes]
            stored = np.concatenate([c.mean(axis=1) for c in corners])
            pixels, inside = camera.project(view.inverse.apply(points))
            points, pixels = points[inside], pixels[inside]
            apart.append(cKDTree(stored).query(points)[0])
            # The ray to a point ends there, unless something stands before it.
            offsets = points - view.translation
            distance = np.linalg.norm(offsets, axis=1)
            beyond = distance * (cast_rays(meshes, view.translation, offsets) - 1)
            seen = np.isfinite(beyond) & (beyond > -LIMIT_M)
            cast.append(np.abs(beyond[seen]))
            columns, rows = pixels[seen].astype(int).T
            found = view.apply(camera.rays(pixels[seen]) * picture.depth[rows, columns, None])
            rendered.append(np.linalg.norm(found - points[seen], axis=1))
    off, cast_off, rendered_off = (np.concatenate(x) for x in (apart, cast, rendered))
    assert min(len(cast_off), len(rendered_off)) > 100
    assert off.max() < LIMIT_M
    assert (cast_off < LIMIT_M).mean() > 0.99
    assert np.median(cast_off) < 1e-3
    assert np.median(rendered_off) < LIMIT_M
    print(
        f"{len(off)} triangles at most {off.max():.5f} m from the cache's; by rays "
        f"{100 * (cast_off < LIMIT_M).mean():.1f} % within 5 cm, by depth median "
        f"{np.median(rendered_off):.4f} m"
    )
