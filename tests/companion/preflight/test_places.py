"""Records that cannot be written and keys that cannot be read are told before the start."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from companion.config import parse_config
from companion.preflight.heights import check_heights
from companion.preflight.places import check_places
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.map.building.build import build_cache
from localizer.map.building.options import BuildOptions
from localizer.map.cache.cache import TileCache
from mavlink_bridge.link.signing import create_key
from mavlink_bridge.messages import VehicleState
from tests.localizer.map.conftest import ORIGIN, SEPARATION_M, height, write_tileset

MODEL = {"width": 160, "height": 120, "fx": 140, "fy": 140, "cx": 80, "cy": 60}


def faults(**settings: Any) -> list[str]:
    camera = {"source": "udp://127.0.0.1:5600", "model": MODEL}
    config = parse_config({"map": "cache", "camera": camera} | settings, "test")
    found = check_places(config)
    assert all(f.required and not f.ok for f in found)
    return [f.why for f in found]


@pytest.mark.parametrize("below", ["x", "x/y/z"])
def test_a_record_below_a_file_is_told(tmp_path: Path, below: str) -> None:
    (tmp_path / "file").write_text("")
    (why,) = faults(record={"folder": str(tmp_path / "file" / below)})
    assert why.startswith("record.folder")
    assert why.endswith("is not a folder")


def test_a_name_that_no_disk_takes_is_told(tmp_path: Path) -> None:
    name = str(tmp_path / ("x" * 300))
    (record,) = faults(record={"folder": name})
    (tlog,) = faults(bridge={"tlog": name})
    assert "record.folder" in record
    assert "bridge.tlog" in tlog


def test_a_folder_in_place_of_a_file_is_told(tmp_path: Path) -> None:
    (why,) = faults(bridge={"tlog": str(tmp_path)})
    assert why == f"bridge.tlog {tmp_path}: a folder, not a file"


def test_a_signing_key_that_is_not_there_is_told(tmp_path: Path) -> None:
    (why,) = faults(bridge={"signing": {"key_file": str(tmp_path / "none.key")}})
    assert "bridge.signing" in why
    assert "none.key" in why


def test_what_a_start_makes_itself_is_no_fault(tmp_path: Path) -> None:
    create_key(tmp_path / "mavlink.key")
    assert not faults(
        record={"folder": str(tmp_path / "flights/flight")},
        state_dir=str(tmp_path / "state"),
        bridge={
            "tlog": str(tmp_path / "flights/latest.tlog"),
            "signing": {"key_file": str(tmp_path / "mavlink.key")},
        },
    )
    assert {path.name for path in tmp_path.iterdir()} == {"mavlink.key"}


def test_what_the_page_reads_and_is_no_file_is_told(tmp_path: Path) -> None:
    (tmp_path / "token").write_text("x")
    assert not faults(console={"token_file": str(tmp_path / "token")})
    (why,) = faults(console={"token_file": "/dev/zero"})
    assert why == "console.token_file /dev/zero: is no file"


# --- The doctor's view of the map's heights: right ones pass, each wrong one is seen ------------


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
