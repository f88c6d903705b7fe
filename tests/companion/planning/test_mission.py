"""The files of ground stations: what stands in them, and what they leave to the upload."""

import json

import pytest

from companion.errors import MissionFileError
from companion.planning.mission import HeightAbove, read_mission
from mavlink_bridge.mission.items import LoiterCircle

HOME = (47.2, 8.2, 20)
PATTERN = {
    "type": "ComplexItem", "version": 2, "altitudesAreRelative": True, "loiterRadius": 75,
    "landCoordinate": [47.1991, 8.2009, 0], "landingApproachCoordinate": [47.2009, 8.2009, 40],
}  # fmt: skip
ENDLESS = (
    '{"mission": {"plannedHomePosition": [47, 8, 0], "items": '
    '[{"type": "SimpleItem", "command": 1e999, "frame": 3, "params": [0,0,0,0,0,0,0]}]}}'
)


def item(command, *numbers, frame=3, **more):
    return {
        "type": "SimpleItem",
        "command": command,
        "frame": frame,
        "params": list(numbers),
    } | more


def waypoint(latitude, up, **more):
    return item(16, 0, 0, 0, None, latitude, 8.2, up, **more)


def scan(kind, **more):
    return {"type": "ComplexItem", "complexItemType": kind} | more


def plan(folder, *items, home=HOME, name="mission.plan", **more):
    mission = {"plannedHomePosition": list(home), "items": list(items)} | more
    path = folder / name
    path.write_text(json.dumps({"fileType": "Plan", "mission": mission}))
    return read_mission(path)


def rows(folder, *lines, name="mission.waypoints"):
    path = folder / name
    path.write_text("\n".join(["QGC WPL 110", *("\t".join(map(str, line)) for line in lines)]))
    return read_mission(path)


@pytest.mark.parametrize("suffix", ["plan", "PLAN", "json", "txt"])
def test_what_it_is_is_told_by_what_stands_in_it(tmp_path, suffix):
    assert len(plan(tmp_path, waypoint(47.201, 50), name=f"a.{suffix}").waypoints) == 1
    line = (1, 0, 3, 16, 0, 0, 0, 0, 47.201, 8.2, 50, 1)
    home = (0, 1, 0, 16, 0, 0, 0, 0, 47.2, 8.2, 440, 1)
    assert len(rows(tmp_path, home, line, name=f"b.{suffix}").waypoints) == 1


@pytest.mark.parametrize(("kind", "height"), [("fwLandingPattern", 0), ("vtolLandingPattern", 40)])
def test_a_landing_pattern_is_flown_over_its_approach_to_its_landing(tmp_path, kind, height):
    """An aeroplane glides from the approach, a VTOL flies level and descends."""
    pattern = PATTERN | {"complexItemType": kind}
    mission = plan(tmp_path, waypoint(47.201, 80), pattern, waypoint(47.3, 80), vehicleType=1)
    assert [(p.latitude_deg, p.height_m) for p in mission.path[2:]] == [
        (47.2009, 40), (47.1991, height),
    ]  # fmt: skip
    assert not mission.not_judged


def test_a_landing_pattern_of_an_older_file(tmp_path):
    old = PATTERN | {"complexItemType": "fwLandingPattern", "loiterAltitudeRelative": False,
                     "loiterClockwise": False}  # fmt: skip
    del old["landingApproachCoordinate"]
    old["loiterCoordinate"] = [47.2009, 8.2009, 480]
    mission = plan(tmp_path, waypoint(47.201, 80), old, vehicleType=1)
    approach, landing = mission.path[-2:]
    assert approach.circle == LoiterCircle(-75)
    assert (approach.height_m, approach.above) == (480, HeightAbove.SEA)
    assert (landing.height_m, landing.above) == (0, HeightAbove.HOME)
    slow = PATTERN | {"complexItemType": "fwLandingPattern", "useLoiterToAlt": False,
                      "useDoChangeSpeed": True, "finalApproachSpeed": 12}  # fmt: skip
    mission = plan(tmp_path, waypoint(47.201, 80), slow, cruiseSpeed=15, vehicleType=1)
    assert [p.speed_m_s for p in mission.path[1:]] == [15, 12, 12]
    assert not mission.notes


@pytest.mark.parametrize("kind", ["survey", "CorridorScan"])
def test_a_survey_is_read_from_the_items_that_were_saved_with_it(tmp_path, kind):
    lines = [waypoint(47.201, 60), item(206, 20, 0, 1, 0, 0, 0, 0), waypoint(47.202, 60)]
    mission = plan(tmp_path, scan(kind, TransectStyleComplexItem={"Items": lines}))
    assert [p.latitude_deg for p in mission.waypoints] == [47.201, 47.202]


def test_a_file_that_breaks_off_is_named(tmp_path):
    """Cut within its altitude, a row of 11 fields was read as a lower waypoint."""
    plan(tmp_path, waypoint(47.201, 60), waypoint(47.202, 60))
    rows(tmp_path, (0, 1, 0, 16, 0, 0, 0, 0, *HOME, 1), (1, 0, 3, 16, 0, 0, 0, 0, 47.2, 8.2, 60, 1))
    for name, why in (
        ("mission.plan", "breaks off at line 1"),
        ("mission.waypoints", "row 1 has 11"),
    ):
        path = tmp_path / name
        path.write_text(path.read_text()[:-3])
        with pytest.raises(MissionFileError, match=f"{name}.*{why}"):
            read_mission(path)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "it is empty"),
        ("[]", r"no \.plan"),
        (ENDLESS, r"no \.plan"),
        ('{"mission": {"items": []}}', "plannedHomePosition"),
        ('{"mission": {"plannedHomePosition": [NaN, 8, 0], "items": []}}', "home is no place"),
        ("hello", "no QGC WPL"),
        ("QGC WPL 110\n0 1 0 16 x", "5 of 12 fields"),
        ("QGC WPL 110\n0 1 0 16 0 0 0 0 47 8 440 1", "holds no waypoint"),
        ("QGC WPL 110\n0 1 0 16 0 0 0 0 47 8 4 1\n1 0 3 16 0 0 0 0 nan 8 50 1", "no place"),
    ],
)
def test_a_file_that_is_no_mission_is_named(tmp_path, text, named):
    path = tmp_path / "a.plan"
    path.write_text(text)
    with pytest.raises(MissionFileError, match=f"a.plan: .*{named}"):
        read_mission(path)


@pytest.mark.parametrize(
    "entry",
    [
        scan("StructureScan", polygon=[[47.2, 8.2]], Altitude=50),
        scan("CorridorScan", TransectStyleComplexItem={"CameraCalc": {}}),
        scan("somethingNew"),
    ],
)
def test_what_the_file_leaves_to_the_upload_is_named(tmp_path, entry):
    mission = plan(tmp_path, waypoint(47.201, 60), entry, waypoint(47.202, 60))
    assert [p.after_gap for p in mission.path] == [False, False, True]
    assert f"{entry['complexItemType']} (item 2)" in mission.not_judged[0].text
    with pytest.raises(MissionFileError, match=f"cannot be .*: {entry['complexItemType']}"):
        plan(tmp_path, entry)


@pytest.mark.parametrize("unset", [(0, 0, 0), (0, 0, 440), (None, None, None)])
def test_a_home_that_was_never_set_is_none(tmp_path, unset):
    takeoff = item(22, 0, 0, 0, None, 47.2, 8.2, 80)
    mission = plan(tmp_path, takeoff, waypoint(47.201, 80), home=unset)
    assert mission.home is None
    assert [p.name for p in mission.path] == ["take-off", "1"]


@pytest.mark.parametrize(
    ("kind", "speed"), [({"vehicleType": 1}, 15), ({"vehicleType": 2}, 5), ({}, 15)]
)
def test_the_files_speed_is_that_of_its_vehicle(tmp_path, kind, speed):
    mission = plan(tmp_path, waypoint(47.201, 60), cruiseSpeed=15, hoverSpeed=5, **kind)
    assert mission.speed_m_s == speed


def test_jumps_go_by_the_ids_of_a_plan_or_by_places_where_these_say_nothing(tmp_path):
    jump = item(177, 7, 1, 0, 0, 0, 0, 0, doJumpId=9)
    own = plan(tmp_path, waypoint(47.201, 60, doJumpId=7), waypoint(47.202, 60, doJumpId=8), jump)
    same = [waypoint(47.201, 60, doJumpId=1), waypoint(47.202, 60, doJumpId=1)]
    counted = plan(tmp_path, *same, item(177, 1, 1, 0, 0, 0, 0, 0, doJumpId=1))
    for mission in (own, counted):
        assert [p.name for p in mission.path] == ["home", "1", "2", "1", "2"]


def test_rally_points_of_the_file_make_the_return_uncertain(tmp_path):
    path = tmp_path / "a.plan"
    items = [waypoint(47.201, 60), item(20, 0, 0, 0, 0, 0, 0, 0, frame=2)]
    document = {"mission": {"plannedHomePosition": list(HOME), "items": items}}
    for points in ([], [[47.21, 8.2, 60]]):
        path.write_text(json.dumps(document | {"rallyPoints": {"points": points, "version": 2}}))
        assert bool(read_mission(path).not_judged) == bool(points)


def test_coordinates_apart_from_the_parameters_are_read(tmp_path):
    old = {"type": "SimpleItem", "command": 16, "frame": 3, "params": [0, 0, 0, 0],
           "coordinate": [47.201, 8.2, 60]}  # fmt: skip
    (place,) = plan(tmp_path, old).waypoints
    assert (place.latitude_deg, place.height_m) == (47.201, 60)


def test_mission_planners_rows_of_a_round_and_a_speed(tmp_path):
    mission = rows(
        tmp_path,
        (0, 1, 0, 16, 0, 0, 0, 0, 47.2, 8.2, 10, 1), (1, 0, 3, 22, 0, 0, 0, 0, 0, 0, 80, 1),
        (2, 0, 0, 178, 1, 18, 0, 0, 0, 0, 0, 1), (3, 0, 0, 178, 2, 1.5, 0, 0, 0, 0, 0, 1),
        (4, 0, 3, 16, 0, 0, 0, 0, 47.2005, 8.1995, 80, 1),
        (5, 0, 3, 16, 0, 0, 0, 0, 47.2005, 8.2005, 80, 1),
        (6, 0, 3, 177, 4, 3, 0, 0, 0, 0, 0, 1), (7, 0, 3, 20, 0, 0, 0, 0, 0, 0, 0, 1),
    )  # fmt: skip
    assert [p.name for p in mission.path] == ["home", *"12" * 4, "home"]
    assert (mission.home, mission.takeoff_height_m, mission.speed_m_s) == ((47.2, 8.2), 80, 18)
    first = mission.waypoints[0]
    assert (first.latitude_deg, first.longitude_deg, first.height_m) == (47.2005, 8.1995, 80)
