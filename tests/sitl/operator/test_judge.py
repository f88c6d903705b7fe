"""What is judged of an operator's clicks and of a followed car: every fault is found, no other."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.flight.recorder import TARGET_COLUMNS
from localizer.geometry.pose import Pose, so3_exp
from localizer.synth.world import WorldInfo
from sitl.camera.world_camera import FrameLog
from sitl.demo.assets import FlightAssets
from sitl.operator.chase import SPEED_MPS, Chase, make_chase, pursuit
from sitl.operator.followed import FollowedFix, follow_verdict
from sitl.operator.judge import judge
from sitl.operator.operator import SentWish
from sitl.operator.station import GeoReport, ReceivedMessages
from sitl.operator.truth import GroundTruth, Pointed, all_pointed
from sitl.operator.wishes import Wish
from tests.companion.targets.scene import CAMERA, DOWN

SECOND = 10**9
PERIOD_NS = SECOND // 10


@pytest.fixture
def witness(small_assets: FlightAssets, tmp_path: Path) -> GroundTruth:
    """A camera that hovers over the small world for half a minute."""
    height = float(small_assets.world.ground_height(0.0, 0.0)) + 100.0
    with FrameLog(tmp_path / "frames.csv") as log:
        for k in range(320):
            pose = Pose(so3_exp([0.1, 0.05, 0.0]) @ DOWN, np.array([0.01 * k, 0.0, height]))
            log.add(k, k * PERIOD_NS, pose)
    return GroundTruth(small_assets, CAMERA, tmp_path / "frames.csv")


def clicked(number: int, u: float, v: float, frame: int, ended: tuple[int, ...] = ()) -> SentWish:
    time_ns = frame * PERIOD_NS
    wish = Wish("point", 0.0, (u, v))
    return SentWish(wish, time_ns, time_ns, frame, time_ns, 0.25, number, 0, ended)


def stopped(*ended: int, frame: int) -> SentWish:
    return replace(clicked(0, 0.5, 0.5, frame), wish=Wish("stop", 0.0), ended=ended)


def reports(path: Path, rows: list[dict[str, Any]]) -> Path:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, TARGET_COLUMNS, restval="")
        writer.writeheader()
        writer.writerows(rows)
    return path


def row(point: Pointed, at_s: float, off: Any = (0.0, 0.0, 0.0), **other: Any) -> dict[str, Any]:
    assert point.place is not None
    place = point.place + off
    names = {"east_m": place[0], "north_m": place[1], "up_m": place[2]}
    cov = {f"cov_{k}": 0.09 if k[0] == k[1] else 0.0 for k in ("ee", "en", "eu", "nn", "nu", "uu")}
    return {
        "exposure_time_ns": point.asked.frame_ns + round(at_s * SECOND),
        "target_id": f"ground station {point.asked.number}",
        **names, **cov, "visibility": "held", **other,
    }  # fmt: skip


@pytest.fixture
def asked() -> list[SentWish]:
    return [clicked(1, 0.3, 0.4, 10), clicked(2, 0.7, 0.6, 40), stopped(1, frame=200)]


def heard(witness: GroundTruth, points: dict[int, Pointed], **other: Any) -> ReceivedMessages:
    """One report over the link, of target 2."""
    place = points[2].place
    assert place is not None
    at = witness.frame.position(place)
    altitude = at.height_m - witness.geoid_m
    geo = GeoReport(50 * PERIOD_NS, at.latitude_deg, at.longitude_deg, altitude, 0.5, 0.3, None)
    return ReceivedMessages(geo=[replace(geo, **other)])


def test_right_reports_are_no_problem(witness, asked, tmp_path):
    points = all_pointed(witness, asked)
    rows = [row(p, s, (0.2, 0.0, 0.1)) for p in points.values() for s in np.arange(0.0, 12.0, 0.2)]
    verdict = judge(witness, asked, heard(witness, points), reports(tmp_path / "t.csv", rows))
    assert verdict.problems == ()
    assert (verdict.clicks, verdict.stops, verdict.link, len(verdict.lines)) == (2, 1, 1, 2)
    assert verdict.lines[0].late_p95_m == pytest.approx(np.hypot(0.2, 0.1), abs=1e-6)
    assert verdict.lines[0].off_px == pytest.approx(0.2 * CAMERA.fx / 100.0, rel=0.2)


@pytest.mark.parametrize(
    ("fault", "problem"),
    [
        (lambda p, q: [row(p, 1.0, q.place - p.place)], "at another target's place"),
        (lambda p, q: [row(p, 1.0, (4.0, 0.0, 0.0))], "not under their own pixel"),
        (lambda p, q: [row(p, 7.0, (1.3, 0.0, 0.0))], "target 1 after 5 s"),
        (lambda p, q: [row(p, 1.0, velocity_east=2.0)], "velocities of what stands"),
        (lambda p, q: [row(p, 21.0)], "after the target's end"),
        (lambda p, q: [], "without a report and without a word"),
    ],
)
def test_each_fault_of_a_report_is_a_problem(fault, problem, witness, asked, tmp_path):
    points = all_pointed(witness, asked)
    rows = [*fault(points[1], points[2]), row(points[2], 1.0)]
    verdict = judge(witness, asked, heard(witness, points), reports(tmp_path / "t.csv", rows))
    assert any(problem in found for found in verdict.problems), verdict.problems


def test_what_comes_over_the_link_is_judged_too(witness, asked, tmp_path):
    points = all_pointed(witness, asked)
    path = reports(tmp_path / "t.csv", [row(p, 1.0) for p in points.values()])
    for other, problem in (
        ({"latitude_deg": 47.0}, "at no living target's place"),
        ({"velocity": (1.0, 0.0, 0.0)}, "velocities over the link"),
    ):
        verdict = judge(witness, asked, heard(witness, points, **other), path)
        assert any(problem in found for found in verdict.problems)
    deaf = judge(witness, asked, ReceivedMessages(), path, "KeyError: 'x'")
    assert "nothing came over the link" in deaf.problems
    assert any("KeyError" in found for found in deaf.problems)


@pytest.fixture
def chase(small_assets: FlightAssets) -> Chase:
    world = small_assets.world
    lane = np.column_stack([np.arange(-400.0, 401.0, 10.0), np.zeros(81), np.zeros(81)])
    longer: WorldInfo = replace(world, roads=(lane,))
    return make_chase(longer, world.frame, SECOND, 5.0)


def fixes(chase: Chase, until_s: float = 60.0, off_m: float = 0.3) -> list[FollowedFix]:
    found = []
    for s in np.arange(0.0, until_s, 0.25):
        time_ns = chase.begins_ns() + round(s * SECOND)
        hidden = any(a <= time_ns <= b for a, b in chase.hidden_ns())
        place = chase.car.position_at(time_ns) + np.array([off_m, 0.0, 0.0])
        velocity = chase.car.velocity_at(time_ns)
        P = 0.04 * np.eye(3)
        found.append(FollowedFix(time_ns, place, P, velocity, P, not hidden))
    return found


def test_a_car_that_is_followed_through_both_roofs(chase: Chase) -> None:
    end_ns = chase.begins_ns() + 60 * SECOND
    verdict = follow_verdict(fixes(chase), chase, end_ns)
    assert verdict.is_followed, verdict.why
    assert verdict.p95_m == pytest.approx(0.3, abs=1e-6)
    assert verdict.velocity_p95_mps == pytest.approx(0.0, abs=1e-6)
    assert len(verdict.back_s) == 2
    for begin, end in chase.hidden_ns():  # so long that the whole car is out of sight for 2 s
        assert (end - begin) * 1e-9 == pytest.approx(2.0 + 4.5 / SPEED_MPS, abs=0.01)
    above = pursuit(chase.car, end_ns, 90.0, 25.0) - chase.car.position_at(end_ns)
    assert above[2] == pytest.approx(90.0, abs=1.0)


def test_each_way_of_losing_it_is_told(chase: Chase) -> None:
    end_ns = chase.begins_ns() + 60 * SECOND
    lost = follow_verdict(fixes(chase, 30.0), chase, end_ns)
    assert any("last seen 29" in why for why in lost.why)
    other = [replace(f, position=f.position + 9.0) for f in fixes(chase)[-8:]]
    foreign = follow_verdict([*fixes(chase), *other], chase, end_ns)
    assert "8 reports are of something else" in foreign.why
    late = chase.hidden_ns()[0][1] + 4 * SECOND
    gap = [f for f in fixes(chase) if not chase.hidden_ns()[0][0] < f.time_ns < late]
    assert any("after a roof" in why for why in follow_verdict(gap, chase, end_ns).why)
    assert not follow_verdict([], chase, end_ns).is_followed
