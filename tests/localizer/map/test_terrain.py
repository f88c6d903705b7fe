"""A GeoTIFF of heights as the ground in the map's frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from localizer.errors import MapSourceError
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.map.terrain import open_terrain
from tests.localizer.map.conftest import write_raster

FRAME = LocalFrame(Geodetic(47.0, 8.0, 500.0))
STEP = 1 / 3600  # degrees, as Copernicus' 30 m


def written(path: Path, heights: np.ndarray, west: float = 7.99, crs: str | None = "EPSG:4326"):
    return other(path, heights.astype(np.float32), crs=crs, place=(west, 47.01), nodata=-9999.0)


def other(path: Path, data: np.ndarray, **options):
    about = {"crs": "EPSG:4326", "step": STEP, "place": (7.99, 47.01)}
    return write_raster(path, data, **about | options)


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
    ("west", "crs", "why"), [(7.99, None, "coordinate system"), (20.0, "EPSG:4326", "from the map")]
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


HILL = np.linspace(600.0, 640.0, 72 * 72).reshape(72, 72)


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (np.full((3, 72, 72), 90, np.uint8), "a picture"),
        (HILL.astype(np.complex64), "complex"),
        (np.where(HILL < 610.0, -9999.0, HILL), "nowhere on Earth"),
        (np.full((72, 72), 1e30), "nowhere on Earth"),
        (np.random.default_rng(1).uniform(0.0, 3000.0, (72, 72)), "80 degrees"),
    ],
)
def test_what_holds_no_heights_is_no_ground(tmp_path, data, why):
    """Each was taken for the shape of the ground, and odometry off the map was wrong by it."""
    with pytest.raises(MapSourceError, match=why):
        open_terrain(other(tmp_path / "t.tif", data), FRAME)


@pytest.mark.parametrize(
    ("data", "tags"), [(HILL * 100.0, {"scales": [0.01]}), (HILL / 0.3048, {"units": ["ft"]})]
)
def test_scale_and_unit_are_honoured(tmp_path, data, tags):
    found = open_terrain(other(tmp_path / "t.tif", data, **tags), FRAME).heights
    assert np.ptp(found) < 45.0


def test_a_raster_wider_than_opencv_takes_is_read(tmp_path):
    """It ended in OpenCV's own assertion at the start."""
    wide = np.full((60, 40_000), 600.0, np.float32)
    path = other(tmp_path / "t.tif", wide, step=(STEP / 40, STEP))
    assert np.ptp(open_terrain(path, FRAME).heights) < 40.0  # of the Earth's curve
