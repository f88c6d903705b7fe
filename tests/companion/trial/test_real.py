"""Real photos whose tags are wrong, over real maps."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from companion.recorded.footage import FootageOptions, read_footage
from companion.trial.result import judge
from companion.trial.run import TrialOptions, run_trial
from localizer.geometry.posefile import read_poses, world_from_camera
from localizer.map.building.build import build_cache
from localizer.map.building.options import BuildOptions
from localizer.map.cache.cache import TileCache

pytestmark = pytest.mark.real


def _map(folder: Path, out: Path) -> Path:
    heights = next(f for f in (folder / "dsm.tif", folder / "ground.tif") if f.is_file())
    build_cache([heights, folder / "ortho.tif"], out, BuildOptions(vertical_datum="ellipsoidal"))
    return out


def test_the_gimbals_bias_of_photos_without_gimbal_angles(real_data, tmp_path):
    """Over a satellite picture of another year, without heights; the camera looks 9 degrees ahead
    of straight down, which no tag says.
    """
    folder = real_data("fengyuan")
    cache = _map(folder, tmp_path / "map")
    flight = read_footage(folder / "raw", FootageOptions(tmp_path))
    trial = run_trial(flight, cache, TrialOptions(searches=0))
    found = trial.estimated
    assert found is not None
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
    assert judge(trial).kind in ("works", "works partly")


@pytest.mark.long
def test_photos_without_tags_beside_a_file_of_places(real_data, tmp_path):
    """GNSS 15 m wrong, its heights useless, no heading, and a camera file that is 3 % wrong."""
    folder = real_data("caliterra")
    cache = _map(folder, tmp_path / "map")
    places = folder / "queries/sensor_prior.txt"
    flight = read_footage(folder / "queries", FootageOptions(tmp_path, places=places))
    true = flight.camera.camera
    wrong = replace(true, fx=1.03 * true.fx, fy=1.03 * true.fy)
    guess = replace(flight.camera, camera=wrong)
    trial = run_trial(replace(flight, camera=guess), cache, TrialOptions(searches=0))
    assert trial.estimated is not None
    assert trial.estimated.camera.fx == pytest.approx(true.fx, rel=0.005)
    frame = TileCache.open(cache).frame
    rows = {r.name: world_from_camera(r, frame) for r in read_poses(folder / "queries/poses.txt")}
    off = [one.pose.distance_to(rows[one.name])[0] for one in trial.second if one.accepted]
    assert len(off) >= 18
    assert np.percentile(off, 90) < 1.5
