"""A mission that a ground station saved, over the user's own map."""

import json
from pathlib import Path

import numpy as np
import pytest

from localizer.map.cache.cache import TileCache
from sitl.demo.assets import FlightAssets
from sitl.demo.flight import home_of, observed_targets
from sitl.demo.scenario import Scenario, ScenarioError
from sitl.rehearsal.rehearse import read_mission, rehearse


def _item(command: int, *numbers: float | None, frame: int = 3) -> dict:
    return {"type": "SimpleItem", "command": command, "frame": frame, "params": list(numbers)}


def _plan(path: Path, home: tuple[float, float], *items: dict) -> Path:
    mission = {"plannedHomePosition": [*home, 440.0], "items": list(items)}
    path.write_text(json.dumps({"fileType": "Plan", "mission": mission}))
    return path


def _survey(*items: dict) -> dict:
    return {"type": "ComplexItem", "TransectStyleComplexItem": {"Items": list(items)}}


@pytest.fixture
def home(small_assets: FlightAssets) -> tuple[float, float]:
    place = small_assets.world.origin
    return place.latitude_deg, place.longitude_deg


def test_a_plan_of_qgroundcontrol_is_flown_as_it_was_drawn(tmp_path, small_assets, home):
    lat, lon = home
    north = lat + 60 / 111_200
    plan = _plan(
        tmp_path / "a.plan", home,
        _item(22, 0, 0, 0, None, lat, lon, 70), _item(178, 1, 7, -1, 0, 0, 0, 0),
        _item(1000, -65, 0, 0, 0, 0, 0, 0), _item(16, 0, 0, 0, None, north, lon, 80),
        _survey(_item(16, 0, 0, 0, None, north, lon + 0.0005, 90),
                _item(206, 20, 0, 1, 0, 0, 0, 0)),
        _item(20, 0, 0, 0, 0, 0, 0, 0),
    )  # fmt: skip
    done = rehearse(
        small_assets.map_cache, small_assets.live_cache, plan, Scenario(condition="fog")
    )
    flown = done.scenario
    assert flown.condition == "fog"
    assert (flown.takeoff_height_m, flown.speed_m_s) == (70, 7)
    assert [leg.height_m for leg in flown.legs] == [80, 90, 90]
    assert [leg.gimbal_pitch_deg for leg in flown.legs] == [-65, -65, -65]
    assert (flown.legs[0].east_m, flown.legs[0].north_m) == pytest.approx((0, 60), abs=0.3)
    assert (flown.legs[2].east_m, flown.legs[2].north_m) == (0, 0)  # the return
    assert done.notes == ("of the mission is not rehearsed: MAV_CMD_DO_SET_CAM_TRIGG_DIST",)
    place = home_of(done.assets)
    true = home_of(small_assets)
    assert (place.latitude_deg, place.longitude_deg) == pytest.approx(home, abs=1e-8)
    assert place.altitude_m == pytest.approx(true.altitude_m, abs=0.3)  # on the surface


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("{", "its JSON breaks off at line 1"),
        (
            "QGC WPL 110\n0 1 0 16 0 0 0 0 47 8 4 1\n1 0 0 16 0 0 0 0 47 8 500 1",
            "relative altitudes",
        ),
    ],
)
def test_a_file_that_is_no_mission_is_named(tmp_path, text, named):
    path = tmp_path / "a.mission"
    path.write_text(text)
    with pytest.raises(ScenarioError, match=named):
        read_mission(path)


def test_what_lies_beside_the_map_is_refused_before_the_flight(tmp_path, small_assets, home):
    lat, lon = home
    far = _plan(tmp_path / "far.plan", home, _item(16, 0, 0, 0, 0, lat + 0.1, lon, 80))
    with pytest.raises(ScenarioError, match="waypoints 1 are not over the map"):
        rehearse(small_assets.map_cache, None, far, Scenario())
    off = _plan(tmp_path / "off.plan", (lat + 0.1, lon), _item(16, 0, 0, 0, 0, lat, lon, 80))
    with pytest.raises(ScenarioError, match=r"home .* is not on the map"):
        rehearse(small_assets.map_cache, None, off, Scenario())


def test_without_a_mission_a_triangle_is_flown_and_without_a_live_map_it_is_said(small_assets):
    done = rehearse(small_assets.map_cache, None, None, Scenario())
    assert done.assets.live_cache == small_assets.map_cache
    assert "that flatters" in done.notes[0]
    assert (done.scenario.legs[-1].east_m, done.scenario.legs[-1].north_m) == (0, 0)
    assert len(observed_targets(done.assets, done.scenario, ())) >= 1


@pytest.mark.real
def test_a_real_mesh_is_rehearsed_over(quito_map):
    """Its home is on the surface, its points are seen, its cache is what the camera gets."""
    done = rehearse(quito_map, None, None, Scenario())
    opened = TileCache.open(quito_map)
    low, high = opened.index.box_min[0], opened.index.box_max[0]
    home = opened.frame.ecef_from_enu.inverse @ done.assets.world.frame.ecef_from_enu
    assert np.all(low < home.translation)
    assert np.all(home.translation < high)
    points = observed_targets(done.assets, done.scenario, ())
    assert len(points) == 3
    for point in points:
        assert np.all(low - 0.1 <= point.position_at(0))
        assert np.all(point.position_at(0) <= high + 0.1)


def test_what_no_flight_can_be_is_a_named_error(tmp_path, small_assets, home):
    lat, lon = home
    absurd = {"high": 1e9, "under": -500.0}
    for name, height in absurd.items():
        plan = _plan(tmp_path / f"{name}.plan", home, _item(16, 0, 0, 0, None, lat, lon, height))
        with pytest.raises(ScenarioError, match="cannot be flown"):
            rehearse(small_assets.map_cache, None, plan, Scenario())
