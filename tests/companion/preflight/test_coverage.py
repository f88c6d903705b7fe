"""Mission coverage, held to a map of 400 m by 400 m, and the doctor against a vehicle."""

import cv2
import numpy as np
import pytest

from companion.config import parse_config
from companion.preflight.coverage import check_mission
from companion.preflight.doctor import examine_deployment
from localizer.map.cache.cache import TileCache
from mavlink_bridge.vehicle.mission import MissionWaypoint
from sitl.geodesy import Location
from sitl.ground.mission_client import takeoff_step, waypoint_step
from sitl.ground.pilot import Pilot
from sitl.vehicles.launch import GIMBAL, EmbeddedSitl, vision_only_parameters


@pytest.fixture(scope="module")
def cache(small_assets):
    return TileCache.open(small_assets.map_cache)


def _at(cache, east, north, number=1):
    """A waypoint at metres from the middle of the map."""
    middle = (cache.index.box_min[0] + cache.index.box_max[0]) / 2.0
    latitude, longitude, _ = cache.frame.geodetic_from_enu(middle + np.array([east, north, 0.0]))
    return MissionWaypoint(number, float(latitude), float(longitude))


@pytest.mark.parametrize(
    ("places", "ok", "found"),
    [
        ([], True, "none in the vehicle"),
        ([(0, 0)], True, "none in the vehicle"),  # home alone
        ([(0, 0), (150, 0), (150, 150), (-100, -150)], True, "4 places, 0.7 km"),
        ([(0, 0), (0, 150), (600, 150), (0, 150)], False, "items 2 outside"),
        ([(9000, 100 * i) for i in range(15)], False, "items 0, 1, 2, 3, 4, 5, 6, 7 and 7 more"),
    ],
)
def test_places_outside_are_named_with_the_share_of_the_way(cache, places, ok, found):
    finding = check_mission(cache, [_at(cache, *p, i) for i, p in enumerate(places)])
    assert (finding.ok, finding.required) == (ok, False)
    assert found in finding.found
    if "items 2" in found:  # of 1350 m, 2 x 400 m are beyond the edge at 200 m
        share = float(finding.why.split(" % of the way")[0].split()[-1])
        assert share == pytest.approx(100 * 800 / 1350, abs=4)


def test_a_leg_over_a_hole_is_found_although_its_ends_are_inside(cache):
    low, high = cache.index.box_min.copy(), cache.index.box_max.copy()
    leaves = (cache.index.child_count == 0) & (cache.index.tile_count > 0)
    middle = (low[0] + high[0])[:2] / 2.0
    holed = leaves & (low[:, :2] <= middle).all(axis=1) & (high[:, :2] >= middle).all(axis=1)
    counts = cache.index.tile_count.copy()
    try:
        object.__setattr__(cache.index, "tile_count", np.where(holed, 0, counts))
        edge = float((high[0] - low[0])[0]) / 2.0 - 10.0
        finding = check_mission(cache, [_at(cache, -edge, 3.0, 0), _at(cache, edge, 3.0, 1)])
    finally:
        object.__setattr__(cache.index, "tile_count", counts)
    assert holed.any()
    assert not finding.ok
    assert "no item outside" in finding.found


def test_doctor_against_the_embedded_vehicle(cache, small_assets, tmp_path, monkeypatch):
    # What a busy machine does to the line between two processes is not the subject here.
    for name, loose in (
        ("_ROUND_TRIP_LIMIT_MS", 1e4), ("_RATE_SHARE", 0.02), ("_LOST_SHARE", 0.9),
        ("_MEASURE_S", 1.0),
    ):  # fmt: skip
        monkeypatch.setattr(f"mavlink_bridge.preflight.doctor.{name}", loose)
    for i in range(12):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.full((120, 160, 3), 10 * i, np.uint8))
    home = _at(cache, 0, 0)
    start = Location(home.latitude_deg, home.longitude_deg, 50.0)
    with EmbeddedSitl(start, parameters={**vision_only_parameters(), **GIMBAL}) as vehicle:
        pilot = Pilot(vehicle.gcs_endpoint, alive=vehicle.check)
        pilot.link.connect()
        outside = start.offset(900.0, 0.0, 0.0)
        steps = [
            takeoff_step(40.0),
            waypoint_step(outside.latitude_deg, outside.longitude_deg, 40.0),
        ]
        pilot.missions.upload(steps)
        pilot.link.close()
        model = {"width": 160, "height": 120, "fx": 140, "fy": 140, "cx": 80, "cy": 60}
        settings = {"rate_hz": 20.0}
        origin = {"latitude_deg": 12.0, "longitude_deg": 8.0, "altitude_amsl_m": 9000.0}
        config = parse_config(
            {
                "map": str(small_assets.map_cache),
                "camera": {"source": str(tmp_path), "model": model, "settings": settings},
                "bridge": {"connection": vehicle.companion_endpoint, "origin": origin},
            },
            "test",
        )
        diagnosis = examine_deployment(config)
    findings = {f.name: f for f in diagnosis.findings}
    assert "items 2 outside" in findings["mission"].found
    assert not findings["mission"].required
    assert not findings["bridge.origin"].ok
    assert findings["clock"].ok
    assert findings["ATTITUDE"].ok
    assert findings["gimbal"].ok
    wrong = {f.name for f in diagnosis.findings if f.required and not f.ok}
    assert wrong == {"bridge.origin"}
    assert diagnosis.exit_code == 2
