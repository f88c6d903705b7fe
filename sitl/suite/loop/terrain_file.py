"""Writes a coarse terrain model of a generated world, with a height offset."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import from_origin

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
