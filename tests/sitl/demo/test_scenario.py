from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from localizer.geometry.pose import so3_log
from localizer.map.cache.cache import TileCache
from localizer.synth.world import WorldInfo
from sitl.camera.detector import DetectorErrors
from sitl.camera.realism import CameraRealism
from sitl.demo import assets
from sitl.demo.kinematic import camera_path
from sitl.demo.scenario import (
    CameraSpec,
    Scenario,
    ScenarioError,
    ScenarioLeg,
    check_inside,
    draw_errors,
    load_scenario,
)
from sitl.demo.script import mission
from sitl.geodesy import Location
from tests.bounds import unbounded

CONFIGS = Path(__file__).parents[3] / "configs"


def test_the_shipped_demo_file_says_what_the_defaults_are():
    assert load_scenario(CONFIGS / "demo.yaml") == Scenario()


def test_the_short_flight_ends_at_home_and_is_short():
    short = load_scenario(CONFIGS / "demo_short.yaml")
    assert (short.legs[-1].east_m, short.legs[-1].north_m) == (0, 0)
    check_inside(short, 400.0)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("speed_m_s: fast", "speed_m_s"),
        ("altitude: 3", "altitude"),
        ("legs: []", "legs"),
        ("a: [", "not valid YAML"),
        ("condition: disco", "condition"),
        ("camera: {width: 3, height: 2}", "camera.width"),
    ],
)
def test_bad_scenarios_are_named(tmp_path, text, named):
    path = tmp_path / "scenario.yaml"
    path.write_text(text)
    with pytest.raises(ScenarioError, match=named):
        load_scenario(path)


def test_the_default_mission_is_long_and_comes_home():
    scenario = Scenario()
    corners = np.array([(0.0, 0.0)] + [(leg.east_m, leg.north_m) for leg in scenario.legs])
    assert np.linalg.norm(np.diff(corners, axis=0), axis=1).sum() >= 1000
    assert tuple(corners[-1]) == (0.0, 0.0)
    assert len({leg.height_m for leg in scenario.legs}) > 2
    assert len({leg.gimbal_pitch_deg for leg in scenario.legs}) > 2
    home = Location(47.0, 8.0, 400.0)
    steps = mission(scenario, home)
    assert len(steps) == 1 + 2 * len(scenario.legs)
    north, east, _ = home.ned_of(Location(steps[2].latitude_deg, steps[2].longitude_deg, 400.0))
    assert (east, north) == pytest.approx((0.0, 220.0), abs=0.01)


def test_the_kinematic_path_is_smooth_and_visits_every_corner():
    scenario = Scenario()
    path = list(camera_path(scenario, ground_m=5.0))
    positions = np.array([pose.translation for _, pose in path])
    assert np.linalg.norm(np.diff(positions, axis=0), axis=1).max() < scenario.speed_m_s * 0.021
    for leg in scenario.legs:
        corner = np.array([leg.east_m, leg.north_m, 5.0 + leg.height_m])
        assert np.linalg.norm(positions - corner, axis=1).min() < 0.1
    turns = [
        np.linalg.norm(so3_log(a.rotation.T @ b.rotation))
        for (_, a), (_, b) in zip(path[::5], path[5::5], strict=False)
    ]
    assert np.degrees(max(turns)) < 8.0


@pytest.mark.parametrize("east", [801.0, -9e3])
def test_a_leg_outside_the_world_is_named(east):
    check_inside(Scenario(), 1600.0)
    home = ScenarioLeg(east_m=0, north_m=0)
    with pytest.raises(ScenarioError, match=r"legs\.1: .* reaches 800 m"):
        check_inside(Scenario(legs=(home, ScenarioLeg(east_m=east, north_m=0))), 1600.0)


def test_every_number_has_its_bounds():
    assert unbounded(Scenario) == {"camera.distortion"}  # judged as a lens


@pytest.mark.parametrize("distortion", [(9.0, 0, 0, 0, 0), (0, 0, -1e300, 0, 0)])
def test_a_distortion_that_is_no_lens_is_named(distortion):
    with pytest.raises(ValueError, match=r"the distortion (cannot be undone|bends)|optical axis"):
        CameraSpec(distortion=distortion)


# --- What a flight draws: within its scenario, reproducible, and nothing in the ideal world -----


def test_the_ideal_flight_has_no_errors_at_all():
    ideal = Scenario().ideal()
    drawn = draw_errors(ideal, seed=3)
    assert drawn.camera == ideal.camera.camera()
    assert ideal.camera.camera().readout_ms == 0
    assert drawn.lever_arm_m == (0.0, 0.0, 0.0)
    assert drawn.map_shift_m == (0.0, 0.0, 0.0)
    assert drawn.realism == CameraRealism()
    assert drawn.detector == DetectorErrors()


def test_every_error_is_drawn_and_spreads_as_the_scenario_says():
    scenario, nominal = Scenario(), Scenario().camera.camera()
    drawn = [draw_errors(scenario, seed) for seed in range(200)]
    assert drawn[7] == draw_errors(scenario, 7)
    spreads = {
        "focal": ([100 * (d.camera.fx / nominal.fx - 1) for d in drawn], 0.1),
        "principal": ([d.camera.cx - nominal.cx for d in drawn], 0.7),
        "k1": ([d.camera.distortion[0] - nominal.distortion[0] for d in drawn], 0.003),
        "lever": ([d.lever_arm_m[1] for d in drawn], 0.05),
        "stamp": ([d.realism.stamp_offset_ms for d in drawn], 3.0),
        "readout": ([d.realism.readout_ms - nominal.readout_ms for d in drawn], 1.0),
        "up": ([d.map_shift_m[2] for d in drawn], 0.3),
    }
    for name, (values, sigma) in spreads.items():
        assert np.std(values) == pytest.approx(sigma, rel=0.2), name
        assert abs(np.mean(values)) < 0.25 * sigma, name
    away = np.array([np.hypot(*d.map_shift_m[:2]) for d in drawn])
    assert 0.3 <= away.min() < 0.4
    assert 1.4 < away.max() <= 1.5
    assert len({np.sign(d.map_shift_m[0]) for d in drawn}) == 2


# --- Progress in a log: a line per phase, and one every ten seconds of a long one ---------------


def test_a_world_that_is_being_made_tells_how_far_it_is(tmp_path, monkeypatch) -> None:
    def build_visits(config, visits, progress) -> None:
        progress(0.5)
        progress(1.0)

    def build_cache(source, out, progress) -> None:
        progress(1, 2)
        progress(2, 2)

    monkeypatch.setattr(assets, "build_visits", build_visits)
    monkeypatch.setattr(assets, "build_cache", build_cache)
    monkeypatch.setattr(TileCache, "open", lambda _: None)
    monkeypatch.setattr(WorldInfo, "load", lambda _: None)
    told: list[tuple[str, float]] = []
    for _ in range(2):  # the second time it is there
        assets.prepare(3, tmp_path, lambda *what: told.append(what), ideal=True)
    phases = ["generating world 3 (a few minutes, once)"] * 3
    phases += ["importing the survey tileset"] * 2 + ["importing the live tileset"] * 2
    assert [phase for phase, _ in told] == phases
    shares = [share for _, share in told]
    assert shares == sorted(shares)
    assert [shares[0], shares[-1]] == pytest.approx([0.0, 1.0])
