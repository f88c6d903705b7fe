"""``companion localize``: images whose true poses are not known, on a generated world."""

import csv
import shutil

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from companion.cli.commands import app
from companion.errors import ConfigError
from localizer.geometry.trajectory import read_poses, world_from_camera
from localizer.map.cache.cache import TileCache


def _run(*arguments):
    return CliRunner().invoke(app, ["localize", *map(str, arguments)])


def _common(assets, sequence, out):
    return ("--map", assets.map_cache, "--camera", sequence / "camera.json", "--out", out,
            "--renderer", "numba", "--device", "cpu")  # fmt: skip


def _off(row, metres_north):
    """A prior some metres and degrees off a true pose, as the option takes it."""
    p = row.position
    values = (p.latitude_deg + metres_north / 111e3, p.longitude_deg, p.height_m + 2,
              row.roll_deg + 2, row.pitch_deg - 2, row.yaw_deg + 3)  # fmt: skip
    return ",".join(map(str, values))


def _errors(assets, sequence, out):
    frame = TileCache.open(assets.map_cache).frame
    truth = {row.name: row for row in read_poses(sequence / "poses.txt")}
    return [
        world_from_camera(row, frame).distance_to(world_from_camera(truth[row.name], frame))
        for row in read_poses(out / "poses.txt")
    ]


def test_one_photo_from_a_prior_that_is_off(small_assets, small_sequence, tmp_path):
    row = read_poses(small_sequence / "poses.txt")[0]
    result = _run(small_sequence / "images" / row.name, *_common(
        small_assets, small_sequence, tmp_path), "--prior", _off(row, 5))  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "1 of 1 images localized" in result.output
    ((metres, degrees),) = _errors(small_assets, small_sequence, tmp_path)
    assert metres < 1.0
    assert degrees < 1.0
    (tum,) = np.loadtxt(tmp_path / "trajectory.tum", ndmin=2)
    frame = TileCache.open(small_assets.map_cache).frame
    (found,) = read_poses(tmp_path / "poses.txt")
    position = world_from_camera(found, frame).translation
    assert tum[1:4] == pytest.approx(position, abs=1e-3)


def test_a_measured_height_and_attitude_make_the_pose_surer(small_assets, small_sequence, tmp_path):
    row = read_poses(small_sequence / "poses.txt")[0]
    p = row.position
    prior = ",".join(map(str, (p.latitude_deg + 5 / 111e3, p.longitude_deg, p.height_m,
                               row.roll_deg, row.pitch_deg, row.yaw_deg + 3)))  # fmt: skip
    sigmas = []
    for more in ((), ("--attitude-sigma-deg", 0.1, "--height-sigma-m", 0.05)):
        result = _run(small_sequence / "images" / row.name, *_common(
            small_assets, small_sequence, tmp_path), "--prior", prior, *more)  # fmt: skip
        assert result.exit_code == 0, result.output
        with (tmp_path / "images.csv").open(newline="") as file:
            (found,) = csv.DictReader(file)
        sigmas.append([float(found[key]) for key in ("sigma_north_m", "sigma_up_m")])
    assert sigmas[1][0] < sigmas[0][0]
    assert sigmas[1][1] < sigmas[0][1]


def test_a_folder_goes_on_from_its_first_prior_and_tells_what_it_could_not_use(
    small_assets, small_sequence, tmp_path
):
    folder = tmp_path / "images"
    folder.mkdir()
    for name in ("000000.jpg", "000001.jpg", "000002.jpg", "000003.jpg", "timestamps.txt"):
        shutil.copy(small_sequence / "images" / name, folder)
    (folder / "000001.jpg").write_bytes(b"no image")
    for name, counts in (("000002.jpg", 1), ("000003.jpg", 9)):  # thermal cameras
        grey = np.asarray(cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE), np.uint16) * counts
        kept = grey if counts > 1 else grey.astype(np.uint8)
        (folder / name).write_bytes(cv2.imencode(".png", kept)[1].tobytes())
    row = read_poses(small_sequence / "poses.txt")[0]
    out = tmp_path / "out"
    result = _run(folder, *_common(small_assets, small_sequence, out), "--prior", _off(row, 3))
    assert result.exit_code == 0, result.output
    assert "000001.jpg: not an image" in result.output
    assert "000003.jpg: 16-bit grey" in result.output
    assert "2 of 4 images localized" in result.output
    assert max(metres for metres, _ in _errors(small_assets, small_sequence, out)) < 1.0
    with (out / "images.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["accepted"] for row in rows] == ["1", "", "1", ""]


def test_a_place_where_it_was_not_taken_is_no_place(small_assets, small_sequence, tmp_path):
    """The false alarm's other side: nothing is written as localized, and the exit code says so."""
    row = read_poses(small_sequence / "poses.txt")[0]
    file = tmp_path / "priors.txt"
    file.write_text(f"{row.name} {row.position.longitude_deg + 0.5} {row.position.latitude_deg} "
                    f"{row.position.height_m} 0 0 0\n")  # fmt: skip
    out = tmp_path / "out"
    result = _run(small_sequence / "images" / row.name,
                  *_common(small_assets, small_sequence, out), "--priors", file)  # fmt: skip
    assert result.exit_code == 1
    assert "does not meet the map" in result.output
    assert (out / "poses.txt").read_text() == ""


@pytest.mark.parametrize("missing", ["images", "--map", "--camera"])
def test_a_wrong_path_is_named_before_the_prior_that_is_missing(
    small_assets, small_sequence, tmp_path, missing
):
    given = {
        "images": small_sequence / "images", "--map": small_assets.map_cache,
        "--camera": small_sequence / "camera.json", missing: tmp_path / "nowhere",
    }  # fmt: skip
    result = _run(given.pop("images"), *(text for pair in given.items() for text in pair))
    assert str(tmp_path / "nowhere") in str(result.exception)


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ((), "either --prior"),
        (("--prior", "1,2,3"), "6 numbers"),
        (("--prior", "1,2,3,4,5,nan"), "6 numbers"),
    ],
)
def test_a_prior_that_is_none_is_named(small_assets, small_sequence, tmp_path, options, why):
    result = _run(small_sequence / "images" / "000000.jpg",
                  *_common(small_assets, small_sequence, tmp_path), *options)  # fmt: skip
    assert isinstance(result.exception, ConfigError)
    assert why in str(result.exception)
