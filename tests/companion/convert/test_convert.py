"""Poses from and to other programs' formats: there and back, and against cases made by hand."""

import csv

import numpy as np
import pytest
from typer.testing import CliRunner

from companion.cli.commands import app
from companion.convert.angles import (
    AutopilotAngles,
    angles_of_matrix,
    gimbal_of_pose,
    pose_of_autopilot,
)
from companion.convert.formats import AUTOPILOT_COLUMNS
from companion.errors import ConfigError, ReportError
from companion.flight.recorder import ESTIMATE_COLUMNS
from localizer.errors import GeoreferenceError, PoseFileError
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import matrix_from_euler, quaternion_from_matrix
from localizer.geometry.trajectory import PoseRow, read_poses, world_from_camera, write_poses
from tests.companion.recorded.photos import dji, write_photo

ORIGIN = Geodetic(47.3, 8.5, 450.0)
FRAME = LocalFrame(ORIGIN)
PLACE = ("--origin", "47.3,8.5,450")
ROWS = (
    PoseRow("a.jpg", Geodetic(47.301, 8.502, 560.0), 3.0, 20.0, -40.0),
    PoseRow("b.jpg", Geodetic(47.302, 8.499, 571.5), -2.0, 0.0, 170.0),  # straight down, rolled
    PoseRow("c.jpg", Geodetic(47.299, 8.501, 600.25), 0.0, 0.0, 10.0),  # exactly straight down
    PoseRow("d.jpg", Geodetic(47.3, 8.5, 520.0), 0.0, 85.0, -95.0),
)


def _convert(*arguments):
    result = CliRunner().invoke(app, ["convert", *map(str, arguments)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result


@pytest.fixture
def poses(tmp_path):
    path = tmp_path / "poses.txt"
    write_poses(path, ROWS)
    return path


@pytest.fixture
def times(tmp_path):
    path = tmp_path / "timestamps.txt"
    stamps = (1_700_000_000_123_456_789 + k * 200_000_000 for k in range(len(ROWS)))
    path.write_text("".join(f"{r.name} {t}\n" for r, t in zip(ROWS, stamps, strict=True)))
    return path


def _same(path, metres=1e-3, degrees=2e-5, names=True):
    found = read_poses(path)
    assert len(found) == len(ROWS)
    for a, b in zip(found, ROWS, strict=True):
        moved, turned = world_from_camera(a, FRAME).distance_to(world_from_camera(b, FRAME))
        assert moved < metres
        assert turned < degrees
        assert not names or a.name == b.name


@pytest.mark.parametrize("between", ["poses", "colmap", "autopilot"])
def test_there_and_back(poses, tmp_path, between):
    _convert(poses, tmp_path / "x", "--from", "poses", "--to", between, *PLACE)
    _convert(tmp_path / "x", tmp_path / "back.txt", "--from", between, "--to", "poses", *PLACE)
    _same(tmp_path / "back.txt")


def test_there_and_back_by_tum_with_the_names_of_the_times(poses, times, tmp_path):
    dated = ("--times", times, *PLACE)
    _convert(poses, tmp_path / "x.tum", "--from", "poses", "--to", "tum", *dated)
    _convert(tmp_path / "x.tum", tmp_path / "back.txt", "--from", "tum", "--to", "poses", *dated)
    _same(tmp_path / "back.txt")
    first = (tmp_path / "x.tum").read_text().split()
    assert first[0] == "1700000000.123456789"  # a float would have lost the nanoseconds
    with pytest.raises(ConfigError, match="no times"):
        _convert(poses, tmp_path / "y.tum", "--from", "poses", "--to", "tum", *PLACE)


@pytest.mark.parametrize(("datum", "lift"), [("amsl", 47.5), ("ellipsoidal", 0.0)])
def test_there_and_back_by_sidecars(poses, tmp_path, datum, lift):
    heights = ("--heights", datum, "--geoid-separation", 47.5, *PLACE)
    _convert(poses, tmp_path / "x", "--from", "poses", "--to", "photos", *heights)
    assert f'AbsoluteAltitude="+{560 - lift:.4f}"' in (tmp_path / "x" / "a.xmp").read_text()
    back = tmp_path / "back.txt"
    _convert(tmp_path / "x", back, "--from", "photos", "--to", "poses", *heights)
    _same(back, names=False)


def test_heights_of_unknown_datum_are_no_guess(poses, tmp_path):
    with pytest.raises(GeoreferenceError, match="--heights"):
        _convert(poses, tmp_path / "x", "--from", "poses", "--to", "photos", *PLACE)
    with pytest.raises(ConfigError, match="--geoid-separation"):
        _convert(poses, tmp_path / "x", "--from", "poses", "--to", "photos", "--heights", "amsl",
                 *PLACE)  # fmt: skip


@pytest.mark.parametrize(
    ("separation", "named"),
    [("nan", "give a finite number"), ("-4000", "no such separation occurs on Earth")],
)
def test_a_geoid_separation_that_is_none_is_refused(poses, tmp_path, separation, named):
    heights = ("--heights", "amsl", "--geoid-separation", separation, *PLACE)
    with pytest.raises(ConfigError, match=named):
        _convert(poses, tmp_path / "x", "--from", "poses", "--to", "photos", *heights)
    assert not (tmp_path / "x").exists()


_LOOKS_EAST = {"GimbalRollDegree": "+0.00", "GimbalPitchDegree": "-60.00",
               "GimbalYawDegree": "+90.00"}  # fmt: skip


def test_a_photos_own_tags(tmp_path):
    """East, 60 degrees down: the camera's axes by hand, the position from EXIF."""
    at = (-12.51, -77.005, 154.0)
    write_photo(tmp_path / "DJI_0001.JPG", dji(**_LOOKS_EAST), place=at)
    out = tmp_path / "poses.txt"
    options = ("--from", "photos", "--to", "poses", "--heights", "amsl", "--geoid-separation", 20,
               "--origin", "-12.51,-77.005,170")  # fmt: skip
    _convert(tmp_path, out, *options)
    (row,) = read_poses(out)
    assert row.name == "DJI_0001.JPG"
    assert (row.position.latitude_deg, row.position.longitude_deg) == pytest.approx(
        (-12.51, -77.005), abs=1e-8
    )
    assert row.position.height_m == pytest.approx(174.0)
    R = world_from_camera(row, LocalFrame(row.position)).rotation
    assert R[:, 2] == pytest.approx([0.5, 0, -np.sqrt(0.75)], abs=1e-6)  # forward
    assert R[:, 0] == pytest.approx([0, -1, 0], abs=1e-6)  # right is south
    assert (row.roll_deg, row.pitch_deg, row.yaw_deg) == pytest.approx((0, 30, -90), abs=1e-5)
    # XMP's own position, more digits, wins.
    own = dji(**_LOOKS_EAST, GpsLatitude="-12.5", GpsLongtitude="-77.0", AbsoluteAltitude="+9.5")
    write_photo(tmp_path / "DJI_0001.JPG", own, place=at)
    _convert(tmp_path, out, *options)
    (row,) = read_poses(out)
    assert row.position.latitude_deg == pytest.approx(-12.5)
    assert row.position.height_m == pytest.approx(29.5)


def test_a_photo_without_angles_is_named(tmp_path):
    options = ("--from", "photos", "--to", "poses", "--heights", "ellipsoidal", *PLACE)
    write_photo(tmp_path / "plain.jpg")
    with pytest.raises(PoseFileError, match=r"plain\.jpg: no gimbal angles"):
        _convert(tmp_path, tmp_path / "o", *options)
    write_photo(tmp_path / "plain.jpg", dji(GimbalYawDegree="1"))
    with pytest.raises(PoseFileError, match=r"plain\.jpg: no gimbal angles"):
        _convert(tmp_path, tmp_path / "o", *options)


PHOTOS = ("--from", "photos", "--to", "poses", "--heights", "ellipsoidal", *PLACE)


def _placed(*, yaw=12.0, pitch=-89.9, height=520.0, longitude=8.2, **more):
    return dji(GpsLatitude="47.2", GpsLongitude=longitude, AbsoluteAltitude=f"{height:+.2f}",
               GimbalRollDegree="+0.00", GimbalYawDegree=f"{yaw:+.2f}",
               GimbalPitchDegree=f"{pitch:+.2f}", **more)  # fmt: skip


def test_angles_that_were_not_measured_are_named(tmp_path):
    """Mini 2, and P1 on the M400, write 0.00 while the camera looks down."""
    for k in range(3):
        xmp = _placed(yaw=0.0, pitch=0.0) if k else _placed()
        write_photo(tmp_path / f"DJI_{k}.JPG", xmp)
    with pytest.raises(
        PoseFileError, match=r"all 0 in 2 of 3 photos, first DJI_1\.JPG: .*not meas"
    ):
        _convert(tmp_path, tmp_path / "o", *PHOTOS)
    for k in (1, 2):  # the user says where it looked
        (tmp_path / f"DJI_{k}.xmp").write_text(_placed(pitch=-90))
    _convert(tmp_path, tmp_path / "o", *PHOTOS)
    assert [row.pitch_deg for row in read_poses(tmp_path / "o")] == pytest.approx([0.1, 0, 0])


@pytest.mark.parametrize(
    "kinds",
    [
        ({"AltitudeType": "RtkAlt", "RtkFlag": 50}, {"AltitudeType": "GpsFusionAlt", "RtkFlag": 0}),
        ({"RtkFlag": 50}, {"RtkFlag": 0}),
        ({"RtkFlag": 50}, {}),
    ],
)
def test_heights_above_two_surfaces_in_one_flight_are_named(tmp_path, kinds):
    for k in range(4):
        xmp = _placed(height=(567.5, 519.8)[k // 2], **kinds[k // 2])
        write_photo(tmp_path / f"DJI_{k}.JPG", xmp, place=(47.2, 8.2, 154.0))
    with pytest.raises(PoseFileError, match=r"different surfaces .*2 photos, first DJI_2\.JPG"):
        _convert(tmp_path, tmp_path / "o", *PHOTOS)


def test_what_is_odd_about_a_flights_tags_is_told(tmp_path):
    flags = (50, 34, 50)
    for k, (height, above) in enumerate(((520, 80), (521, 81), (569, 81))):
        xmp = _placed(height=height, RtkFlag=flags[k], RelativeAltitude=f"{above:+}",
                      AltitudeType="GpsFusionAlt")  # fmt: skip
        write_photo(tmp_path / f"DJI_{k}.JPG", xmp)
    told = _convert(tmp_path, tmp_path / "o", *PHOTOS).output
    assert "RtkFlag 34, 50: not all photos have an RTK fix" in told
    assert "AltitudeType GpsFusionAlt: such heights are amsl, not ellipsoidal" in told
    assert "DJI_2.JPG: AbsoluteAltitude less RelativeAltitude steps by +48.0 m" in told
    assert "DJI_1.JPG" not in told


def test_a_photo_without_a_fix_is_named(tmp_path):
    xmp = _placed(longitude="0.0", height=0.0).replace("47.2", "0.0")
    write_photo(tmp_path / "DJI_0.JPG", xmp)
    with pytest.raises(PoseFileError, match=r"DJI_0\.JPG: .*no GNSS fix"):
        _convert(tmp_path, tmp_path / "o", *PHOTOS)


@pytest.mark.parametrize("name", ["a.jpg", "b.JPG", "a.xmp", "c.mp4", "d.DNG"])
def test_no_result_replaces_footage(tmp_path, name):
    write_photo(tmp_path / "a.jpg", _placed())
    before = (tmp_path / "a.jpg").read_bytes()
    with pytest.raises(ConfigError, match="footage file's name"):
        _convert(tmp_path, tmp_path / name, *PHOTOS)
    assert (tmp_path / "a.jpg").read_bytes() == before


def test_no_sidecar_replaces_the_one_that_is_read(tmp_path):
    write_photo(tmp_path / "a.jpg", _placed())
    for source in (tmp_path, tmp_path / "a.jpg"):
        with pytest.raises(ReportError, match="would replace"):
            _convert(source, tmp_path, "--from", "photos", "--to", "photos",
                     "--heights", "ellipsoidal", *PLACE)  # fmt: skip


@pytest.mark.parametrize("gimbal_frame", ["heading", "earth", "body"])
def test_autopilot_angles_by_hand(tmp_path, gimbal_frame):
    """Nose east, rolled 10 degrees right, a gimbal 30 degrees down: three meanings of one row."""
    values = ["x.jpg", "5", "47.3", "8.5", "500", "10", "0", "90", "0", "-30", "0", gimbal_frame]
    with (tmp_path / "a.csv").open("w", newline="") as file:
        csv.writer(file).writerows([AUTOPILOT_COLUMNS, values])
    _convert(tmp_path / "a.csv", tmp_path / "p", "--from", "autopilot", "--to", "poses", *PLACE)
    (row,) = read_poses(tmp_path / "p")
    forward = world_from_camera(row, FRAME).rotation[:, 2]
    level, down = np.cos(np.radians(30)), np.sin(np.radians(30))
    tilt = np.radians(10)
    expected = {
        "heading": [level, 0, -down],  # the horizon's pitch, the body's heading
        "earth": [0, level, -down],  # north
        # Rolled right, the body's down points to its left, which is north of a nose to the east.
        "body": [level, down * np.sin(tilt), -down * np.cos(tilt)],
    }
    assert forward == pytest.approx(expected[gimbal_frame], abs=1e-6)


def test_colmap_by_hand(tmp_path):
    """A camera 100 m above the origin that looks down, its top to the north; points stand below."""
    (tmp_path / "images.txt").write_text(
        "# Image list\n1 0 1 0 0 0 0 100 1 dir name.jpg\n12.5 3.5 -1 7 8 9\n"
    )
    _convert(tmp_path / "images.txt", tmp_path / "x.csv", "--from", "colmap", "--to", "autopilot",
             *PLACE)  # fmt: skip
    with (tmp_path / "x.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert row["name"] == "dir name.jpg"
    assert float(row["height_m"]) == pytest.approx(550)
    assert float(row["gimbal_pitch_deg"]) == pytest.approx(-90)
    assert float(row["yaw_deg"]) == pytest.approx(0, abs=1e-6)
    with pytest.raises(PoseFileError, match="cannot hold the name"):
        _convert(tmp_path / "images.txt", tmp_path / "p", "--from", "colmap", "--to", "poses",
                 *PLACE)  # fmt: skip


@pytest.mark.parametrize("points", ["", "\n", "1.5 2 -1 3 4 17\n"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_colmap_with_and_without_its_lines_of_points(tmp_path, points, mark):
    """Known poses that are written by hand often have one line an image."""
    head = f"{mark}# Number of images: 6, mean observations per image: 0\n"
    lines = [f"{k} 0 1 0 0 {-10 * k} {5 * k} 100 1 DJI {k}.JPG\n{points}" for k in range(1, 7)]
    (tmp_path / "images.txt").write_text(head + "".join(lines), encoding="utf-8")
    out = tmp_path / "o.csv"
    options = ("--from", "colmap", "--to", "autopilot", *PLACE)
    _convert(tmp_path / "images.txt", out, *options)
    with out.open() as file:
        rows = list(csv.DictReader(file))
    assert [row["name"] for row in rows] == [f"DJI {k}.JPG" for k in range(1, 7)]
    east_m = [FRAME.enu_from_geodetic(float(r["latitude_deg"]), float(r["longitude_deg"]),
                                      float(r["height_m"]))[0] for r in rows]  # fmt: skip
    assert east_m == pytest.approx([10 * k for k in range(1, 7)], abs=1e-3)
    (tmp_path / "images.txt").write_text(head.replace("6", "7") + "".join(lines), "utf-8")
    with pytest.raises(PoseFileError, match="says 7 images, holds 6"):
        _convert(tmp_path / "images.txt", out, *options)


def test_a_flights_record_becomes_a_trajectory(tmp_path):
    record = tmp_path / "record"
    record.mkdir()
    q = quaternion_from_matrix(world_from_camera(ROWS[0], FRAME).rotation)
    with (record / "estimates.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, ESTIMATE_COLUMNS, restval="0")
        writer.writeheader()
        for k, accepted in enumerate("101"):
            pose = dict(zip(("qw", "qx", "qy", "qz"), q, strict=True))
            writer.writerow(pose | {"exposure_time_ns": 10**9 + k, "sequence": k, "east_m": k,
                                    "latency_ms": 50, "focal_px": 500,
                                    "accepted": accepted})  # fmt: skip
    _convert(record, tmp_path / "x.tum", "--from", "record", "--to", "tum")
    lines = np.loadtxt(tmp_path / "x.tum")
    assert lines[:, 1] == pytest.approx([0, 2])  # the rejected one is none
    assert lines[:, 4:] == pytest.approx(np.tile(q[[1, 2, 3, 0]], (2, 1)), abs=1e-8)


@pytest.mark.parametrize(
    ("of", "text"),
    [
        ("tum", "1 2 3\n"), ("tum", "1 0 0 0 0 0 0 0\n"), ("tum", "x 0 0 0 0 0 0 1\n"),
        ("tum", "inf 0 0 0 0 0 0 1\n"), ("tum", "# nothing\n"),
        ("colmap", "1 1 0 0 0 0 0 1 a.jpg\n"), ("colmap", "1 2 0 0 0 0 0 0 1 a.jpg\n\n"),
        ("colmap", "\n"), ("autopilot", "name,time_ns\na,1\n"), ("autopilot", "name\n"),
        ("autopilot", "x" * 200_000), ("poses", "a 1 2 3\n"), ("record", "exposure_time_ns,seq"),
    ],
)  # fmt: skip
def test_what_is_no_pose_is_named_with_its_file(tmp_path, of, text):
    (tmp_path / "bad").write_text(text)
    with pytest.raises(PoseFileError, match="bad"):
        _convert(tmp_path / "bad", tmp_path / "o", "--from", of, "--to", "colmap", *PLACE)


def test_a_gimbal_straight_down_keeps_its_heading():
    for yaw in (-170.0, 0.0, 33.0, 179.0):
        angles = angles_of_matrix(matrix_from_euler(0.0, -np.pi / 2, np.radians(yaw)))
        assert angles == pytest.approx((0.0, -90.0, yaw))
        level, down = (0.0, 0.0, 0.0), (0.0, -90.0, yaw)
        pose = pose_of_autopilot(AutopilotAngles("", None, ORIGIN, level, down), FRAME)
        assert gimbal_of_pose(pose, FRAME)[2] == pytest.approx(yaw)


def test_a_map_or_an_origin_is_needed(poses, tmp_path):
    with pytest.raises(ConfigError, match="give --map or --origin"):
        _convert(poses, tmp_path / "x", "--from", "poses", "--to", "colmap")
    with pytest.raises(ConfigError, match="either --map or --origin"):
        _convert(poses, tmp_path / "x", "--from", "poses", "--to", "colmap", "--map", tmp_path,
                 *PLACE)  # fmt: skip
