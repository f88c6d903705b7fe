"""Maps and terrain models that differ from a generated world."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio.transform import from_origin

from localizer.map.building.build import build_cache
from localizer.synth.world import WorldInfo

_POST_M = 30.0
_METRES_PER_DEG = 111_320.0


def terrain_file(world: WorldInfo, path: Path, off_m: float) -> Path:
    """Write a GeoTIFF (EPSG:4326, float32) of the world's ground to `path`, which is returned. It
    holds a height above the ellipsoid every 30 m, over the whole world; `off_m`: added to each
    height, m.
    """
    here = world.origin
    lat = _POST_M / _METRES_PER_DEG
    lon = lat / np.cos(np.radians(here.latitude_deg))
    half = int(np.ceil(0.5 * world.size_m / _POST_M)) + 1
    steps = np.arange(-half, half + 1)
    latitude, longitude = np.meshgrid(
        here.latitude_deg - lat * steps, here.longitude_deg + lon * steps, indexing="ij"
    )
    enu = world.frame.enu_from_geodetic(latitude, longitude, np.full(latitude.shape, here.height_m))
    heights = here.height_m + world.ground_height(enu[..., 0], enu[..., 1]) + off_m
    corner = (longitude[0, 0] - lon / 2, latitude[0, 0] + lat / 2)
    profile = {
        "driver": "GTiff", "width": heights.shape[1], "height": heights.shape[0], "count": 1,
        "dtype": "float32", "crs": "EPSG:4326", "transform": from_origin(*corner, lon, lat),
    }  # fmt: skip
    with rasterio.open(path, "w", **profile) as out:
        out.write(heights.astype(np.float32)[None])
    return path


_BEYOND_M = 50.0  # what may stick out of a tile's square (a tree that sticks out)


def inner_map(whole: Path, reach_m: float) -> Path:
    """Write a cache of the tiles within reach_m of the world's centre; returns its path.

    whole: the cache of all tiles, beside the folder `survey` of their tileset; the smaller one is
    made once, beside it. Coarse tiles that reach further are left out, so nothing is shown beyond
    reach_m.
    """
    survey, cache = whole.parent / "survey", whole.with_name(f"{whole.name}-{reach_m:.0f}")
    if not (cache / "manifest.json").exists():
        tileset = json.loads((survey / "tileset.json").read_text(encoding="utf-8"))
        root = tileset["root"]
        kept = _within(root["children"], [0.0, 0.0, 0.0], reach_m)
        tileset["root"] = {k: v for k, v in root.items() if k != "content"} | {"children": kept}
        source = survey / f"tileset-{reach_m:.0f}.json"
        source.write_text(json.dumps(tileset), encoding="utf-8")
        build_cache(source, cache)
    return cache


def _within(nodes: list[dict[str, Any]], parent: list[float], reach_m: float) -> list[Any]:
    """Those subtrees, each with its place in the root's frame, that lie within the reach."""
    kept: list[Any] = []
    for node in nodes:
        # Column-major (4, 4); the generator's tiles are shifted and not turned.
        transform = list(node["transform"])
        for axis in range(3):
            transform[12 + axis] += parent[axis]
        box = node["boundingVolume"]["box"]
        reached = max(abs(transform[12]), abs(transform[13])) + max(box[3], box[7])
        if reached <= reach_m + _BEYOND_M:
            kept.append(node | {"transform": transform})
        else:
            kept += _within(node.get("children", []), transform[12:15], reach_m)
    return kept
