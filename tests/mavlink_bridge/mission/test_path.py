"""Missions are followed as ArduPilot and PX4 fly them; what cannot be followed is named."""

from __future__ import annotations

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.errors import MissionError
from mavlink_bridge.mission.items import (
    GimbalTarget,
    HeightAbove,
    LoiterCircle,
    MissionItem,
    MissionVehicle,
    RegionOfInterest,
    UnreadItem,
)
from mavlink_bridge.mission.path import PlannedMission, planned_path

NAN = math.nan
HOME = (47.2, 8.2)
A, B, C = (47.201, 8.2), (47.201, 8.201), (47.2, 8.201)
PLANE, PX4_VTOL, PX4_COPTER = MissionVehicle(3, 1), MissionVehicle(12, 20), MissionVehicle(12, 2)
COPTER = MissionVehicle(3, 2)
TAKEOFF = (22, 0, 0, 0, 0, 0, 0, 80)


def items(*rows, frame=3):
    """Rows of command, param1 to param7, counted from 1."""
    made = []
    for number, row in enumerate(rows, 1):
        if isinstance(row, str):
            made.append(UnreadItem(number, row))
        else:
            command, *parameters = row
            made.append(MissionItem(number, command, frame, tuple(map(float, parameters))))
    return made


def to(place, up, command=16, *parameters):
    return (command, *parameters, *[0] * (4 - len(parameters)), *place, up)


def flown(*rows, home=HOME, vehicle=COPTER, **more) -> PlannedMission:
    return planned_path(items(*rows), home, vehicle, **more)


def names(mission):
    return [place.name for place in mission.path]


def told(mission):
    return " ".join(found.text for found in mission.not_judged)


def test_a_vtol_takes_off_loiters_to_an_altitude_and_lands():
    mission = flown(
        (84, 0, 0, 0, 0, 0, 0, 80), to(A, 80), to(B, 50, 31, 0, 60), to(C, 0, 85), to(HOME, 70),
    )  # fmt: skip
    assert names(mission) == ["home", "1", "2", "3"]  # nothing is flown after a landing
    assert [p.height_m for p in mission.path] == [80, 80, 50, 50]
    assert not mission.not_judged


@pytest.mark.parametrize(
    ("row", "vehicle", "circle", "note"),
    [
        (to(B, 50, 31, 0, 60), PX4_VTOL, LoiterCircle(60.0), ""),
        (to(B, 50, 31, 0, 60), COPTER, None, ""),
        (to(B, 50, 31, 0, 0), PX4_VTOL, LoiterCircle(80.0), "default circle of 80 m"),
        (to(B, 50, 31, 0, NAN), PLANE, LoiterCircle(60.0), "default circle of 60 m"),
        (to(B, 50, 18, 2.5, 0, -40), COPTER, LoiterCircle(-40.0, 3, True), ""),
        (to(B, 50, 18, 3, 0, 40), PX4_COPTER, None, ""),
        (to(B, 50, 18, 30, 0, 40), PLANE, LoiterCircle(40.0, 10), "10 of its 30 rounds"),
        (to(B, 50, 19, 60, 0, 75), PLANE, LoiterCircle(75.0), "one round of its circle"),
        (to(B, 50, 19, 60, 0, 75), COPTER, None, ""),
        (to(B, 50, 17, 0, 0, 75), PLANE, LoiterCircle(75.0), "holds until the pilot"),
        (to(B, 50, 17, 0, 0, 0), MissionVehicle(), LoiterCircle(60.0), "default circle of 60 m"),
    ],
)
def test_a_circle_is_flown_as_the_firmware_does(row, vehicle, circle, note):
    mission = flown(row, vehicle=vehicle)
    assert [p.circle for p in mission.path] == [None, circle]
    assert note in " ".join(mission.notes)
    assert bool(note) == bool(mission.notes)
    assert not mission.not_judged


def test_after_a_landing_only_a_take_off_goes_on():
    rows = (TAKEOFF, to(A, 60), to(B, 0, 21), (93, 30, 0, 0, 0, 0, 0, 0), (22, *[0] * 6, 40),
            to(C, 40), (20, *[0] * 7), to(A, 40))  # fmt: skip
    mission = flown(*rows)
    assert names(mission) == ["home", "1", "2", "3", "home"]
    assert [p.height_m for p in mission.path] == [80, 60, 60, 40, 40]
    assert mission.path[-1].name == "home"


def test_an_aeroplane_glides_to_its_landing_and_a_copter_does_not():
    rows = (TAKEOFF, to(A, 60), to(B, 5, 21))
    assert flown(*rows, vehicle=PLANE).path[-1].height_m == 5
    assert flown(*rows).path[-1].height_m == 60


@pytest.mark.parametrize(
    ("times", "expected", "note"),
    [
        (0, "123", ""),
        (1, "123123", ""),
        (3, "123" * 4, ""),
        (500, "123" * 11, "MAV_CMD_DO_JUMP (item 5) repeats 500 times: 10 rounds"),
        (-1, "123123", "repeats without end"),
    ],
)
def test_a_jump_is_flown_as_often_as_it_says(times, expected, note):
    jump = (177, 2, times, 0, 0, 0, 0, 0)
    mission = flown(TAKEOFF, to(A, 80), to(B, 80), to(C, 80), jump, (20, *[0] * 7))
    back = [] if times == -1 else ["home"]  # what follows an endless jump is never reached
    assert names(mission) == ["home", *expected, *back]
    assert note in " ".join(mission.notes)


def test_jumps_in_jumps_forward_jumps_tags_and_jumps_to_nowhere():
    inner, outer = (177, 1, 1, *[0] * 5), (177, 1, 1, *[0] * 5)
    assert names(flown(to(A, 50), to(B, 50), inner, outer)) == ["home", *"12" * 4]
    assert names(flown((177, 3, 1, *[0] * 5), to(A, 50), to(B, 50))) == ["home", "1"]
    tagged = flown((600, 7, *[0] * 6), to(A, 50), to(B, 50), (601, 7, 1, *[0] * 5))
    assert names(tagged) == ["home", *"1212"]
    nowhere = flown(to(A, 50), (177, 99, 1, *[0] * 5), to(B, 50))
    assert names(nowhere) == ["home", "1"]
    assert "MAV_CMD_DO_JUMP (item 2) leads nowhere" in nowhere.notes[0]
    itself = flown(to(A, 50), (177, 2, -1, *[0] * 5), to(B, 50))
    assert names(itself) == ["home", "1"]


@pytest.mark.parametrize(
    ("rows", "speed"),
    [
        ([(178, 1, 18), (178, 2, 1.5), (178, 3, 1)], 18),
        ([(178, 0, 22)], 22),
        ([(178, 1, 18), (178, 1, -1)], 18),
        ([(178, 1, 18), (178, 1, NAN)], 18),
        ([(178, 1, 18), (178, 1, 0)], 18),
        ([(178, 1, 18), (178, 0, -2)], 15),
        ([], 15),
    ],
)
def test_only_a_speed_over_the_ground_or_through_the_air_is_one(rows, speed):
    changes = [(*row, *[0] * (8 - len(row))) for row in rows]
    mission = flown(TAKEOFF, *changes, to(A, 80), speed_m_s=15.0)
    assert mission.speed_m_s == mission.path[-1].speed_m_s == speed


def pitch_yaw(pitch, yaw, *, rate=NAN, flags=12):
    return (1000, pitch, yaw, rate, rate, flags, 0, 0)


def mount(pitch, yaw=0.0, mode=2):
    return (205, pitch, 0, yaw, 0, 0, 0, mode)


@pytest.mark.parametrize(
    ("commands", "vehicle", "target"),
    [
        ([pitch_yaw(-60, 0), pitch_yaw(NAN, 30)], PX4_COPTER, GimbalTarget(-60, 30)),
        ([pitch_yaw(-60, 0), pitch_yaw(NAN, 30)], COPTER, GimbalTarget(-60)),  # both or none
        ([pitch_yaw(-60, 0), pitch_yaw(NAN, NAN)], COPTER, GimbalTarget(-60)),
        ([pitch_yaw(-45, 90, flags=16)], COPTER, GimbalTarget(-45, 90, from_north=True)),
        ([mount(-30), mount(NAN, NAN)], COPTER, GimbalTarget(-30)),
        ([mount(-30, mode=0)], MissionVehicle(), GimbalTarget(-30)),  # Mission Planner's
        ([(195, 0, 0, 0, 0, *C, 12)], COPTER,
         GimbalTarget(roi=RegionOfInterest(*C, 12, HeightAbove.HOME))),
        ([(201, 3, 0, 0, 0, *C, 0)], PX4_COPTER,
         GimbalTarget(roi=RegionOfInterest(*C, 0, HeightAbove.HOME))),
        ([(195, 0, 0, 0, 0, *C, 12), (197, *[0] * 7)], COPTER, GimbalTarget()),
        ([(201, 0, 0, 0, 0, *C, 12), (201, *[0] * 7)], COPTER, GimbalTarget()),
    ],
)  # fmt: skip
def test_the_camera_looks_where_it_was_last_told(commands, vehicle, target):
    mission = flown(TAKEOFF, *commands, to(A, 80), vehicle=vehicle)
    assert mission.path[-1].gimbal == target
    assert not mission.not_judged


@pytest.mark.parametrize(
    ("row", "vehicle", "name"),
    [
        (mount(0, mode=1), COPTER, "MAV_CMD_DO_MOUNT_CONTROL (item 2): MAV_MOUNT_MODE_NEUTRAL"),
        (mount(0, mode=3), COPTER, "MAV_MOUNT_MODE_RC_TARGETING"),
        (mount(-30, mode=0), PX4_COPTER, "MAV_MOUNT_MODE_RETRACT"),
        (mount(-4500), COPTER, "are no angles in degrees"),
        (pitch_yaw(0, 0, flags=1), COPTER, "GIMBAL_MANAGER_FLAGS_RETRACT"),
        (pitch_yaw(NAN, NAN, rate=5), COPTER, "turns at a rate"),
        ((201, 1, 0, 0, 0, 0, 0, 0), PX4_COPTER, "MAV_CMD_DO_SET_ROI (item 2): MAV_ROI_WPNEXT"),
        ((115, 90, 0, 0, 0, 0, 0, 0), COPTER, "MAV_CMD_CONDITION_YAW (item 2)"),
        ((80, 0, 0, 0, 0, *C, 0), COPTER, "MAV_CMD_NAV_ROI (item 2)"),
        ((198, 3, 0, 0, 0, 0, 0, 0), COPTER, "MAV_CMD_DO_SET_ROI_SYSID (item 2)"),
        ((42702, 1, 9, 0, 0, 0, 0, 0), COPTER, "MAV_CMD_NAV_SCRIPT_TIME (item 2)"),
        ((30, 0, 0, 0, 0, 0, 0, 90), PLANE, "MAV_CMD_NAV_CONTINUE_AND_CHANGE_ALT (item 2)"),
        ((92, 1, 0, 0, 0, 0, 0, 0), COPTER, "MAV_CMD_NAV_GUIDED_ENABLE (item 2)"),
        ((34, 30, 0, 0, 0, *A, 50), PX4_COPTER, "MAV_CMD_DO_ORBIT (item 2)"),
        ((179, 0, 0, 0, 0, *A, 50), COPTER, "MAV_CMD_DO_SET_HOME (item 2)"),
        ((9999, 0, 0, 0, 0, 0, 0, 0), COPTER, "MAV_CMD 9999 (item 2)"),
        ("StructureScan", COPTER, "StructureScan (item 2)"),
    ],
)
def test_what_only_the_flight_shows_is_named(row, vehicle, name):
    mission = flown(to(A, 50), row, to(B, 50), to(C, 50), vehicle=vehicle)
    assert name in told(mission)
    flies = not isinstance(row, tuple) or row[0] in (42702, 30, 92, 34)
    assert [p.after_gap for p in mission.path] == [False, False, flies, False]
    assert mission.path[-1].gimbal == GimbalTarget()


def test_what_changes_neither_way_nor_view_is_listed_and_does_not_matter():
    rows = (206, 112, 183, 189, 2000, 3000, 93, 207)
    mission = flown(to(A, 50), *[(command, 5, 0, 0, 0, 0, 0, 0) for command in rows], to(B, 50))
    assert not mission.not_judged
    assert mission.no_effect[0] == "MAV_CMD_DO_SET_CAM_TRIGG_DIST"
    assert len(mission.no_effect) == len(rows)


@pytest.mark.parametrize("unset", [(0, 0, 0), (NAN, NAN, NAN), (0, 0, NAN)])
def test_what_is_not_set_is_as_it_was(unset):
    mission = flown(TAKEOFF, to(A, 60), (19, 5, 0, 0, 0, *unset), to(B, unset[2]))
    assert [(p.latitude_deg, p.height_m) for p in mission.path[2:]] == [(A[0], 60), (B[0], 60)]


def test_without_home_it_begins_over_its_take_off_and_no_return_is_made_up():
    there = (22, 0, 0, 0, NAN, *HOME, 80)
    mission = flown(there, to(A, 80), (20, *[0] * 7), home=None)
    assert names(mission) == ["take-off", "1"]
    assert "MAV_CMD_NAV_RETURN_TO_LAUNCH (item 3): the mission has no home" in told(mission)
    assert names(flown(TAKEOFF, to(A, 80), home=None)) == ["1"]


def test_a_return_may_end_at_a_rally_point():
    rows = (TAKEOFF, to(A, 80), (20, *[0] * 7))
    mission = flown(*rows, vehicle=MissionVehicle(3, 2, has_rally_points=True))
    assert names(mission) == names(flown(*rows)) == ["home", "1", "home"]
    assert "MAV_CMD_NAV_RETURN_TO_LAUNCH (item 3): it may return to a rally point" in told(mission)


def test_px4_flies_to_the_take_offs_place_and_ardupilot_does_not():
    away = (22, 0, 0, 0, NAN, *C, 80)
    assert names(flown(away, to(A, 80), vehicle=PX4_VTOL)) == ["home", "take-off", "1"]
    assert names(flown(away, to(A, 80))) == ["home", "1"]


def test_places_that_are_none_are_named():
    with pytest.raises(MissionError, match=r"waypoint 1 is no place: item 2 lies at 95, 8"):
        flown(TAKEOFF, to((95, 8), 50))
    with pytest.raises(MissionError, match=r"MAV_CMD_NAV_WAYPOINT \(item 1\) is in frame 1"):
        planned_path(items(to(A, 50), frame=mavlink.MAV_FRAME_LOCAL_NED), HOME)
    with pytest.raises(MissionError, match="its altitude is inf"):
        flown(to(A, math.inf))
