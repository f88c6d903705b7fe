"""DSM and orthophoto: heights, colours, nodata, projections, levels."""

# ruff: noqa: RUF005 (sums of arrays are meant, not lists)

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from rasterio.warp import Resampling, calculate_default_transform, reproject

from localizer.errors import GeoreferenceError, MapSourceError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.map.cache.cache import TileCache
from localizer.map.cache.pick import cast_rays
from localizer.map.cache.stream import TileStreamer
from localizer.map.importers.georeference import ecef_from_crs
from localizer.render.numba_raster import NumbaRenderer
from tests.localizer.map.conftest import PLACE, built, cut_out, leaf_meshes, write_raster

UTM = "EPSG:32632"
LEFT, TOP = PLACE
STEP, GSD, CELLS = 0.5, 0.125, 300
DATUM = {"geoid_separation_m": 48.0, "vertical_datum": "ellipsoidal"}


def height(east, north):
    """Hills with a block on them."""
    x, y = np.asarray(east) - LEFT, TOP - np.asarray(north)
    hills = 400 + 8 * np.sin(x / 30) + 5 * np.cos(y / 20)
    return hills + 12.0 * ((x > 60) & (x < 80) & (y > 40) & (y < 70))


@pytest.fixture(scope="module")
def rasters(tmp_path_factory):
    """dsm.tif with a nodata corner, ortho.tif whose red and green tell the place."""
    s = LEFT + (np.arange(CELLS) + 0.5) * STEP
    dsm = height(s[None], (TOP - (np.arange(CELLS) + 0.5) * STEP)[:, None]).astype(np.float32)
    dsm[:60, :60] = -9999
    n = int(CELLS * STEP / GSD)
    ramp = np.linspace(0, 255, n).astype(np.uint8)
    ortho = np.stack([np.tile(ramp, (n, 1)), np.tile(ramp[:, None], (1, n)), np.full((n, n), 60)])
    folder = tmp_path_factory.mktemp("rasters")
    return (
        write_raster(folder / "dsm.tif", dsm, step=STEP, nodata=-9999),
        write_raster(folder / "ortho.tif", ortho.astype(np.uint8), step=GSD),
    )


@pytest.fixture(scope="module")
def cache(rasters, tmp_path_factory):
    """Of both; read only."""
    return built(rasters, tmp_path_factory.mktemp("built") / "cache", **DATUM)


def surface(cache: TileCache, east, north, crs=UTM):
    """Heights (CRS) of the finest surface under points of the CRS, by vertical rays."""
    found, meshes = [], leaf_meshes(cache)
    for e, n in zip(east, north, strict=True):
        ends = ecef_from_crs(crs, np.array([[e, n, 1000.0], [e, n, 0.0]]))
        top, low = cache.frame.ecef_from_enu.inverse.apply(ends)
        found.append(1000 - 1000 * cast_rays(meshes, top, [low - top])[0])
    return np.array(found)


def test_heights_agree_with_the_dsm(cache):
    rng = np.random.default_rng(0)
    # At cell centres, where the DSM states a height; away from its nodata corner.
    i, j = rng.integers(70, CELLS - 5, (2, 60))
    east, north = LEFT + (i + 0.5) * STEP + 0.003, TOP - (j + 0.5) * STEP - 0.002
    error = surface(cache, east, north) - height(east, north)
    block = np.abs(error) > 1  # a ray beside the block's wall may fall to either side
    assert block.mean() < 0.05
    assert np.abs(error[~block]).max() < 0.05


def test_the_picture_lies_on_the_right_ground(cache):
    spot = LEFT + 100.0, TOP - 110.0
    ground = ecef_from_crs(UTM, np.array([[*spot, float(height(*spot))]]))
    target = cache.frame.ecef_from_enu.inverse.apply(ground)[0]
    down = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    camera = Camera.from_fov(65, 65, 20)
    with TileStreamer(cache) as streamer:
        renderer = NumbaRenderer(streamer, threads=1)
        view = renderer.render(Pose(down, target + [0, 0, 60]), camera, wait=True)
    assert view.depth[32, 32] == pytest.approx(60, abs=0.05)
    width = CELLS * STEP
    red, green, _ = view.rgb[32, 32].astype(float)
    assert red / 255 * width == pytest.approx(100, abs=1.0)
    assert green / 255 * width == pytest.approx(110, abs=1.0)


def test_coarser_levels_cover_the_same_ground(cache):
    assert cache.manifest.levels >= 3
    root = cache.load_tile(0)
    low, high = root.bounds
    assert (high - low)[:2] == pytest.approx((CELLS - 1) * STEP, abs=2.5)
    assert len(root.faces) < 40_000


def reprojected(path, moved, **options):
    """The raster in degrees."""
    with rasterio.open(path) as source:
        transform, width, height_ = calculate_default_transform(
            source.crs, "EPSG:4326", source.width, source.height, *source.bounds
        )
        profile = source.profile | {
            "crs": "EPSG:4326", "transform": transform, "width": width, "height": height_,
        }  # fmt: skip
        with rasterio.open(moved, "w", **profile) as out:
            for band in range(1, source.count + 1):
                reproject(rasterio.band(source, band), rasterio.band(out, band), **options)
    return moved


def test_projections_are_undone(rasters, cache, build, tmp_path):
    dsm, ortho = rasters
    moved = reprojected(ortho, tmp_path / "moved.tif", resampling=Resampling.bilinear)
    caches = (cache, build([dsm, moved], **DATUM))
    first, second = (leaf_meshes(one)[0].mips[0] for one in caches)
    assert np.abs(first.astype(int) - second).mean() < 3


def test_a_geographic_dsm_goes_to_utm(tmp_path, build, rasters):
    dsm, ortho = rasters
    moved = reprojected(dsm, tmp_path / "geo_dsm.tif", dst_nodata=-9999)
    cache = build([moved, ortho], **DATUM)
    east, north = LEFT + np.array([100.0, 120.0]), TOP - np.array([110.0, 30.0])
    assert np.abs(surface(cache, east, north) - height(east, north)).max() < 0.3


def test_what_is_missing_is_said(rasters, build, tmp_path):
    dsm, ortho = rasters
    with pytest.raises(GeoreferenceError, match="vertical datum"):
        build([dsm, ortho], geoid_separation_m=48.0)
    with pytest.raises(GeoreferenceError, match=r"--vertical-datum"):
        build([dsm, ortho])
    with pytest.raises(GeoreferenceError, match="vertical datum 'sea'"):
        build([dsm, ortho], geoid_separation_m=48.0, vertical_datum="sea")
    with pytest.raises(MapSourceError, match="the orthophoto is missing"):
        build([dsm], **DATUM)
    with pytest.raises(MapSourceError, match="a second DSM"):
        build([dsm, dsm], **DATUM)
    bare = write_raster(tmp_path / "bare.tif", np.zeros((9, 9), np.float32), None)
    with pytest.raises(GeoreferenceError, match="CRS"):
        build([bare, ortho], **DATUM)
    odd = write_raster(tmp_path / "odd.tif", np.zeros((5, 9, 9), np.uint16))
    with pytest.raises(MapSourceError, match="neither a DSM"):
        build([odd, ortho], **DATUM)


@pytest.mark.parametrize("keep", [0, 100, 3000])
def test_truncated_rasters_are_named_errors(rasters, build, tmp_path, keep):
    dsm, ortho = rasters
    cut = tmp_path / "cut.tif"
    cut.write_bytes(ortho.read_bytes()[:keep])
    with pytest.raises(MapSourceError):
        build([dsm, cut], **DATUM)
    assert not (tmp_path / "cache").exists()


@pytest.mark.real
def test_heights_of_a_part_of_portugal_agree_with_its_dsm(real_data, build, tmp_path):
    folder = real_data("portugal")
    paths = [cut_out(folder / name, tmp_path / name) for name in ("dsm.tif", "ortho.tif")]
    cache = build(paths, vertical_datum="ellipsoidal")
    with rasterio.open(paths[0]) as data:
        heights, transform = data.read(1), data.transform
    rng = np.random.default_rng(1)
    rows, columns = (rng.integers(10, n - 10, 60) for n in heights.shape)
    keep = heights[rows, columns] > -9000
    east, north = rasterio.transform.xy(transform, rows[keep], columns[keep])
    errors = surface(cache, east, north, "EPSG:32629") - heights[rows, columns][keep]
    assert len(errors) > 25
    assert np.median(np.abs(errors)) < 0.005
    assert np.percentile(np.abs(errors), 90) < 0.05
