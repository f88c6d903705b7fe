"""ArduPilot's logs, and the clock of images beside them."""

import math
import sys

import cv2
import numpy as np
import pytest

from companion.errors import FootageError
from companion.recorded.autopilot_log import read_autopilot_log
from companion.recorded.clock import find_offset
from companion.recorded.flight import Datum, RecordedFrame, Telemetry
from companion.recorded.footage import FootageOptions, read_footage
from localizer.geometry.camera import Camera
from tests.companion.recorded.logs import (
    ORIGIN,
    UTC_S,
    place,
    swaying,
    write_dataflash,
    write_tlog,
    write_ulog,
)

_WRITERS = {"tlog": write_tlog, "bin": write_dataflash}


@pytest.mark.parametrize("kind", _WRITERS)
@pytest.mark.parametrize("gimbal", [None, -60.0])
def test_a_log_says_where_the_camera_was_and_looked(tmp_path, kind, gimbal):
    log = read_autopilot_log(_WRITERS[kind](tmp_path / f"flight.{kind}", swaying, 10.0, gimbal))
    at = log.track.at(round((UTC_S + 5.03) * 1e9))
    north, east, height, roll, _, yaw = swaying(5.03)
    latitude, longitude = place(north, east)
    assert at.position.latitude_deg == pytest.approx(latitude, abs=2e-6)
    assert at.position.longitude_deg == pytest.approx(longitude, abs=2e-6)
    heights = {h.datum: h.value_m for h in at.position.heights}
    assert heights[Datum.TAKEOFF] == pytest.approx(height, abs=0.1)
    assert heights[Datum.AMSL] == pytest.approx(500 + height, abs=0.1)
    axis = at.view.ned_from_camera[:, 2]
    assert log.has_gimbal == (gimbal is not None)
    if gimbal is None:  # fixed to the body, looking down: it leans with it
        expected = [math.sin(roll) * math.sin(yaw), -math.sin(roll) * math.cos(yaw), math.cos(roll)]
        assert "fixed to the airframe" in log.notes[0]
    else:  # stabilized: only the heading is the body's
        down = math.radians(gimbal)
        expected = [math.cos(down) * math.cos(yaw), math.cos(down) * math.sin(yaw), -math.sin(down)]
    np.testing.assert_allclose(axis, expected, atol=0.02)
    if kind == "bin":
        assert len(log.triggers_ns) == 3
        assert log.triggers_ns[0] == pytest.approx((UTC_S + 2.0) * 1e9, abs=2e8)


def test_a_log_of_px4_is_read_by_pyulog(tmp_path, monkeypatch):
    pytest.importorskip("pyulog")
    log = read_autopilot_log(write_ulog(tmp_path / "flight.ulg", swaying, 10.0))
    at = log.track.at(round((UTC_S + 5.03) * 1e9))
    north, east, height, roll, _, yaw = swaying(5.03)
    place_deg = at.position.latitude_deg, at.position.longitude_deg
    assert place_deg == pytest.approx(place(north, east), abs=2e-6)
    assert {h.datum: round(h.value_m) for h in at.position.heights} == {
        Datum.TAKEOFF: height, Datum.AMSL: 500 + height
    }  # fmt: skip
    expected = [math.sin(roll) * math.sin(yaw), -math.sin(roll) * math.cos(yaw), math.cos(roll)]
    np.testing.assert_allclose(at.view.ned_from_camera[:, 2], expected, atol=0.02)
    (tmp_path / "b.ulg").write_bytes(b"no log at all")
    with pytest.raises(FootageError, match="not a log that pyulog reads"):
        read_autopilot_log(tmp_path / "b.ulg")
    monkeypatch.setitem(sys.modules, "pyulog", None)
    with pytest.raises(FootageError, match=r"pip install 'pilot-companion\[ulog\]'"):
        read_autopilot_log(tmp_path / "flight.ulg")


def test_half_a_log_and_no_log_are_named(tmp_path):
    whole = write_tlog(tmp_path / "flight.tlog", swaying, 10.0).read_bytes()
    half = tmp_path / "half.tlog"
    half.write_bytes(whole[: len(whole) // 2 + 3])
    assert len(read_autopilot_log(half).track) > 20
    for name, content in (("a.tlog", b""), ("b.bin", b"no log at all"), ("c.tlog", whole[:60])):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(FootageError, match=name):
            read_autopilot_log(tmp_path / name)


def _ground(rng):
    """A texture of 600 x 600 m at 0.25 m, its middle 100 m north of the begin."""
    noise = rng.uniform(0, 255, (600, 600)).astype(np.uint8)
    return cv2.resize(noise, (2400, 2400), interpolation=cv2.INTER_CUBIC)


def _seen(ground, motion, t, camera):
    """The image of a camera fixed to the body of that motion, over flat ground."""
    north, east, height, roll, pitch, yaw = motion(t)
    (cr, sr), (cp, sp), (cy, sy) = (_cs(angle) for angle in (roll, pitch, yaw))
    Rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    Ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    Rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    # Camera axes in the body: x right, y back, z down.
    R = Rz @ Ry @ Rx @ np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]])
    K = np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])
    # Pixels of the ground to NED about the camera: column east, row south.
    to_ned = np.array([[0, -0.25, 100 + 300 - north], [0.25, 0, -300 - east], [0, 0, height]])
    H = K @ R.T @ to_ned
    return cv2.warpPerspective(ground, H, (camera.width, camera.height))


def _cs(angle):
    return math.cos(angle), math.sin(angle)


def _footage(folder, camera, offset_s, count=10):
    """Images every 0.8 s whose clock is behind the log's by so much."""
    ground, frames = _ground(np.random.default_rng(1)), []
    for k in range(count):
        t = 4.0 + 0.8 * k
        path = folder / f"{k:02d}.png"
        cv2.imwrite(str(path), _seen(ground, swaying, t, camera))
        time_ns = round((UTC_S + t - offset_s) * 1e9)
        frames.append(RecordedFrame(path.name, path, time_ns, Telemetry()))
    return frames


def test_the_clocks_offset_is_found_by_motion(tmp_path):
    camera = Camera.from_fov(480, 360, 60.0)
    frames = _footage(tmp_path, camera, 1.34)
    log = read_autopilot_log(write_dataflash(tmp_path / "flight.bin", swaying, 20.0))
    found = find_offset(frames, camera, log.track, (-3.0, 3.0))
    assert found.is_decisive
    assert found.offset_s == pytest.approx(1.34, abs=0.06)
    still = [f for f in frames for _ in (0,)][:1]
    assert find_offset(still, camera, log.track, (-3.0, 3.0)) is None


def test_photos_beside_a_log_take_its_telemetry(tmp_path):
    camera = Camera.from_fov(480, 360, 60.0)
    frames = _footage(tmp_path, camera, 0.5)
    write_dataflash(tmp_path / "flight.bin", swaying, 20.0)
    rows = "".join(f"{f.name},{ORIGIN[0]},{ORIGIN[1]},{f.time_ns / 1e9:.3f}\n" for f in frames)
    (tmp_path / "times.csv").write_text("name,latitude,longitude,utc\n" + rows)
    flight = read_footage(tmp_path, FootageOptions(tmp_path / "work", fov_deg=60.0))
    assert any("found by motion" in note and "+0.5" in note for note in flight.notes)
    north, east, *_ = swaying(4.0)
    first = flight.frames[0].telemetry.position
    assert (first.latitude_deg, first.longitude_deg) == pytest.approx(place(north, east), abs=1e-5)
    write_dataflash(tmp_path / "flight.bin", swaying, 8.0)
    flight = read_footage(tmp_path, FootageOptions(tmp_path / "work", fov_deg=60.0))
    assert any(note.startswith("flight.bin covers 6 of 10 images") for note in flight.notes)
    write_dataflash(tmp_path / "flight.bin", swaying, 2.0)
    with pytest.raises(FootageError, match="says nothing of the time of the images"):
        read_footage(tmp_path, FootageOptions(tmp_path / "work", fov_deg=60.0))
    later = rows.replace(f"{frames[0].time_ns / 1e9:.3f}"[:6], "153999")
    (tmp_path / "times.csv").write_text("name,latitude,longitude,utc\n" + later)
    with pytest.raises(FootageError, match="another day"):
        read_footage(tmp_path, FootageOptions(tmp_path / "work", fov_deg=60.0))


@pytest.mark.real
def test_a_real_flights_clock(real_data, tmp_path):
    folder = real_data("cmac")
    options = FootageOptions(
        tmp_path, places=folder / "queries.csv", log=folder / "flight.tlog", fov_deg=63.3
    )
    flight = read_footage(folder / "queries", options)
    assert flight.located == 18
    assert any("found by motion" in note for note in flight.notes)
    assert all(f.telemetry.view.nadir_angle_deg < 10.0 for f in flight.frames)
