import json

import numpy as np
import pytest

from localizer.errors import PoseFileError
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Pose, so3_exp
from localizer.geometry.posefile import pose_row, read_poses, world_from_camera, write_poses

FRAME = LocalFrame(Geodetic(47.3, 8.5, 450.0))


def test_zero_angles_look_at_the_nadir_with_north_up():
    row = pose_row("x.jpg", Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3)), FRAME)
    assert (row.roll_deg, row.pitch_deg, row.yaw_deg) == pytest.approx((0, 0, 0), abs=1e-9)
    R = world_from_camera(row, FRAME).rotation
    np.testing.assert_allclose(R @ [0, 0, 1], [0, 0, -1], atol=1e-9)  # optical axis: down
    np.testing.assert_allclose(R @ [0, -1, 0], [0, 1, 0], atol=1e-9)  # image up: north


def test_yaw_counts_counter_clockwise(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text("a.jpg 8.5 47.3 450 0 0 90\n")
    R = world_from_camera(read_poses(path)[0], FRAME).rotation
    np.testing.assert_allclose(R @ [0, -1, 0], [-1, 0, 0], atol=1e-9)  # image up: west


@pytest.mark.parametrize("seed", range(5))
def test_round_trip_through_a_file(tmp_path, seed):
    rng = np.random.default_rng(seed)
    pose = Pose(so3_exp(rng.normal(0, 0.6, 3)) @ np.diag([1.0, -1, -1]), rng.normal(0, 3000, 3))
    path = tmp_path / "poses.txt"
    write_poses(path, [pose_row("a.jpg", pose, FRAME)])
    back = world_from_camera(read_poses(path)[0], FRAME)
    translation, rotation = pose.distance_to(back)
    assert translation < 5e-4
    assert rotation < 1e-5


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "holds no pose"),
        ("a.jpg 8 47 450 0 0\n", "6 fields"),
        ("a.jpg 8 147 450 0 0 0\n", "out of range"),
        ("a.jpg 8 47 450 0 nan 0\n", "finite"),
        ("a.jpg 8 47 high 0 0 0\n", "could not convert"),
        ("a.jpg 8 47 0 0 0 0\na.jpg 8 48 0 0 0 0\n", r"2 lines are of a\.jpg"),
    ],
)
def test_bad_lines_name_file_and_line(tmp_path, text, what):
    path = tmp_path / "poses.txt"
    path.write_text(text)
    with pytest.raises(PoseFileError, match=what):
        read_poses(path)


@pytest.mark.real
def test_caliterra_pose_lines_agree_with_its_matrices(real_data):
    folder = real_data("caliterra")
    origin = json.loads((folder / "georef.json").read_text())["origin"]
    frame = LocalFrame(Geodetic(origin["lat"], origin["lon"], origin["height"]))
    matrices = json.loads((folder / "queries" / "poses.json").read_text())
    for row in read_poses(folder / "queries" / "poses.txt"):
        truth = Pose.from_matrix(matrices[row.name]["T_enu_from_cam"])
        translation, rotation = truth.distance_to(world_from_camera(row, frame))
        assert translation < 2e-3
        assert rotation < 2e-3
