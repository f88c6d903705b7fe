"""Records that cannot be written and keys that cannot be read are told before the start."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from companion.config import parse_config
from companion.preflight.coverage import check_heights
from companion.preflight.doctor import check_places
from localizer.geometry.geo import Geodetic, LocalFrame
from mavlink_bridge.link.signing import create_key
from mavlink_bridge.messages import VehicleState
from tests.localizer.map.conftest import ORIGIN, SEPARATION_M, height

MODEL = {"width": 160, "height": 120, "fx": 140, "fy": 140, "cx": 80, "cy": 60}


def faults(**settings: Any) -> list[str]:
    camera = {"source": "udp://127.0.0.1:5600", "model": MODEL}
    config = parse_config({"map": "cache", "camera": camera} | settings, "test")
    found = check_places(config)
    assert all(f.required and not f.ok for f in found)
    return [f.why for f in found]


@pytest.mark.parametrize(
    ("key", "value", "why"),
    [
        ("record.folder", "file/x", r"^record\.folder .*is not a folder$"),
        ("record.folder", "file/x/y/z", r"^record\.folder .*is not a folder$"),
        ("record.folder", "x" * 300, r"record\.folder"),  # a name that no disk takes
        ("bridge.tlog", "x" * 300, r"bridge\.tlog"),
        ("bridge.tlog", "", r"^bridge\.tlog .*: a folder, not a file$"),
        ("bridge.signing.key_file", "none.key", r"bridge\.signing.*none\.key"),
        ("console.token_file", "/dev/zero", r"^console\.token_file /dev/zero: is no file$"),
    ],
)
def test_what_cannot_be_written_or_read_is_told(tmp_path, key, value, why):
    (tmp_path / "file").write_text("")
    settings: Any = str(tmp_path / value)
    for name in reversed(key.split(".")):
        settings = {name: settings}
    (found,) = faults(**settings)
    assert re.search(why, found)


def test_what_a_start_makes_itself_is_no_fault(tmp_path: Path) -> None:
    create_key(tmp_path / "mavlink.key")
    assert not faults(
        console={"token_file": str(tmp_path / "mavlink.key")},
        record={"folder": str(tmp_path / "flights/flight")},
        state_dir=str(tmp_path / "state"),
        bridge={
            "tlog": str(tmp_path / "flights/latest.tlog"),
            "signing": {"key_file": str(tmp_path / "mavlink.key")},
        },
    )
    assert {path.name for path in tmp_path.iterdir()} == {"mavlink.key"}


# --- The doctor's view of the map's heights: right ones pass, each wrong one is seen ------------


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


WITHIN, ADVICE, WRONG = (True, False), (False, False), (False, True)  # (ok, required)


@pytest.mark.parametrize(
    ("state", "geoid", "ground"),
    [
        (standing(geoid_m=SEPARATION_M + 1.5, above_m=2.0), WITHIN, WITHIN),
        (standing(geoid_m=SEPARATION_M + 5.0), ADVICE, WITHIN),
        (standing(geoid_m=SEPARATION_M - 42.5), WRONG, ADVICE),
        # A map in the wrong datum.
        (standing(above_m=47.5), WITHIN, ADVICE),
        (standing(above_m=-47.5), WITHIN, ADVICE),
        # What is not known is not judged.
        (VehicleState(), None, None),
        (replace(standing(), armed=True), WITHIN, None),
        (standing(east=5000.0), WITHIN, None),  # beside the map
        (replace(standing(), gps_height_m=None), None, WITHIN),
    ],
)
def test_heights_that_disagree_are_told(terrain, state, geoid, ground):
    found = {f.name: (f.ok, f.required) for f in check_heights(terrain, state)}
    expected = {"geoid": geoid, "take-off height": ground}
    assert found == {name: told for name, told in expected.items() if told is not None}


def test_both_geoids_are_told(terrain):
    geoid, _ = check_heights(terrain, standing(geoid_m=SEPARATION_M + 1.5))
    assert geoid.found == "47.5 m in the map, 49.0 m by GNSS"
