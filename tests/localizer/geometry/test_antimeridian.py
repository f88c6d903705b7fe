"""What lies across the 180th meridian is small, and drawn where it is."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from localizer.geometry.antimeridian import GeoBox, geo_box, lon_near, split_outline, wrapped
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.map.inspection.footprint import as_geojson, as_kml
from localizer.map.inspection.usable import usable_part

TAVEUNI = [(-16.9, 179.98), (-16.9, -179.97), (-16.8, -179.97), (-16.8, 179.98)]  # Fiji
BERN = [(46.9, 7.4), (46.9, 7.5), (47.0, 7.5), (47.0, 7.4)]


def manifest(extent: list[tuple[float, float]]) -> Any:
    return SimpleNamespace(
        extent=extent, attribution="me", gsd_m=0.1, height_range_m=(0.0, 9.0),
        geoid_separation_m=50.0,
    )  # fmt: skip


@pytest.mark.parametrize("first", range(4))
def test_a_box_goes_from_west_to_east(first: int) -> None:
    """A map of 5 km in Fiji was told to reach from -179.97 to 179.98 degrees."""
    turned = TAVEUNI[first:] + TAVEUNI[:first]
    box = geo_box(turned)
    assert (box.south, box.north) == (-16.9, -16.8)
    assert (box.west, box.east) == pytest.approx((179.98, -179.97))
    assert geo_box(BERN) == GeoBox(46.9, 7.4, 47.0, 7.5)


def test_longitudes() -> None:
    assert wrapped(180.0) == 180.0
    assert wrapped(-180.0) == -180.0
    assert wrapped(180.5) == -179.5
    assert lon_near(-179.9, 179.9) == pytest.approx(180.1)
    assert lon_near(179.9, -179.9) == pytest.approx(-180.1)
    assert lon_near(7.4, 7.5) == pytest.approx(7.4)


@pytest.mark.parametrize("first", range(4))
def test_an_outline_is_cut_in_two(first: int) -> None:
    turned = TAVEUNI[first:] + TAVEUNI[:first]
    parts = split_outline([(lon, lat) for lat, lon in turned])
    assert len(parts) == 2
    assert sorted((min(x), max(x)) for x in ([lon for lon, _ in p] for p in parts)) == [
        pytest.approx((-180.0, -179.97)), pytest.approx((179.98, 180.0)),
    ]  # fmt: skip
    geometry = json.loads(as_geojson(manifest(turned), "fiji"))["features"][0]["geometry"]
    assert geometry["type"] == "MultiPolygon"
    for (ring,) in geometry["coordinates"]:
        x, y = np.array(ring).T
        assert ring[0] == ring[-1]
        assert np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) > 0  # counter-clockwise
    assert as_kml(manifest(turned), "fiji").count("<Polygon>") == 2


def test_an_outline_elsewhere_and_one_that_ends_at_the_meridian_are_as_they_were() -> None:
    geometry = json.loads(as_geojson(manifest(BERN), "bern"))["features"][0]["geometry"]
    assert geometry["type"] == "Polygon"
    assert geometry["coordinates"][0][:4] == [[lon, lat] for lat, lon in BERN]
    edge = [(179.9, 0.0), (180.0, 0.0), (180.0, 1.0), (179.9, 1.0)]
    assert split_outline(edge) == [edge]


def test_the_usable_part_is_a_rectangle_there_too() -> None:
    frame = LocalFrame(Geodetic(-16.85, 180.0, 50.0))
    mosaic: Any = SimpleNamespace(gsd_m=1.0, place=lambda r, c: (c - 200.0, 200.0 - r))
    faulty = np.zeros((400, 400), bool)
    faulty[:40] = True
    found = usable_part(mosaic, faulty, 80.0, frame)
    assert found is not None
    assert found.box.west > 179.99
    assert found.box.east < -179.99
    assert found.box.south < found.box.north
