"""The localizer's examples, run as a user runs them, on a generated world."""

import re
import runpy
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from localizer.geometry.geo import LocalFrame
from localizer.geometry.trajectory import read_poses, world_from_camera
from localizer.map.cache.cache import TileCache

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
FRAMES = 6


@pytest.fixture
def run(monkeypatch, capsys):
    def example(name, *arguments):
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return example


def _about(row):
    """Some metres and degrees beside a true pose."""
    p = row.position
    return (p.latitude_deg + 4e-5, p.longitude_deg - 3e-5, p.height_m + 2,
            row.roll_deg + 1, row.pitch_deg + 2, row.yaw_deg - 3)  # fmt: skip


def test_a_photo(run, small_assets, small_sequence):
    row = read_poses(small_sequence / "poses.txt")[0]
    out = run("localize_photo.py", small_sequence / "images" / row.name, small_assets.map_cache,
              small_sequence / "camera.json", *_about(row))  # fmt: skip
    assert out.rstrip().endswith("\naccepted")
    found = [float(x) for x in re.findall(r"_(?:deg|m)=([-\d.]+)", out)]
    assert np.linalg.norm(LocalFrame(row.position).enu_from_geodetic(*found)) < 1.0


def test_a_video(run, small_assets, small_sequence, tmp_path):
    rows = read_poses(small_sequence / "poses.txt")[:FRAMES]
    video = None
    for row in rows:
        image = cv2.imread(str(small_sequence / "images" / row.name))
        if video is None:
            size = image.shape[1::-1]
            video = cv2.VideoWriter(
                str(tmp_path / "v.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 5, size
            )
        video.write(image)
    video.release()
    out = run("video_track.py", tmp_path / "v.avi", small_assets.map_cache,
              small_sequence / "camera.json", *_about(rows[0]), tmp_path / "plot.png")  # fmt: skip
    assert f"{FRAMES} frames localized" in out
    assert cv2.imread(str(tmp_path / "plot.png")) is not None
    found = np.loadtxt(tmp_path / "plot.tum")
    assert np.diff(found[:, 0]) == pytest.approx(0.2, abs=1e-3)
    frame = TileCache.open(small_assets.map_cache).frame
    truth = [world_from_camera(row, frame).translation for row in rows]
    assert np.linalg.norm(found[:, 1:4] - truth, axis=1).max() < 1.0
