"""A mission from a ground station's file to legs, verdicts, pictures and an exit code."""

import json
import math
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from companion.cli.commands import app
from companion.errors import MissionFileError
from companion.geometry import Mount
from companion.planning.mission import HeightAbove, read_mission
from companion.planning.plan import alternatives_at
from companion.planning.verdicts import (
    LegVerdict,
    MissionLimits,
    Reason,
    SampleVerdict,
    flown_legs,
    flown_words,
    sample_verdict,
    stretches,
)
from companion.planning.way import Aim, MapHeights, camera_pose, legs_of
from companion.preflight.map_pin import map_hash
from localizer.forecast.forecast import AmbiguousPosition, Figures, ViewForecast
from localizer.map.cache.cache import TileCache
from localizer.odometry.config import OdometryConfig
from tests.localizer.map.conftest import height

DEPLOYMENT = """
map: {map}
camera:
  source: udp://0.0.0.0:5600
  model: {{width: 640, height: 480, fx: 500.0, fy: 500.0, cx: 320.0, cy: 240.0}}
"""
GIMBAL = Aim(Mount.from_degrees(), -75.0, False)


@pytest.fixture(scope="module")
def cache(terrain):
    return terrain


def place(cache, east, north):
    latitude, longitude, _ = cache.frame.geodetic_from_enu([east, north, 0.0])
    return float(latitude), float(longitude)


def item(command, *numbers, frame=3):
    return {"type": "SimpleItem", "command": command, "frame": frame, "params": list(numbers)}


def plan_file(path, cache, *items, home=(0, 0)):
    mission = {"plannedHomePosition": [*place(cache, *home), 440.0], "items": list(items)}
    path.write_text(json.dumps({"fileType": "Plan", "mission": mission}))
    return path


def waypoint(cache, east, north, up, frame=3):
    return item(16, 0, 0, 0, None, *place(cache, east, north), up, frame=frame)


def test_each_altitude_is_above_what_its_frame_says(tmp_path, cache):
    path = plan_file(
        tmp_path / "a.plan", cache,
        waypoint(cache, 60, 0, 70), waypoint(cache, 60, 60, 500, frame=0),
        waypoint(cache, 0, 60, 70, frame=10),
    )  # fmt: skip
    mission = read_mission(path)
    assert [w.above for w in mission.waypoints] == [
        HeightAbove.HOME, HeightAbove.SEA, HeightAbove.TERRAIN,
    ]  # fmt: skip
    legs = legs_of(mission, cache, MapHeights(cache), GIMBAL, 1000.0)
    ends = [leg.samples[0].position[2] for leg in legs]  # of each leg the middle
    home, sea = float(height(0, 0)) + 70, 500 + 47.5 - 430
    terrain = float(height(0, 60)) + 70
    assert ends == pytest.approx([home, (home + sea) / 2, (sea + terrain) / 2], abs=0.5)
    assert [leg.name for leg in legs] == ["home to 1", "1 to 2", "2 to 3"]
    assert [leg.samples[0].heading_deg for leg in legs] == pytest.approx([90, 0, 270], abs=0.1)


def test_samples_stand_for_equal_parts_of_the_whole_way(tmp_path, cache):
    path = plan_file(
        tmp_path / "a.plan", cache, item(22, 0, 0, 0, None, 0, 0, 40),
        waypoint(cache, 0, 0, 40), waypoint(cache, 100, 0, 40), item(20, 0, 0, 0, 0, 0, 0, 0),
    )  # fmt: skip
    legs = legs_of(read_mission(path), cache, MapHeights(cache), GIMBAL, 20.0)
    assert [leg.name for leg in legs] == ["1 to 2", "2 to home"]  # the climb is no leg
    ways = [s.way_m for leg in legs for s in leg.samples]
    assert ways == pytest.approx(np.arange(10, 200, 20), abs=0.2)


def test_a_landing_elsewhere_is_flown_to_and_no_return_is_made_up(tmp_path, cache):
    land = item(21, 0, 0, 0, 0, *place(cache, 100, 50), 0)
    path = plan_file(tmp_path / "a.plan", cache, waypoint(cache, 100, 0, 40), land)
    mission = read_mission(path)
    legs = legs_of(mission, cache, MapHeights(cache), GIMBAL, 1000.0)
    assert [leg.name for leg in legs] == ["home to 1", "1 to 2"]
    assert legs[1].samples[0].position == pytest.approx(
        [100, 25, float(height(0, 0)) + 40], abs=0.5
    )


@pytest.mark.parametrize("altitude", [0, 60])
def test_zero_zero_is_where_the_vehicle_is_and_no_place_off_africa(tmp_path, cache, altitude):
    """Autopilots take unset coordinates, and an altitude of zero, for those of now."""
    path = plan_file(
        tmp_path / "a.plan", cache, item(17, 0, 0, 0, 0, 0, 0, 40), waypoint(cache, 100, 0, 40),
        item(19, 5, 0, 0, 0, 0, 0, altitude), waypoint(cache, 100, 50, 0),
    )  # fmt: skip
    legs = legs_of(read_mission(path), cache, MapHeights(cache), GIMBAL, 1000.0)
    assert [leg.name for leg in legs] == ["circle 1", "1 to 2", "circle 3", "3 to 4"]
    assert legs[3].length_m == pytest.approx(50, abs=0.5)
    above = legs[3].samples[0].position[2] - float(height(0, 0))
    assert above == pytest.approx(altitude or 40, abs=0.5)


def test_altitudes_above_home_follow_the_earths_curve(tmp_path, cache):
    path = plan_file(tmp_path / "a.plan", cache, waypoint(cache, 0, 30_000, 100))
    leg = legs_of(read_mission(path), cache, MapHeights(cache), GIMBAL, 100.0)[0]
    ways = [leg.samples[k].position for k in (150, -1)]
    above = [cache.frame.position(p).height_m - cache.frame.origin.height_m for p in ways]
    assert above == pytest.approx([float(height(0, 0)) + 100] * 2, abs=1.0)


def test_gimbal_and_fixed_cameras_look_where_they_are_aimed(tmp_path, cache):
    path = plan_file(tmp_path / "a.plan", cache, item(205, -40, 0, 0, 0, 0, 0, 0),
                     waypoint(cache, 100, 0, 40))  # fmt: skip
    sample = legs_of(read_mission(path), cache, MapHeights(cache), GIMBAL, 500.0)[0].samples[0]
    forward = camera_pose(sample, cache, GIMBAL).rotation[:, 2]
    down = math.radians(40)
    assert forward == pytest.approx([math.cos(down), 0, -math.sin(down)], abs=1e-3)
    screwed = Aim(Mount.from_degrees(pitch_deg=-90.0), -75.0, True)
    pose = camera_pose(sample, cache, screwed)
    assert pose.rotation[:, 2] == pytest.approx([0, 0, -1], abs=1e-3)
    assert -pose.rotation[:, 1] == pytest.approx([1, 0, 0], abs=1e-3)  # image up is ahead


def test_the_camera_keeps_its_region_of_interest_in_view(tmp_path, cache):
    """Pitch and yaw follow from it at every place; a camera without a gimbal turns the vehicle."""
    region = item(195, 0, 0, 0, 0, *place(cache, 50, 150), 0)
    path = plan_file(tmp_path / "a.plan", cache, region, waypoint(cache, 100, 0, 40))
    fixed = Aim(Mount.from_degrees(pitch_deg=-30.0), -75.0, True)
    for aim in (GIMBAL, fixed):
        legs = legs_of(read_mission(path), cache, MapHeights(cache), aim, 10.0)
        for sample in legs[0].samples:
            forward = camera_pose(sample, cache, aim).rotation[:, 2]
            there = np.array([50, 150, float(height(0, 0))]) - sample.position
            assert math.atan2(*forward[:2]) == pytest.approx(math.atan2(*there[:2]), abs=0.01)
            if aim is GIMBAL:
                assert forward == pytest.approx(there / np.linalg.norm(there), abs=0.01)


def test_a_yaw_is_from_the_heading_or_from_north(tmp_path, cache):
    def turn(flags):
        turned = item(1000, -60, 30, None, None, flags, 0, 0)
        path = plan_file(tmp_path / "a.plan", cache, turned, waypoint(cache, 100, 0, 40))
        sample = legs_of(read_mission(path), cache, MapHeights(cache), GIMBAL, 500.0)[0].samples[0]
        assert sample.pitch_deg == -60
        return sample.turn_deg

    assert (turn(12), turn(16)) == pytest.approx((30, -60), abs=0.1)


def test_a_spline_is_flown_as_a_curve_through_its_places(tmp_path, cache):
    """From a straight leg east into a corner: it leaves to the east, and arrives to the north."""
    path = plan_file(
        tmp_path / "a.plan", cache, waypoint(cache, -100, 0, 40), waypoint(cache, 0, 0, 40),
        item(82, 0, 0, 0, None, *place(cache, 80, 80), 40), waypoint(cache, 80, 160, 40),
        home=(-150, 0),
    )  # fmt: skip
    legs = legs_of(read_mission(path), cache, MapHeights(cache), GIMBAL, 4.0)
    curve = next(leg for leg in legs if leg.name == "2 to 3")
    headings = [s.heading_deg for s in curve.samples]
    assert headings[0] == pytest.approx(90, abs=6)
    assert headings[-1] == pytest.approx(0, abs=6)
    assert curve.length_m > 1.03 * math.hypot(80, 80)
    # Hermite's polynomial with the legs before and after as its tangents, half way.
    middle = np.array([40 + 100 / 8, 40 - 80 / 8])
    nearest = min(np.linalg.norm(s.position[:2] - middle) for s in curve.samples)
    assert nearest < 2.5


def test_a_loiter_circle_is_judged_as_a_leg(tmp_path, cache):
    path = plan_file(
        tmp_path / "a.plan", cache, item(18, 3, 0, -40, 0, *place(cache, 60, 0), 50),
        waypoint(cache, 60, 90, 50),
    )  # fmt: skip
    legs = legs_of(read_mission(path), cache, MapHeights(cache), GIMBAL, 4.0)
    names = ["home to 1", *["circle 1"] * 3, "1 to 2"]
    assert [(leg.name, leg.first) for leg in legs] == list(zip(names, (0, 1, 1, 1, 4), strict=True))
    circle = legs[1]
    assert [leg.is_circle for leg in legs] == [False, True, True, True, False]
    assert circle.length_m == pytest.approx(2 * math.pi * 40, rel=2e-3)
    away = np.array([s.position[:2] for s in circle.samples]) - (60, 0)
    assert np.linalg.norm(away, axis=1) == pytest.approx(40, abs=0.2)
    # From the west, against the clock: south first.
    assert away[0][0] < -39
    assert away[0][1] < 0
    assert circle.samples[0].heading_deg == pytest.approx(180, abs=6)


def test_rounds_are_flown_often_and_judged_once(tmp_path, cache):
    jump = item(177, 1, 3, 0, 0, 0, 0, 0)
    places = [waypoint(cache, *p, 40) for p in ((60, 0), (60, 60))]
    path = plan_file(tmp_path / "a.plan", cache, *places, jump, item(20, *[0] * 7))
    legs = legs_of(read_mission(path), cache, MapHeights(cache), GIMBAL, 30.0)
    assert [leg.name for leg in legs[:4]] == ["home to 1", "1 to 2", "2 to 1", "1 to 2"]
    assert len(legs) == 1 + 4 + 3 + 1
    assert [leg.first for leg in legs] == [0, 1, 2, 1, 2, 1, 2, 1, 8]
    ways = [s.way_m for leg in legs for s in leg.samples]
    assert ways == pytest.approx(sorted(ways))
    assert max(ways) < sum(leg.length_m for leg in legs)


def test_missions_that_cannot_be_placed_are_named(tmp_path, cache):
    ground = MapHeights(cache)
    far = plan_file(tmp_path / "far.plan", cache, waypoint(cache, 0, 0, 50), home=(0, 9e5))
    with pytest.raises(MissionFileError, match="km from the map's origin"):
        legs_of(read_mission(far), cache, ground, GIMBAL, 25.0)
    beside = plan_file(tmp_path / "b.plan", cache, waypoint(cache, 0, 0, 50), home=(900, 0))
    with pytest.raises(MissionFileError, match=r"home at .* is not over the map .* m away\)"):
        legs_of(read_mission(beside), cache, ground, GIMBAL, 25.0)
    spot = plan_file(tmp_path / "s.plan", cache, waypoint(cache, 0, 0, 50))
    with pytest.raises(MissionFileError, match="goes nowhere"):
        legs_of(read_mission(spot), cache, ground, GIMBAL, 25.0)
    nowhere = json.loads(spot.read_text())
    nowhere["mission"]["plannedHomePosition"] = [0, 0, 0]
    spot.write_text(json.dumps(nowhere))
    with pytest.raises(MissionFileError, match="one place and no home"):
        legs_of(read_mission(spot), cache, ground, GIMBAL, 25.0)
    local = plan_file(tmp_path / "l.plan", cache, waypoint(cache, 0, 0, 50, frame=1))
    with pytest.raises(MissionFileError, match="frame 1"):
        read_mission(local)


@pytest.mark.parametrize("suffix", ["plan", "waypoints"])
def test_a_mission_that_no_autopilot_counts_is_refused(tmp_path, cache, suffix):
    """32,767 items are the most; a home row is none of them."""

    def mission_of(count):
        path = tmp_path / f"long.{suffix}"
        if suffix == "plan":
            return plan_file(path, cache, *[waypoint(cache, 0, 0, 50)] * count)
        row = "0\t0\t3\t16\t0\t0\t0\t0\t47.2\t8.2\t50\t1\n"
        path.write_text("QGC WPL 110\n" + row * (count + 1))
        return path

    if suffix == "waypoints":  # the other takes seconds to write, for the same limit
        assert len(read_mission(mission_of(32_767)).waypoints) == 32_767
    with pytest.raises(MissionFileError, match=r"long.* holds 32,768 items.*split the mission"):
        read_mission(mission_of(32_768))


def forecast(risk=0.01, sigma=0.2, share=1.0, rival=0.1, ground=80.0, condition="day"):
    figures = Figures(sigma, 0.9, 0.6, share, 0.0, 0.2)
    return ViewForecast(
        condition, figures, sigma, risk, ground, 20.0, AmbiguousPosition(rival, 12.0)
    )


@pytest.fixture
def leg(tmp_path, cache):
    path = plan_file(tmp_path / "a.plan", cache, waypoint(cache, 100, 0, 40))
    return legs_of(read_mission(path), cache, MapHeights(cache), GIMBAL, 20.0)[0]


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (forecast(), Reason.NONE),
        (forecast(risk=1.0, share=0.0, ground=0.0), Reason.NO_MAP),
        (forecast(risk=0.6, share=0.3), Reason.EDGE),
        (forecast(risk=0.6), Reason.WEAK),
        (forecast(rival=0.9), Reason.ALIKE),
        (forecast(sigma=1.4), Reason.SIGMA),
    ],
)
def test_each_verdict_has_its_reason(leg, given, reason):
    assert sample_verdict(leg.samples[0], [given], MissionLimits()).reason is reason


def test_the_worst_condition_counts(leg):
    both = [forecast(condition="day"), forecast(risk=0.5, condition="night")]
    judged = sample_verdict(leg.samples[0], both, MissionLimits())
    assert (judged.forecast.condition, judged.holds) == ("night", False)


def test_a_forecast_is_checked_by_a_flight(leg):
    """A frame every 4 m over the leg's first 60 m; vision fails on 20 m that should hold, and holds
    on 20 m that should fail.
    """
    judged = [sample_verdict(s, [forecast(risk=0.9 if k == 2 else 0.0)], MissionLimits())
              for k, s in enumerate(leg.samples)]  # fmt: skip
    places = np.array([s.position + np.array([dx, 0.3, 2.0]) for s in leg.samples[:3]
                       for dx in (-8.0, -4.0, 0.0, 4.0, 8.0)])  # fmt: skip
    accepted = np.array([True] * 5 + [True, True, True, False, False] + [True] * 5)
    (flown,) = flown_legs([LegVerdict(leg, tuple(judged))], places, accepted)
    assert flown.forecast.tolist() == [True, True, False]
    assert flown.held.tolist() == [True, False, True]
    assert flown.row == ("home to 1", "67 %", "67 %", "33 %", "3 of 5")
    words = flown_words([flown])
    assert "right at 33 %; 1 failed that should hold, 1 held that should fail" in words
    (none,) = flown_legs([LegVerdict(leg, tuple(judged))], places + 1000.0, accepted)
    assert flown_words([none]) == "The flight has no frame on this mission."
    assert none.row[1:] == ("-", "-", "-", "0 of 5")


def test_neighbours_are_bridged_together_and_no_stretch_is_invented(leg):
    def verdict(bad):
        judged = [sample_verdict(s, [forecast(risk=0.9 if k in bad else 0.0)], MissionLimits())
                  for k, s in enumerate(leg.samples)]  # fmt: skip
        return [LegVerdict(leg, tuple(judged))]

    odometry = OdometryConfig()
    assert stretches(verdict(()), 5.0, odometry) == ()
    first, second = stretches(verdict((0, 1, 3)), 5.0, odometry)
    assert (first.begin_m, first.length_m) == pytest.approx((0, 40), abs=0.1)
    assert first.seconds == pytest.approx(8, abs=0.1)
    assert second.length_m == pytest.approx(20, abs=0.1)
    said = [replace(v, leg=replace(v.leg, speed_m_s=10.0)) for v in verdict((0, 1, 3))]
    assert stretches(said, 5.0, odometry)[0].seconds == pytest.approx(4, abs=0.1)
    assert 0 < second.drift_m < first.drift_m
    strict = OdometryConfig(longest_sigma_m=0.1)
    assert not stretches(verdict((0, 1)), 5.0, strict)[0].can_bridge


def test_off_the_map_a_stretch_drifts_as_over_ground_that_nobody_knows(leg):
    def drift_m(share, terrain=False):
        off = forecast(risk=0.9, share=share, ground=0.0 if share == 0.0 else 0.3)
        judged = tuple(sample_verdict(s, [off], MissionLimits()) for s in leg.samples)
        return stretches([LegVerdict(leg, judged)], 5.0, OdometryConfig(), terrain=terrain)[
            0
        ].drift_m

    mapped, off = drift_m(1.0), drift_m(0.0)
    assert off == pytest.approx(0.1 * leg.length_m, rel=0.1)
    assert mapped < drift_m(0.0, terrain=True) < 0.2 * off
    assert drift_m(0.3) == off


def test_a_fixed_camera_is_offered_no_gimbal_angle(leg):
    worst = SampleVerdict(leg.samples[0], forecast(risk=0.9), Reason.WEAK)
    assert any("gimbal" in c.words for c in alternatives_at(worst, fixed=False))
    assert not any("gimbal" in c.words for c in alternatives_at(worst, fixed=True))
    assert any("higher" in c.words for c in alternatives_at(worst, fixed=True))


def run(*arguments):
    return CliRunner().invoke(app, ["plan", *map(str, arguments)])


def test_no_verdict_is_given_for_what_was_not_judged(tmp_path, cache):
    config = tmp_path / "deployment.yaml"
    config.write_text(DEPLOYMENT.format(map=cache.path))
    scan = {"type": "ComplexItem", "complexItemType": "StructureScan", "polygon": []}
    path = plan_file(
        tmp_path / "a.plan", cache, item(178, 1, 18, -1, 0, 0, 0, 0), waypoint(cache, 60, 0, 60),
        waypoint(cache, 60, 60, 60), item(177, 2, 1, 0, 0, 0, 0, 0), scan,
        item(18, 1, 0, 30, 0, *place(cache, 0, 60), 60),
    )  # fmt: skip
    out = tmp_path / "report"
    done = run(path, "--config", config, "--out", out, "--no-alternatives", "--spacing", 60)
    assert done.exit_code == 1, done.output
    words = " ".join(done.output.split())
    assert "Not judged: StructureScan (item 5)" in words
    assert "3 legs and 1 circle" in words
    assert "all 3 legs" not in words
    assert "Imagery: date not known; map_max_age_days is 730." in words
    assert "StructureScan (item 5)" in (out / "plan.html").read_text()
    made = json.loads((out / "plan.json").read_text())
    assert not made["holds"]
    assert made["speed_m_s"] == 18
    assert [(leg["name"], leg["times"]) for leg in made["legs"]] == [
        ("home to 1", 1), ("1 to 2", 2), ("2 to 1", 1), ("circle 3", 1),
    ]  # fmt: skip
    assert made["length_m"] == pytest.approx(60 * 4 + math.tau * 30, abs=1)


def test_a_mission_over_the_edge_is_told_with_pictures_and_exit_code_1(tmp_path, cache):
    config = tmp_path / "deployment.yaml"
    config.write_text(DEPLOYMENT.format(map=cache.path))
    out = tmp_path / "report"
    over = plan_file(tmp_path / "over.plan", cache,
                     waypoint(cache, 100, 0, 60), waypoint(cache, 420, 0, 60))  # fmt: skip
    done = run(over, "--config", config, "--out", out, "--spacing", 80)
    assert done.exit_code == 1, done.output
    made = json.loads((out / "plan.json").read_text())
    assert made["map_sha256"] == map_hash(cache.path)
    assert made["legs"][1]["samples"][-1]["reason"] == "no map in view"
    assert made["stretches"][-1]["end_m"] == pytest.approx(420, abs=1)
    page = (out / "plan.html").read_text()
    assert "no map in view" in page
    addresses = re.findall(r"""(?:src|href)=["']?([^"'\s>]{0,5})""", page)
    assert set(addresses) == {"data:"}  # nothing is fetched
    track = cv2.imread(str(out / "track.png"))
    red = (abs(track.astype(int) - (40, 40, 198)).max(axis=2) < 12).sum()
    assert red > 500
    assert cv2.imread(str(out / "heat.png")).shape == track.shape
    wrong = run(over, "--config", config, "--out", out, "--condition", "hail")
    assert wrong.exit_code == 2


def test_a_mission_over_a_town_holds_with_exit_code_0(tmp_path, small_assets):
    """The false alarm: nothing is wrong with map, light and way."""
    town = TileCache.open(small_assets.map_cache)
    config = tmp_path / "deployment.yaml"
    config.write_text(DEPLOYMENT.format(map=town.path))
    path = plan_file(
        tmp_path / "a.plan", town, waypoint(town, 40, 0, 80), waypoint(town, 0, 40, 80),
        item(20, 0, 0, 0, 0, 0, 0, 0),
    )  # fmt: skip
    out = tmp_path / "report"
    done = run(path, "--config", config, "--out", out, "--no-alternatives", "--spacing", 40)
    assert done.exit_code == 0, done.output
    made = json.loads((out / "plan.json").read_text())
    assert made["holds"]
    assert made["stretches"] == []
