from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from localizer.errors import GeoreferenceError
from localizer.geometry.geo import (
    NED_FROM_ENU,
    GeoBox,
    Geodetic,
    LocalFrame,
    ecef_from_geodetic,
    geo_box,
    lon_near,
    split_outline,
    wrapped,
)
from localizer.geometry.geoid import geoid_separation
from localizer.map.inspection.alignment import usable_part
from localizer.map.inspection.inspect import as_geojson, as_kml

A, F = 6378137.0, 1 / 298.257223563  # WGS84
LATITUDE, LONGITUDE, HEIGHT = st.floats(-89.9, 89.9), st.floats(-179.9, 179.9), st.floats(-400, 9e3)
CANBERRA = Geodetic(-35.363262, 149.165237, 584.0)


def closed_form_ecef(lat, lon, h):
    lat, lon = np.radians([lat, lon])
    e2 = F * (2 - F)
    n = A / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    return np.array(
        [
            (n + h) * np.cos(lat) * np.cos(lon),
            (n + h) * np.cos(lat) * np.sin(lon),
            (n * (1 - e2) + h) * np.sin(lat),
        ]
    )


@given(LATITUDE, LONGITUDE, HEIGHT)
def test_ecef_is_the_ellipsoids_closed_form(lat, lon, h):
    np.testing.assert_allclose(
        ecef_from_geodetic(lat, lon, h), closed_form_ecef(lat, lon, h), atol=1e-6
    )


@given(LATITUDE, LONGITUDE, HEIGHT, st.lists(st.floats(-5e3, 5e3), min_size=3, max_size=3))
def test_enu_round_trip(lat, lon, h, enu):
    frame = LocalFrame(Geodetic(lat, lon, h))
    geodetic = frame.geodetic_from_enu(enu)
    np.testing.assert_allclose(frame.enu_from_geodetic(*geodetic), enu, atol=1e-5)


def test_axes_point_east_north_and_up():
    frame = LocalFrame(CANBERRA)
    lat, lon, h = CANBERRA.latitude_deg, CANBERRA.longitude_deg, CANBERRA.height_m
    np.testing.assert_allclose(frame.enu_from_geodetic(lat, lon, h), 0, atol=1e-8)
    east = frame.enu_from_geodetic(lat, lon + 1e-4, h)
    north = frame.enu_from_geodetic(lat + 1e-4, lon, h)
    up = frame.enu_from_geodetic(lat, lon, h + 10)
    assert east[0] == pytest.approx(9.09, abs=0.02)
    np.testing.assert_allclose(east[1:], 0, atol=1e-3)
    assert north[1] == pytest.approx(11.094, abs=0.01)
    np.testing.assert_allclose(north[[0, 2]], 0, atol=1e-3)
    np.testing.assert_allclose(up, [0, 0, 10], atol=1e-6)


def test_ned_is_enu_with_north_and_east_swapped_and_down():
    np.testing.assert_array_equal(NED_FROM_ENU @ [1.0, 2.0, 3.0], [2.0, 1.0, -3.0])
    np.testing.assert_array_equal(NED_FROM_ENU @ NED_FROM_ENU, np.eye(3))


@pytest.mark.parametrize(
    ("position", "message"),
    [
        ((91.0, 0.0, 0.0), "out of range"),
        ((0.0, 361.0, 0.0), "out of range"),
        ((-98.1, 30.2, 425.0), r"latitude -98\.1, longitude 30\.2.*the other way round"),
        ((float("nan"), 0.0, 0.0), "not a position"),
        ((0.0, 0.0, float("inf")), "not a position"),
    ],
)
def test_positions_off_the_earth(position, message):
    with pytest.raises(GeoreferenceError, match=message):
        Geodetic(*position)


# --- What lies across the 180th meridian is small, and drawn where it is ------------------------


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
    assert found.box.west > 179.99
    assert found.box.east < -179.99
    assert found.box.south < found.box.north


# --- The geoid against values that its makers and others published ------------------------------


@pytest.mark.parametrize(
    ("latitude", "longitude", "published"),
    [  # NGA's test of its EGM96 interpolation program (OUTPUT.DAT)
        (38.6281550, 269.7791550, -31.628),
        (-14.6212170, 305.0211140, -2.969),
        (46.8743190, 102.4487290, -43.575),
        (-23.6174460, 133.8747120, 15.871),
        (38.6254730, 359.9995000, 50.066),
        (-0.4667440, 0.0023000, 17.329),
        (90.0, 0.0, 13.6),
        (-90.0, 0.0, -29.5),
        (4.75, 78.75, -106.9),  # poles; south of India
    ],
)
def test_published_values(latitude, longitude, published):
    assert geoid_separation(latitude, longitude) == pytest.approx(published, abs=0.2)


def test_it_is_continuous_over_every_seam():
    for latitude in (-89.99, -45.125, 0.0, 61.875):
        for longitude in (-180.0, 0.0, 90.25, 180.0):
            near = [
                geoid_separation(latitude + a, longitude + b)
                for a in (-1e-7, 1e-7) for b in (-1e-7, 1e-7)
            ]  # fmt: skip
            assert np.ptp(near) < 1e-3
    assert geoid_separation(10, -190) == pytest.approx(geoid_separation(10, 170))
