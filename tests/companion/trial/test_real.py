"""Real footage of each kind, from its raw files: photos whose tags are wrong, over real maps, and a
log and a video whose place has no map.
"""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from companion.cli.commands import app
from companion.recorded.footage import FootageOptions, read_footage
from companion.trial.result import trial_verdict
from companion.trial.run import run_trial
from localizer.geometry.camera import Camera
from localizer.geometry.trajectory import read_poses, world_from_camera
from localizer.map.building.build import build_cache
from localizer.map.building.options import BuildOptions
from localizer.map.cache.cache import TileCache

pytestmark = pytest.mark.real
_FEW = 12  # frames


def _map(folder: Path, out: Path) -> Path:
    heights = next(f for f in (folder / "dsm.tif", folder / "ground.tif") if f.is_file())
    options = BuildOptions(vertical_datum="ellipsoidal", workers=1)
    build_cache([heights, folder / "ortho.tif"], out, options)
    return out


def test_the_gimbals_bias_of_photos_without_gimbal_angles(real_data, tmp_path):
    """Over a satellite picture of another year, without heights; the camera looks 9 degrees ahead
    of straight down, which no tag says.
    """
    folder = real_data("fengyuan")
    cache = _map(folder, tmp_path / "map")
    flight = read_footage(folder / "raw", FootageOptions(tmp_path))
    trial = run_trial(flight, cache, searches=0)
    found = trial.estimated
    assert found.mount_deg[1] == pytest.approx(9.0, abs=1.0)
    assert abs(found.mount_deg[2]) < 1.0
    assert found.camera.fx / found.camera.width == pytest.approx(709.9 / 1024, rel=0.02)
    frame = TileCache.open(cache).frame
    rows = {r.name: world_from_camera(r, frame) for r in read_poses(folder / "queries/poses.txt")}
    # The truth has the map's offset in it: corrected GNSS lies within the truth's own 2 m.
    off = [
        np.linalg.norm((p.pose.translation - rows[f.name].translation)[:2])
        for f, p in zip(flight.frames, trial.priors, strict=True)
        if p.pose is not None
    ]
    assert np.median(off) < 2.0
    assert any("exactly zero" in note for note in trial.notes)
    assert trial_verdict(trial).kind in ("works", "works partly")


@pytest.mark.long
def test_photos_without_tags_beside_a_file_of_places(real_data, tmp_path):
    """GNSS 15 m wrong, its heights useless, no heading, and a camera file that is 3 % wrong."""
    folder = real_data("caliterra")
    cache = _map(folder, tmp_path / "map")
    true = Camera.from_json(folder / "queries" / "camera.json")
    wrong = replace(true, fx=1.03 * true.fx, fy=1.03 * true.fy)
    (tmp_path / "camera.json").write_text(json.dumps(wrong.to_dict()))
    options = FootageOptions(
        tmp_path, _FEW, folder / "queries/sensor_prior.txt", camera=tmp_path / "camera.json"
    )
    flight = read_footage(folder / "queries", options)
    trial = run_trial(flight, cache, searches=0)
    assert trial.estimated.camera.fx == pytest.approx(true.fx, rel=0.005)
    frame = TileCache.open(cache).frame
    rows = {r.name: world_from_camera(r, frame) for r in read_poses(folder / "queries/poses.txt")}
    off = [one.pose.distance_to(rows[one.name])[0] for one in trial.second if one.accepted]
    assert len(off) >= 0.7 * _FEW
    assert np.percentile(off, 90) < 1.5
    assert trial_verdict(trial).kind in ("works", "works partly")


def _tried(*arguments):
    result = CliRunner().invoke(app, ["try", *map(str, arguments)])
    assert result.exit_code == 1, result.output
    assert "no map is given. It needs a map of latitude" in result.output
    return result.output


def _numbers(pattern, text):
    found = re.search(pattern, text)
    assert found is not None, text
    return [float(number) for number in found.groups()]


def test_pictures_beside_a_real_log_and_calibration(real_data, tmp_path):
    """Their clock is 0.35 s late; the calibration's corners fold; the place has no map."""
    folder = real_data("cmac")
    told = _tried(folder / "queries", "--places", folder / "queries.csv", "--log",
                  folder / "flight.tlog", "--report", tmp_path)  # fmt: skip
    assert "18 frames, 18 with a position" in told
    assert "camera by camera_picamv2_1640x1232.json without its distortion" in told
    assert _numbers(r"flight.tlog: (\S+) s by motion", told) == pytest.approx([-0.35], abs=0.1)


@pytest.mark.parametrize("clip", ["aphill_klv_10s.ts", "aphill_short.ts"])
def test_a_real_clip_with_metadata(real_data, tmp_path, clip):
    told = _tried(real_data("clips") / clip, "--frames", 5, "--report", tmp_path)
    frames, localize_from_telemetry = _numbers(r"(\d+) frames, (\d+) with a position", told)
    assert frames == localize_from_telemetry > 1
    south, north, west = _numbers(r"latitude (\S+) to (\S+), longitude (\S+) to", told)
    assert 38.0 < south < north < 38.3
    assert -77.5 < west < -77.2
