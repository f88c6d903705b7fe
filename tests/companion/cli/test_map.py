"""``companion map``: building, showing and exporting caches from the shell."""

from __future__ import annotations

import json
import re
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import rasterio
from typer.testing import CliRunner

from companion.cli.commands import app
from companion.errors import ConfigError, ReportError
from localizer.map.building import build
from localizer.map.cache.cache import TileCache
from tests.localizer.map.conftest import write_tileset


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """tileset.json of a tileset of 21 tiles."""
    return write_tileset(tmp_path_factory.mktemp("source"))


def run(*arguments):
    return CliRunner().invoke(app, ["map", *map(str, arguments)])


def test_commands(source, tmp_path):
    out = tmp_path / "c"
    built = run("build", source, "--out", out, "--workers", "1")
    assert built.exit_code == 0, built.output
    assert "21 tiles" in built.output
    shown = run("info", out)
    assert "47.5" in shown.output
    assert "4 " in shown.output
    assert "21 of 21 tiles intact" in run("verify", out).output
    picture = tmp_path / "v.png"
    place = ["--latitude", 47.2, "--longitude", 8.2, "--height", 500]
    assert run("render", out, *place, "--width", 64, "--out", picture).exit_code == 0
    assert cv2.imread(str(picture)).shape == (960, 64, 3)
    assert (tmp_path / "v_depth.png").is_file()
    assert run("export", out, "--out", tmp_path / "e.glb", "--level", 1).exit_code == 0
    TileCache.open(out).tile_path(2).write_bytes(b"x")
    damaged = run("verify", out)
    assert damaged.exit_code == 1
    assert "tile 2" in damaged.output


@pytest.fixture
def ortho(tmp_path):
    path = tmp_path / "ortho.tif"
    pixels = np.random.default_rng(0).integers(0, 255, (3, 90, 120), np.uint8)
    corner = rasterio.Affine(2.0, 0.0, 465_000.0, 0.0, -2.0, 5_250_000.0)
    with rasterio.open(path, "w", driver="GTiff", width=120, height=90, count=3, dtype="uint8",
                       crs="EPSG:32632", transform=corner) as file:  # fmt: skip
        file.write(pixels)
    return path


def test_an_orthophoto_alone_becomes_a_flat_map(ortho, tmp_path):
    out = tmp_path / "made" / "area"
    own = out.with_name("area-ground.tif")
    out.parent.mkdir()
    own.write_text("the user's")
    alone = run("build", ortho, "--out", out)
    assert "--flat-ground METRES" in str(alone.exception)
    options = ("--flat-ground", 430, "--vertical-datum", "ellipsoidal", "--workers", 1)
    assert run("build", ortho, "--out", out, *options).exit_code == 0
    cache = TileCache.open(out)
    assert cache.manifest.height_range_m == pytest.approx((430.0, 430.0), abs=5.0)
    assert cache.manifest.kind.heights == "flat"
    assert cache.manifest.source == str(ortho)
    assert own.read_text() == "the user's"
    assert sorted(out.parent.iterdir()) == [out, own]


@pytest.mark.parametrize(
    ("ground", "options", "why"),
    [(430, ("--height-unit", "ft"), "leave out --height-unit ft"),
     (430, ("--heights", "surface"), "leave out --heights surface"),
     (9001, (), "-500 to 9000"), (-501, (), "-500 to 9000"),
     (430, ("dsm.tif",), "for an orthophoto alone")],
)  # fmt: skip
def test_what_contradicts_a_flat_ground_is_named(ortho, tmp_path, ground, options, why):
    result = run("build", ortho, *options, "--out", tmp_path / "c", "--flat-ground", ground)
    assert isinstance(result.exception, ConfigError)
    assert why in str(result.exception)


def test_an_interrupted_build_says_how_to_go_on(source, tmp_path, monkeypatch):
    def interrupted(*_args, **_options):
        raise KeyboardInterrupt

    monkeypatch.setattr(build, "build_cache", interrupted)
    result = run("build", source, "--out", tmp_path / "c")
    assert result.exit_code == 130
    assert "the same command goes on" in result.output


@pytest.mark.parametrize("what", ["render", "export"])
@pytest.mark.parametrize(
    ("place", "why"),
    [("none/v.png", "no such folder"), ("v.png", "cannot be written: No space left")],
)
def test_a_place_that_cannot_be_written_is_one_line(
    terrain, tmp_path, monkeypatch, what, place, why
):
    def full(_path, _data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    pose = ["--latitude", 47.2, "--longitude", 8.2, "--height", 500, "--width", 64]
    place = (tmp_path / place).with_suffix(".png" if what == "render" else ".glb")
    result = run(what, terrain.path, *(pose if what == "render" else ()), "--out", place)
    assert isinstance(result.exception, ReportError)
    assert why in str(result.exception)


def test_info_says_where_the_map_is_and_writes_its_outline(terrain, tmp_path):
    geojson, kml = tmp_path / "area.geojson", tmp_path / "area.kml"
    result = run("info", terrain.path, "--geojson", geojson, "--kml", kml)
    assert result.exit_code == 0
    assert "47.19" in result.output
    assert "EGM96 there: 47.75" in result.output
    refused = run("info", terrain.path, "--kml", tmp_path / "area.txt")
    assert "--kml" in str(refused.exception)
    missing = run("info", terrain.path, "--geojson", tmp_path / "none" / "area.geojson")
    assert re.search("--geojson .*no such folder", str(missing.exception))
    (feature,) = json.loads(geojson.read_text())["features"]
    ring = np.array(feature["geometry"]["coordinates"][0])
    assert ring[0].tolist() == ring[-1].tolist()
    x, y = ring.T
    assert (x[:-1] * y[1:] - x[1:] * y[:-1]).sum() > 0  # counter-clockwise, as RFC 7946 asks
    assert ring.mean(axis=0) == pytest.approx([8.2, 47.2], abs=2e-3)
    east, north = np.ptp(ring, axis=0) * 111_200 * [np.cos(np.radians(47.2)), 1]
    assert (east, north) == pytest.approx((400, 400), rel=0.01)
    root = ElementTree.parse(kml).getroot()
    text = root.findtext(".//{http://www.opengis.net/kml/2.2}coordinates")
    corners = np.array([place.split(",") for place in text.split()], np.float64)
    assert corners == pytest.approx(ring, abs=1e-7)
