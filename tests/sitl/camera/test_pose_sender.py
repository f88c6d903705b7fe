"""The truth feed: where the camera is told to be is where the vehicle is."""

from __future__ import annotations

import math
import threading
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from companion.geometry import GimbalAngles, GimbalFrame, Mount
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Pose, matrix_from_euler, quaternion_from_matrix, so3_exp
from localizer.map.cache.tile import TileMesh
from localizer.synth.plan.terrain import River, Terrain
from localizer.synth.world import WorldInfo
from sitl.camera.movers import Mover, traffic
from sitl.camera.pose_sender import GimbalError, truth_feed
from sitl.camera.true_motion import PoseTrack, TruthSample, camera_pose
from sitl.errors import SimulationError
from sitl.geodesy import Location

ORIGIN = Geodetic(47.0, 8.0, 500.0)
SEPARATION_M = 48.0
CACHE: Any = SimpleNamespace(
    frame=LocalFrame(ORIGIN), manifest=SimpleNamespace(geoid_separation_m=SEPARATION_M)
)
LEVEL = (1.0, 0.0, 0.0, 0.0)


class _Record:
    """A vehicle that is `north_m` north of the origin and 100 m above it, at a time that runs."""

    def __init__(self, in_vehicle_frame: bool = True) -> None:
        self.now_ns: int | None = None
        self.asked: list[int] = []
        self._in_vehicle_frame = in_vehicle_frame
        place = CACHE.frame.position(np.array([30.0, 40.0, 100.0]))
        height_m = place.height_m - SEPARATION_M
        self.location = Location(place.latitude_deg, place.longitude_deg, height_m)

    def newest_common_ns(self):
        return self.now_ns

    def truth_at(self, time_ns):
        self.asked.append(time_ns)
        return SimpleNamespace(time_ns=time_ns, location=self.location, quaternion=LEVEL)

    def gimbal_at(self, time_ns):
        self.asked.append(time_ns)
        return SimpleNamespace(roll_pitch_yaw=(0.0, math.radians(-80), 0.1),
                               yaw_in_vehicle_frame=self._in_vehicle_frame)  # fmt: skip


class _Camera:
    """Takes what is sent, and wakes who waits for it; fails after `lives`."""

    def __init__(self, lives: int = 10**6) -> None:
        self.sent: list[TruthSample] = []
        self.told, self._lives = threading.Event(), lives

    def send(self, sample):
        self.sent.append(sample)
        self.told.set()
        if len(self.sent) >= self._lives:
            raise SimulationError("the world camera is gone")


class _Gimbal:
    """Off by a constant pitch."""

    def true_angles(self, reported, time_ns):
        return replace(reported, pitch_rad=reported.pitch_rad + 0.02)


def _fed(record: _Record, camera: _Camera, shift=(0.0, 0.0, 0.0)) -> Any:
    pilot: Any = SimpleNamespace(record=record)
    return truth_feed(pilot, camera, CACHE, _Gimbal(), shift)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("in_vehicle_frame", "frame"), [(True, GimbalFrame.HEADING), (False, GimbalFrame.EARTH)]
)
def test_the_camera_is_told_the_vehicles_place_on_the_map_and_the_gimbals_true_angles(
    in_vehicle_frame, frame
):
    record, camera = _Record(in_vehicle_frame), _Camera()
    record.now_ns = 5_000
    with _fed(record, camera, shift=(1.0, -2.0, 0.5)):
        assert camera.told.wait(30.0)
    sample = camera.sent[0]
    assert sample.time_ns == 5_000
    assert set(record.asked) == {5_000}  # place and angles of one instant
    # What is under the vehicle is shown by a shifted map where the vehicle would be over it.
    assert sample.position == pytest.approx([31.0, 38.0, 100.5], abs=1e-3)
    assert sample.gimbal.pitch_rad == pytest.approx(math.radians(-80) + 0.02)
    assert sample.gimbal.frame is frame


def test_an_instant_is_told_once_and_nothing_before_the_vehicle_is_known():
    record, camera = _Record(), _Camera()
    with _fed(record, camera):
        for time_ns in (1_000, 2_000):
            camera.told.clear()
            record.now_ns = time_ns
            assert camera.told.wait(30.0)
        seen = len(record.asked)
        while len(record.asked) < seen + 6:  # three turns more of the same instant
            threading.Event().wait(0.005)
    assert [s.time_ns for s in camera.sent] == [1_000, 2_000]


def test_a_dead_camera_ends_the_feed_and_not_the_flight():
    record, camera = _Record(), _Camera(lives=1)
    record.now_ns = 1_000
    with _fed(record, camera):
        assert camera.told.wait(30.0)
        record.now_ns = 2_000
    assert len(camera.sent) == 1


# --- gimbal_error -------------------------------------------------------------------------------


def _errors(seed, seconds=600):
    model = GimbalError(seed)
    zero = GimbalAngles(0.0, 0.0, 0.0)
    angles = [model.true_angles(zero, round(t * 1e9)) for t in np.arange(0, seconds, 0.1)]
    return np.degrees([(a.roll_rad, a.pitch_rad, a.yaw_rad) for a in angles])


def test_alignment_stays_and_wander_is_bounded_and_slow():
    errors = _errors(1)
    assert 0.15 < errors.std(axis=0).mean() < 0.45  # the wander
    assert np.abs(np.diff(errors, axis=0)).max() < 0.4  # degrees in 0.1 s
    first, last = errors[:3000].mean(axis=0), errors[3000:].mean(axis=0)
    np.testing.assert_allclose(first, last, atol=0.2)  # the alignment


def test_seeds_differ_and_repeat():
    np.testing.assert_array_equal(_errors(2, 5), _errors(2, 5))
    means = np.array([_errors(seed, 5).mean(axis=0) for seed in range(40)])
    assert 0.35 < means.std() < 0.8


# --- Interpolated truth, and objects whose place is a function of time --------------------------


MESH = TileMesh(
    np.zeros((3, 3), np.float32),
    np.zeros((3, 2), np.float32),
    np.array([[0, 1, 2]], np.int32),
    (np.zeros((1, 1, 3), np.uint8),),
    Pose.identity(),
)
SQUARE = np.array([[0.0, 0, 1], [40, 0, 1], [40, 40, 1], [0, 40, 1]])


def test_a_track_interpolates_position_and_rotation_evenly() -> None:
    a = Pose(np.eye(3), np.zeros(3))
    b = Pose(so3_exp([0, 0, 1.0]), np.array([10.0, 0, -2]))
    track = PoseTrack([(1000, a), (2000, b)])
    middle = track.at(1250)
    np.testing.assert_allclose(middle.translation, [2.5, 0, -0.5])
    np.testing.assert_allclose(middle.rotation, so3_exp([0, 0, 0.25]), atol=1e-12)
    assert track.at(999) is None
    assert track.at(2001) is None
    assert track.at(2000) is not None


def test_a_vehicles_sample_gives_its_cameras_pose() -> None:
    frame = LocalFrame(Geodetic(47.0, 8.0, 430.0))
    body = quaternion_from_matrix(matrix_from_euler(0.1, -0.05, np.pi / 2))
    sample = TruthSample(5, np.array([10.0, 20, 120]), body, GimbalAngles(0, -np.pi / 2, 0))
    pose = camera_pose(sample, frame, Mount.from_degrees())
    np.testing.assert_allclose(pose.translation, [10, 20, 120])
    # Heading east and looking down: the image's up is east, its right is south.
    np.testing.assert_allclose(pose.rotation, [[0, -1, 0], [-1, 0, 0], [0, 0, -1]], atol=1e-4)


def test_a_mover_goes_round_at_its_speed() -> None:
    mover = Mover("a", SQUARE, speed_mps=8.0, phase_m=5.0, mesh=MESH, epoch_ns=10**9)
    np.testing.assert_allclose(mover.position_at(10**9), [5, 0, 1])
    np.testing.assert_allclose(mover.position_at(2 * 10**9), [13, 0, 1])
    np.testing.assert_allclose(mover.velocity_at(2 * 10**9), [8, 0, 0], atol=1e-12)
    np.testing.assert_allclose(mover.position_at(21 * 10**9), mover.position_at(10**9), atol=1e-9)
    pose = mover.pose_at(10**9 + 8 * 10**9)  # 69 m along: on the way north
    np.testing.assert_allclose(pose.rotation[:, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(pose.rotation[:, 2], [0, 0, 1])
    np.testing.assert_allclose(pose.translation, [40, 29, 1])


# --- Traffic stands on the ground, keeps to its lanes, and is known by its arguments ------------


ORIGIN_TRAFFIC = Geodetic(47.3, 8.4, 450.0)
SECOND = 10**9


@pytest.fixture
def world() -> WorldInfo:
    """A slope of 10 % to the east with one lane to the north at x = 2.2."""
    heights = np.tile(0.1 * (np.arange(41) * 20.0 - 400.0), (41, 1))
    none = River(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    y = np.arange(-300.0, 301.0, 4.0)
    lane = np.column_stack([np.full(len(y), 2.2), y, np.zeros(len(y))])
    return WorldInfo(
        0, "live", 800.0, ORIGIN_TRAFFIC, 47.5, (), (lane,), 0, Terrain(heights, 20.0, none)
    )


def test_cars_drive_on_the_right_and_people_walk_beside_the_road(world: WorldInfo) -> None:
    movers = traffic(world, world.frame, cars=12, people=12, seed=2)
    assert [m.name for m in movers[:2]] == ["car0", "car1"]
    for mover in movers:
        for t in range(0, 60 * SECOND, 7 * SECOND):
            east, north, up = mover.position_at(t)
            if abs(north) > 290:  # where they turn round
                continue
            going_north = mover.velocity_at(t)[1] > 0
            beside = 2.2 if mover.name.startswith("car") else 6.2
            assert east == pytest.approx(beside if going_north else -beside, abs=1e-6)
            assert up == pytest.approx(0.1 * east, abs=1e-3)
            speed = np.linalg.norm(mover.velocity_at(t))
            assert 7 <= speed <= 14 if mover.name.startswith("car") else 1 <= speed <= 1.7


def test_the_same_arguments_give_the_same_truth_and_the_epoch_shifts_it(world: WorldInfo) -> None:
    a = traffic(world, world.frame, cars=3, people=0, seed=5)
    b = traffic(world, world.frame, cars=3, people=0, seed=5, epoch_ns=100 * SECOND)
    for first, second in zip(a, b, strict=True):
        np.testing.assert_allclose(
            first.position_at(9 * SECOND), second.position_at(109 * SECOND), atol=1e-9
        )
