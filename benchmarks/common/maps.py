"""Maps that the benchmarks build of real and of made rasters."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import from_origin

from localizer.geometry.geo import Geodetic
from localizer.map.building.build import build_cache
from localizer.map.building.options import BuildOptions
from localizer.map.importers.rules import ImportRules


def build_map(sources: Path | list[Path], cache: Path, origin: Geodetic | None = None) -> Path:
    """Build a map; heights only need to agree between map and poses, so no geoid matters."""
    options = BuildOptions(
        geoid_separation_m=0.0, vertical_datum="ellipsoidal", origin=origin, overwrite=True,
        rules=ImportRules(trusted=frozenset({"geoid"})),
    )  # fmt: skip
    build_cache(sources, cache, options)
    return cache


def layers_of(folder: Path) -> Path | list[Path]:
    """A folder's DSM and orthophoto, or the folder of another source."""
    rasters = [folder / "dsm.tif", folder / "ortho.tif"]
    return rasters if rasters[0].exists() else folder


def origin_of(folder: Path) -> Geodetic | None:
    """The origin in a folder's ``georef.json``; None without one."""
    georef = folder / "georef.json"
    if not georef.exists():
        return None
    origin = json.loads(georef.read_text())["origin"]
    return Geodetic(origin["lat"], origin["lon"], origin["height"])


def write_raster(
    path: Path, data: np.ndarray, step: float, crs: str, corner: tuple[float, float]
) -> None:
    """Write bands (n, height, width) as GeoTIFF. step: of a pixel, m; corner: west and north."""
    profile = {
        "driver": "GTiff", "width": data.shape[2], "height": data.shape[1], "count": data.shape[0],
        "dtype": data.dtype, "crs": crs, "transform": from_origin(*corner, step, step),
    }  # fmt: skip
    with rasterio.open(path, "w", **profile) as out:
        out.write(data)
