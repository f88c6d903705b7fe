"""The doctor's view of the map's heights: right ones pass, each wrong one is seen."""

from __future__ import annotations

from dataclasses import replace

import pytest

from companion.preflight.heights import check_heights
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.map.building.build import build_cache
from localizer.map.building.options import BuildOptions
from localizer.map.cache.cache import TileCache
from mavlink_bridge.messages import VehicleState
from tests.localizer.map.conftest import ORIGIN, SEPARATION_M, height, write_tileset


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    folder = tmp_path_factory.mktemp("map")
    build_cache(write_tileset(folder / "source"), folder / "cache", BuildOptions(workers=1))
    return TileCache.open(folder / "cache")


def standing(east=30.0, north=-40.0, geoid_m=SEPARATION_M, above_m=0.0):
    """A vehicle on the ground of the test terrain."""
    ground = float(height(east, north))
    lat, lon, h = LocalFrame(ORIGIN).geodetic_from_enu([east, north, ground + above_m])
    place = Geodetic(float(lat), float(lon), float(h))
    return VehicleState(
        gps_fix_type=3,
        gps_latitude_deg=place.latitude_deg,
        gps_longitude_deg=place.longitude_deg,
        gps_altitude_amsl_m=place.height_m - geoid_m,
        gps_height_m=place.height_m,
    )


def test_agreement_is_good(cache):
    geoid, ground = check_heights(cache, standing(geoid_m=SEPARATION_M + 1.5, above_m=2.0))
    assert geoid.ok
    assert ground.ok
    assert geoid.found == "47.5 m in the map, 49.0 m by GNSS"


@pytest.mark.parametrize(("error_m", "required"), [(5.0, False), (-42.5, True)])
def test_another_geoid_is_told(cache, error_m, required):
    geoid, _ = check_heights(cache, standing(geoid_m=SEPARATION_M + error_m))
    assert (geoid.ok, geoid.required) == (False, required)


@pytest.mark.parametrize("above_m", [47.5, -47.5])
def test_a_map_in_the_wrong_datum_is_told(cache, above_m):
    findings = {f.name: f for f in check_heights(cache, standing(above_m=above_m))}
    assert not findings["take-off height"].ok
    assert findings["geoid"].ok


def test_what_is_not_known_is_not_judged(cache):
    assert check_heights(cache, VehicleState()) == []
    state = standing()
    assert [f.name for f in check_heights(cache, replace(state, armed=True))] == ["geoid"]
    beside = check_heights(cache, standing(east=5000.0))
    assert [f.name for f in beside] == ["geoid"]
    silent = replace(state, gps_height_m=None)
    assert [f.name for f in check_heights(cache, silent)] == ["take-off height"]
