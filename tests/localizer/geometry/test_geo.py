from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from localizer.errors import GeoreferenceError
from localizer.geometry.geo import NED_FROM_ENU, Geodetic, LocalFrame, ecef_from_geodetic

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


def test_the_tangent_plane_leaves_the_ellipsoid():
    """1 km out, the plane is d² / 2R = 7.8 cm above the ellipsoid: not a bug, but to be known."""
    heights = LocalFrame(Geodetic(47.0, 8.0, 0.0)).geodetic_from_enu([[1000.0, 0.0, 0.0]])[:, 2]
    assert heights[0] == pytest.approx(1000.0**2 / 2 / 6.388e6, abs=1e-3)


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
