"""A GeoTIFF of heights as the ground in the map's frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from localizer.errors import MapSourceError
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.map.terrain import open_terrain

FRAME = LocalFrame(Geodetic(47.0, 8.0, 500.0))
STEP = 1 / 3600  # degrees, as Copernicus' 30 m


def written(path: Path, heights: np.ndarray, west: float = 7.99, crs: str | None = "EPSG:4326"):
    profile = {
        "driver": "GTiff", "width": heights.shape[1], "height": heights.shape[0], "count": 1,
        "dtype": "float32", "crs": crs, "nodata": -9999.0,
        "transform": from_origin(west, 47.01, STEP, STEP),
    }  # fmt: skip
    with rasterio.open(path, "w", **profile) as out:
        out.write(heights.astype(np.float32)[None])
    return path


def test_heights_lie_where_the_raster_has_them(tmp_path):
    row, column = np.mgrid[0:72, 0:72].astype(np.float64)
    terrain = open_terrain(written(tmp_path / "t.tif", 600.0 + 2.0 * row + column), FRAME)
    for east, north in ((0.0, 0.0), (300.0, -200.0), (-250.0, 410.0)):
        latitude, longitude, _ = FRAME.geodetic_from_enu(np.array([east, north, 0.0]))
        i, j = (47.01 - latitude) / STEP - 0.5, (longitude - 7.99) / STEP - 0.5
        found = terrain.height(np.array([east]), np.array([north]))[0]
        assert found == pytest.approx(100.0 + 2.0 * i + j, abs=0.3)
    edge = terrain.height(np.array([5e4]), np.array([0.0]))[0]
    assert np.isfinite(edge)  # level beyond


def test_what_is_unknown_is_filled_and_does_not_spread(tmp_path):
    heights = np.full((72, 72), 650.0)
    heights[:10] = -9999.0
    terrain = open_terrain(written(tmp_path / "t.tif", heights), FRAME)
    east, north = np.meshgrid(np.linspace(-700, 700, 30), np.linspace(-1000, 1000, 30))
    assert terrain.height(east, north) == pytest.approx(150.0, abs=0.5)


@pytest.mark.parametrize(
    ("west", "crs", "why"),
    [(7.99, None, "coordinate system"), (20.0, "EPSG:4326", "from the map")],
)
def test_what_is_no_terrain_of_the_place_is_named(tmp_path, west, crs, why):
    path = written(tmp_path / "t.tif", np.full((72, 72), 600.0), west, crs)
    with pytest.raises(MapSourceError, match=why):
        open_terrain(path, FRAME)


def test_no_raster_is_named(tmp_path):
    path = tmp_path / "t.tif"
    path.write_bytes(b"no tiff")
    with pytest.raises(MapSourceError, match=r"t\.tif"):
        open_terrain(path, FRAME)
