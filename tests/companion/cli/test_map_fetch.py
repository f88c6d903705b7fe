"""From an empty folder to a verified cache by one command, against services on loopback."""

import json
import re

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

pytest.importorskip("owslib")
pytest.importorskip("pystac")
from companion.cli.commands import app
from localizer.geometry.geoid import geoid_separation
from localizer.map.cache.cache import TileCache
from localizer.map.cache.pick import MapSurface
from localizer.map.fetch.catalogue import load_sources
from localizer.map.fetch.cloud import CloudFile
from tests.localizer.map.fetch.loopback import (
    LEFT,
    TOP,
    geographic,
    height_m,
    rectangle,
    serving,
    write_stac,
    write_world,
)

BOX = ",".join(f"{v:.7f}" for v in rectangle())


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    folder = write_world(tmp_path_factory.mktemp("world"))
    with serving(folder) as served:
        write_stac(folder, served.url)
        yield served


@pytest.fixture
def sources(server, tmp_path):
    common = {"licence": "CC0", "country": "nowhere", "bounds": list(rectangle(0.0))}
    entries = [
        common | {"name": "photos", "title": "photos", "kind": "stac", "role": "imagery",
                  "url": f"{server.url}/stac/catalog.json", "attribution": "the photographers",
                  "resolution_m": 0.5, "date": "2024-06-01", "rate_per_s": 50},
        common | {"name": "surface", "title": "surface", "kind": "cog", "role": "surface",
                  "url": f"{server.url}/surface.tif", "attribution": "the surveyors",
                  "resolution_m": 1.0, "vertical_datum": "amsl", "rate_per_s": 50},
    ]  # fmt: skip
    path = tmp_path / "sources.yaml"
    path.write_text(yaml.safe_dump({"sources": entries}))
    return path


def run(*arguments):
    return CliRunner().invoke(app, ["map", *map(str, arguments)], env={"COLUMNS": "300"})


def test_one_command_makes_a_cache_whose_heights_are_right(server, sources, tmp_path):
    out = tmp_path / "area"
    command = (
        "fetch", "--rectangle", BOX, "--imagery", "photos", "--heights", "surface",
        "--sources", sources, "--out", out, "--workers", 1,
    )  # fmt: skip
    done = run(*command)
    assert done.exit_code == 0, done.output
    assert "all intact" in done.output
    assert re.search(r"photos: .*requests, .* MB, \d+ s", done.output)  # before it asks

    cache = TileCache.open(out)
    assert cache.manifest.attribution.startswith("the photographers; the surveyors (licences: CC0")
    assert cache.manifest.imagery_date == "2024-06-01"
    assert (cache.manifest.kind.heights, cache.manifest.kind.sensor) == ("terrain", "photos")
    surface = MapSurface(cache)
    wrong = []
    for east in LEFT + np.array([80.0, 133.0, 201.0, 262.5, 320.0]):
        for north in TOP - np.array([80.0, 150.5, 233.0, 320.0]):
            latitude, longitude = geographic(east, north)
            truth = height_m(east, north) + geoid_separation(latitude, longitude)
            at = cache.frame.enu_from_geodetic(latitude, longitude, truth + 300.0)
            below = cache.frame.enu_from_geodetic(latitude, longitude, truth)
            down = (below - at) / np.linalg.norm(below - at)
            hit = surface.cast(at, down[None])
            wrong.append(float(hit.distances[0]) - 300.0)
    assert np.isfinite(wrong).all()
    assert np.abs(wrong).max() < 0.5
    assert not (tmp_path / "area.fetch").exists()


def test_footprints_become_buildings_on_a_fetched_terrain(server, sources, tmp_path):
    """From an empty folder: the roof's height and the ground's beside it, each to half a metre."""
    entries = yaml.safe_load(sources.read_text())
    entries["sources"][1] |= {"role": "terrain", "name": "terrain"}
    sources.write_text(yaml.safe_dump(entries))
    corners = [(LEFT + x, TOP - y) for x, y in ((180, 180), (220, 180), (220, 215), (180, 215))]
    places = [list(reversed(geographic(*corner))) for corner in corners]
    feature = {"type": "Feature", "properties": {"height": 17.0},
               "geometry": {"type": "Polygon", "coordinates": [places]}}  # fmt: skip
    file = tmp_path / "houses.geojson"
    whose = {"copyright": "OpenStreetMap\ncontributors", "license": "ODbL 1.0"}
    file.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]} | whose))
    out = tmp_path / "area"
    done = run(
        "fetch", "--rectangle", BOX, "--imagery", "photos", "--heights", "terrain", "--sources",
        sources, "--out", out, "--workers", 1, "--footprints", file,
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    assert "1 buildings raised in cells of 0.50 m" in done.output
    cache = TileCache.open(out)
    named = "buildings: OpenStreetMap contributors; ODbL 1.0"
    assert named in cache.manifest.attribution
    assert "whose the footprints are" not in done.output
    edge = LEFT + np.arange(180.0, 221.0)
    low = min(height_m(edge, TOP - y).min() for y in (180.0, 215.0))
    for east, north, truth in (
        (LEFT + 200.0, TOP - 200.0, low + 17.0), (LEFT + 181.0, TOP - 214.0, low + 17.0),
        (LEFT + 178.5, TOP - 200.0, None), (LEFT + 200.0, TOP - 216.5, None),
    ):  # fmt: skip
        above = height_m(east, north) if truth is None else truth
        assert _surface_m(cache, east, north) == pytest.approx(above, abs=0.5)


def _surface_m(cache: TileCache, east: float, north: float) -> float:
    """Above the geoid, where a plumb line meets the map."""
    latitude, longitude = geographic(east, north)
    geoid = geoid_separation(latitude, longitude)
    at, below = (cache.frame.enu_from_geodetic(latitude, longitude, h) for h in (900.0, 800.0))
    down = (below - at) / np.linalg.norm(below - at)
    return 900.0 - float(MapSurface(cache).cast(at, down[None]).distances[0]) - geoid


def test_footprints_on_a_surface_are_refused(server, sources, tmp_path):
    file = tmp_path / "houses.geojson"
    ring = [[8.0, 47.0], [8.1, 47.0], [8.1, 47.1]]
    feature = {"properties": {"height": 9}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
    file.write_text(json.dumps({"features": [feature]}))
    done = run(
        "fetch", "--rectangle", BOX, "--imagery", "photos", "--heights", "surface", "--sources",
        sources, "--out", tmp_path / "a", "--footprints", file,
    )  # fmt: skip
    assert done.exit_code != 0
    assert "has its buildings" in str(done.exception)


def test_the_estimate_asks_for_nothing_large_and_a_bound_stops_before(server, sources, tmp_path):
    common = ("--sources", sources, "--imagery", "photos", "--heights", "surface", "--out")
    before = server.bytes
    told = run("fetch", "--rectangle", BOX, *common, tmp_path / "a", "--estimate")
    assert told.exit_code == 0, told.output
    assert not (tmp_path / "a").exists()
    assert server.bytes - before < 600_000  # the catalogue, and the heads of two files
    stopped = run("fetch", "--rectangle", BOX, *common, tmp_path / "a", "--most-mb", 0.1)
    assert stopped.exit_code != 0
    assert "--most-mb" in str(stopped.exception)
    assert not (tmp_path / "a.fetch").exists()


def test_files_that_a_source_lacks_are_named_before_anything_is_fetched(
    server, sources, tmp_path, monkeypatch
):
    """They may be land: a hole in the map that nobody was told of."""

    def degrees(source, _area):
        names = "surface.tif", "Copernicus_N40_E046.tif"
        return [CloudFile(f"{server.url}/{name}", source.bounds, may_lack=True) for name in names]

    common = ("fetch", "--rectangle", BOX, "--sources", sources, "--imagery", "photos",
              "--heights", "surface", "--out", tmp_path / "a", "--estimate")  # fmt: skip
    assert "warning" not in run(*common).output
    monkeypatch.setattr("localizer.map.fetch.fetch.degree_files", degrees)
    told = run(*common)
    assert told.exit_code == 0, told.output
    assert re.search(r"warning: surface has no Copernicus_N40_E046\.tif: .*hole", told.output)


@pytest.mark.parametrize("how", ["circle", "mission"])
def test_the_place_is_a_circle_or_a_mission(server, sources, tmp_path, how):
    latitude, longitude = geographic(LEFT + 200.0, TOP - 200.0)
    if how == "circle":
        place: tuple[str, ...] = ("--circle", f"{latitude:.7f},{longitude:.7f},60")
    else:
        path = tmp_path / "mission.waypoints"
        lines = [
            f"{number}\t0\t{frame}\t16\t0\t0\t0\t0\t{latitude}\t{longitude}\t50\t1"
            for number, frame in ((0, 0), (1, 3))
        ]
        path.write_text("\n".join(["QGC WPL 110", *lines, ""]))
        place = ("--mission", str(path), "--margin", "60")
    told = run(
        "fetch", *place, "--imagery", "photos", "--heights", "surface", "--sources", sources,
        "--out", tmp_path / "a", "--estimate",
    )  # fmt: skip
    assert told.exit_code == 0, told.output
    assert "0.12 x 0.12 km" in told.output


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ((), "one of --rectangle"),
        (("--rectangle", "1,2,3"), "4 numbers"),
        (("--rectangle", "1,2,3,x"), "4 numbers"),
        (("--circle", "47,8,10", "--rectangle", BOX), "one of"),
        (("--circle", "47,8,1e9"), "100 km"),
        (("--rectangle", BOX, "--imagery", "bing"), "there are:"),
    ],
)
def test_what_cannot_be_is_named(tmp_path, arguments, why):
    done = run("fetch", *arguments, "--out", tmp_path / "a")
    assert done.exit_code != 0
    assert why in str(done.exception)


def test_sources_are_listed_with_licence_and_whom_to_name(sources):
    listed = run("sources", "--sources", sources)
    assert "the photographers" in listed.output
    assert "copernicus-glo30" in listed.output
    assert "vertical_datum" in run("sources", "--keys").output


def test_names_of_sources_are_whole_at_any_width(sources, monkeypatch):
    """80 columns broke "ch-swisssurface3d" in the middle: it could not be copied."""
    names = [s.name for s in load_sources((sources,))]
    listed = run("sources", "--sources", sources).output  # no terminal: a line each, however long
    assert all(f"{name}  (" in listed for name in names)
    assert max(map(len, listed.splitlines())) > 120
    monkeypatch.setenv("FORCE_COLOR", "1")  # which rich takes for a terminal
    monkeypatch.setenv("COLUMNS", "80")
    shown = CliRunner().invoke(app, ["map", "sources", "--sources", str(sources)]).output
    lines = re.sub("\x1b\\[[0-9;]*m", "", shown).splitlines()
    assert all(any(line.startswith(f"{name}  (") for line in lines) for name in names)
    assert max(map(len, lines)) <= 80
    assert any(line.startswith("    attribution: ") for line in lines)
