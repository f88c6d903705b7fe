"""Footprints and a bare terrain: roofs as high as said, walls upright, and what is no building."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import rasterio
from pyproj import Transformer

from localizer.errors import MapSourceError
from localizer.map.footprints.raise_buildings import raise_buildings, read_footprints
from tests.localizer.map.conftest import write_raster

CRS, LEFT, TOP, SIDE = "EPSG:25832", 462_000.0, 5_250_400.0, 60
HOUSE = [(LEFT + x, TOP - y) for x, y in ((10.2, 10.3), (30.7, 12.1), (28.9, 25.4), (9.1, 22.8))]


def ground(east, north):
    """A slope of one in ten."""
    return 400.0 + 0.1 * (np.asarray(east) - LEFT)


@pytest.fixture
def terrain(tmp_path: Path) -> Path:
    at = np.arange(SIDE) + 0.5
    east, north = np.meshgrid(LEFT + at, TOP - at)
    return write_terrain(tmp_path / "terrain.tif", ground(east, north))


def write_terrain(path: Path, heights, crs: str = CRS, **more: object) -> Path:
    data = heights.astype(np.float32)
    return write_raster(path, data, crs, place=(LEFT, TOP), nodata=-9999.0, **more)


def geojson(path: Path, *features: tuple[dict, object], crs: str | None = None) -> Path:
    """Features of properties and polygon coordinates."""
    document: dict[str, object] = {"type": "FeatureCollection", "features": [
        {"type": "Feature", "properties": said,
         "geometry": {"type": "Polygon", "coordinates": places}} for said, places in features
    ]}  # fmt: skip
    if crs:
        document["crs"] = {"type": "name", "properties": {"name": crs}}
    path.write_text(json.dumps(document))
    return path


def lonlat(places):
    x, y = Transformer.from_crs(CRS, 4326, always_xy=True).transform(*np.array(places).T)
    return [[float(a), float(b)] for a, b in zip(x, y, strict=True)]


def heights_at(path: Path, places) -> np.ndarray:
    with rasterio.open(path) as file:
        return np.array([value[0] for value in file.sample(places)])


def beside(edge: int, metres: float) -> tuple[float, float]:
    """A place so far outside the middle of a wall, inside where negative."""
    a, b = np.array(HOUSE[edge]), np.array(HOUSE[(edge + 1) % 4])
    out = np.array([-(b - a)[1], (b - a)[0]]) / np.linalg.norm(b - a)
    middle = 0.5 * (a + b)
    towards = np.mean(HOUSE, axis=0) - middle
    out = -out if out @ towards > 0 else out
    return tuple(middle + metres * out)


@pytest.mark.parametrize("kind", ["geojson", "old geojson", "citygml", "citygml north first"])
def test_roofs_are_as_high_as_said_and_walls_stand_upright(tmp_path, terrain, kind):
    if kind == "geojson":
        file = geojson(tmp_path / "a.geojson", ({"height": "12.5 m"}, [lonlat(HOUSE)]))
    elif kind == "old geojson":
        file = geojson(tmp_path / "a.json", ({"height": 12.5}, [HOUSE]), crs="EPSG:25832")
    else:
        places = [p[::-1] for p in HOUSE] if "north" in kind else HOUSE
        file = citygml(tmp_path / "a.gml", places, 12.5)
    out = tmp_path / "surface.tif"
    done = raise_buildings(terrain, read_footprints(file), out)
    assert (done.raised, done.missed, done.small) == (1, 0, 0)
    roof = ground(min(x for x, _ in HOUSE), 0) + 12.5
    within = [beside(edge, -0.5) for edge in range(4)]
    outside = [beside(edge, 0.5) for edge in range(4)]
    assert heights_at(out, [*within, np.mean(HOUSE, axis=0)]) == pytest.approx(roof, abs=0.1)
    bare = ground(np.array(outside)[:, 0], 0)
    assert heights_at(out, outside) == pytest.approx(bare, abs=0.1)
    with rasterio.open(out) as file_:
        assert file_.res == (0.5, 0.5)
        assert file_.crs == CRS


@pytest.mark.parametrize(
    ("old", "new", "metres"),
    [
        ("EPSG::25832", "EPSG::2263", 12.5 * 1200 / 3937),
        ("<bldg:lod1Solid>", "<bldg:measuredHeight uom='m'>20</bldg:measuredHeight>\\g<0>", 20.0),
        ("<bldg:lod1Solid>", "<bldg:measuredHeight uom='urn:ogc:def:uom:UCUM::[ft_i]'>20"
         "</bldg:measuredHeight>\\g<0>", 6.096),
    ],
)  # fmt: skip
def test_a_model_of_a_town_that_counts_in_feet_is_no_three_times_higher(tmp_path, old, new, metres):
    file = citygml(tmp_path / "a.gml", HOUSE, 12.5)
    file.write_text(re.sub(old, new, file.read_text()))
    assert read_footprints(file).buildings[0].height_m == pytest.approx(metres)


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ("<bldg:lod1Solid>", "<bldg:measuredHeight uom='fathom'>20</bldg:measuredHeight>\\g<0>",
         "has the unit 'fathom'"),
        ("EPSG::25832", "EPSG::999999", "999999"),
    ],
)  # fmt: skip
def test_a_unit_or_crs_that_nobody_knows_is_named(tmp_path, old, new, why):
    file = citygml(tmp_path / "a.gml", HOUSE, 12.5)
    file.write_text(re.sub(old, new, file.read_text()))
    with pytest.raises(MapSourceError, match=why):
        read_footprints(file)


def test_a_court_stays_open_and_a_tower_on_a_house_is_not_lifted_by_it(tmp_path, terrain):
    court = [(LEFT + x, TOP - y) for x, y in ((16, 15), (22, 15), (22, 20), (16, 20))]
    tower = [(LEFT + x, TOP - y) for x, y in ((11, 12), (14, 12), (14, 15), (11, 15))]
    file = geojson(
        tmp_path / "a.geojson",
        ({"height": 10}, [lonlat(HOUSE), lonlat(court)]), ({"height": 30}, [lonlat(tower)]),
    )  # fmt: skip
    out = tmp_path / "surface.tif"
    raise_buildings(terrain, read_footprints(file), out)
    inside = LEFT + 19.0, TOP - 17.5
    top = LEFT + 12.5, TOP - 13.5
    assert heights_at(out, [inside, top]) == pytest.approx([401.9, 431.1], abs=0.15)


def test_what_has_no_height_or_lies_beside_is_counted_and_told(tmp_path, terrain):
    far = [(x + 5000.0, y) for x, y in HOUSE]
    dot = [(LEFT + 5.1, TOP - 5.1), (LEFT + 5.15, TOP - 5.1), (LEFT + 5.1, TOP - 5.15)]
    file = geojson(
        tmp_path / "a.geojson", ({"building:levels": "4"}, [lonlat(HOUSE)]),
        ({"height": 9}, [lonlat(far)]), ({"height": 9}, [lonlat(dot)]), ({}, [lonlat(HOUSE)]),
        ({"height": -3}, [lonlat(HOUSE)]), ({"height": float("nan")}, [lonlat(HOUSE)]),
        ({"height": 9}, [[[0, 0], [1, 1]]]), ({"height": 9}, "nothing"),
    )  # fmt: skip
    done = raise_buildings(terrain, read_footprints(file), tmp_path / "surface.tif")
    assert done.line() == (
        "1 buildings raised in cells of 0.50 m; 1 of them by their storeys at 3 m; 5 left out: "
        "without a height or an outline; 1 left out: beside the terrain; 1 left out: smaller than "
        "a cell"
    )


@pytest.mark.parametrize(
    ("members", "whose"),
    [
        ({}, ""), ({"copyright": ["a"], "license": 3}, ""),
        ({"attribution": "the\x1b[31m town\n"}, "the [31m town"),
        ({"copyright": "the town", "attribution": "the town", "licence": "CC0"}, "the town; CC0"),
        ({"copyright": "x" * 10_000}, "x" * 300),
    ],
)  # fmt: skip
def test_a_file_says_whose_its_buildings_are(tmp_path, members, whose):
    file = geojson(tmp_path / "a.geojson", ({"height": 9}, [lonlat(HOUSE)]))
    file.write_text(json.dumps(json.loads(file.read_text()) | members))
    assert read_footprints(file).attribution == whose


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("{}", "no GeoJSON"), ("[1", "no GeoJSON"), ('{"features": []}', "no building"),
        ('{"features": [null, {"properties": 3, "geometry": 4}]}', "no building"),
    ],
)  # fmt: skip
def test_what_is_no_file_of_footprints_is_named(tmp_path, text, why):
    file = tmp_path / "a.geojson"
    file.write_text(text)
    with pytest.raises(MapSourceError, match=why):
        read_footprints(file)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("<a", "no CityGML"),
        ("<a/>", "no building"),
        ('<!DOCTYPE a [<!ENTITY x "y">]><a>&x;</a>', "document type"),
    ],
)
def test_what_is_no_citygml_is_named(tmp_path, text, why):
    file = tmp_path / "a.gml"
    file.write_text(text)
    with pytest.raises(MapSourceError, match=why):
        read_footprints(file)


def test_buildings_of_another_place_and_heights_in_feet_are_refused(tmp_path, terrain):
    far = geojson(tmp_path / "far.geojson", ({"height": 9}, [[[0, 0], [0, 1], [1, 1]]]))
    out = tmp_path / "surface.tif"
    with pytest.raises(MapSourceError, match="none of its 1 buildings meets"):
        raise_buildings(terrain, read_footprints(far), out)
    here = geojson(tmp_path / "here.geojson", ({"height": 9}, [lonlat(HOUSE)]))
    feet = write_terrain(tmp_path / "feet.tif", np.full((SIDE, SIDE), 900.0), f"{CRS}+8228")
    with pytest.raises(MapSourceError, match="plain metres"):
        raise_buildings(feet, read_footprints(here), out)
    assert not out.exists()


def citygml(path: Path, places, height_m: float) -> Path:
    """A CityGML 2.0 building as LOD1: its ground, a wall and its roof; its height by its solid."""

    def polygon(corners, z):
        text = " ".join(f"{x:.3f} {y:.3f} {z:.3f}" for x, y in [*corners, corners[0]])
        return ("<gml:surfaceMember><gml:Polygon><gml:exterior><gml:LinearRing><gml:posList>"
                f"{text}</gml:posList></gml:LinearRing></gml:exterior></gml:Polygon>"
                "</gml:surfaceMember>")  # fmt: skip

    a, b = places[:2]
    wall = (f"{a[0]} {a[1]} 400 {b[0]} {b[1]} 400 {b[0]} {b[1]} {400 + height_m} "
            f"{a[0]} {a[1]} 400")  # fmt: skip
    path.write_text(
        f"""<?xml version="1.0"?>
<core:CityModel xmlns:core="http://www.opengis.net/citygml/2.0"
  xmlns:bldg="http://www.opengis.net/citygml/building/2.0" xmlns:gml="http://www.opengis.net/gml">
 <gml:boundedBy><gml:Envelope srsName="urn:ogc:def:crs,crs:EPSG::25832,crs:EPSG::7837"
   srsDimension="3"/></gml:boundedBy>
 <core:cityObjectMember><bldg:Building><bldg:lod1Solid><gml:Solid><gml:exterior>
  <gml:CompositeSurface>{polygon(places, 400)}{polygon(places, 400 + height_m)}
  <gml:surfaceMember><gml:Polygon><gml:exterior><gml:LinearRing><gml:posList>{wall}</gml:posList>
  </gml:LinearRing></gml:exterior></gml:Polygon></gml:surfaceMember>
  </gml:CompositeSurface></gml:exterior></gml:Solid></bldg:lod1Solid></bldg:Building>
 </core:cityObjectMember></core:CityModel>"""
    )
    return path
