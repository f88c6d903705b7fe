"""``companion try`` on photos of a generated world whose tags are wrong by known amounts."""

import csv
import json
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from companion.cli.commands import app
from companion.config import load_config
from companion.convert.angles import gimbal_of_pose
from companion.errors import FootageError, ReportError
from companion.recorded.flight import CameraGuess, LogBeside, RecordedFlight
from companion.recorded.footage import FootageOptions, read_footage
from companion.trial.deployment import write_trial_deployment
from companion.trial.localize import FrameLocalizer, Localized, height_bands, likely_height
from companion.trial.priors import priors_of
from companion.trial.result import Trial
from companion.trial.run import evenly_spread, localize_each, localize_from_telemetry
from localizer.config import LocalizerConfig
from localizer.geometry.camera import Camera
from localizer.geometry.geo import LocalFrame
from localizer.geometry.pose import Pose, so3_exp
from localizer.geometry.trajectory import read_poses, world_from_camera
from localizer.map.cache.cache import TileCache
from localizer.relocalization.relocalizer import Relocalizer
from localizer.tracking.opening import MapStack, build_localizer
from tests.companion.recorded.photos import dji, write_photo

_EAST_M, _UP_DEG, _FOCAL_35 = 5.0, 4.0, 0xA405
_FRAMES = 5


def _photos(folder, sequence, frame: LocalFrame, camera: Camera):
    """JPEGs with DJI's tags: GNSS 5 m west of the map, the gimbal 4 degrees below the truth."""
    folder.mkdir()
    rows = read_poses(sequence / "poses.txt")
    for row in [rows[int(k)] for k in np.linspace(0, len(rows) - 1, _FRAMES)]:
        pose = world_from_camera(row, frame)
        told = frame.position(pose.translation - [_EAST_M, 0.0, 0.0])
        down = so3_exp([-np.radians(_UP_DEG), 0.0, 0.0])  # about the image's right
        roll, pitch, yaw = gimbal_of_pose(Pose(pose.rotation @ down, pose.translation), frame)
        xmp = dji(GpsLatitude=told.latitude_deg, GpsLongitude=told.longitude_deg,
                  AbsoluteAltitude=told.height_m, AltitudeType="RtkAlt",
                  GimbalRollDegree=roll, GimbalPitchDegree=pitch,
                  GimbalYawDegree=yaw)  # fmt: skip
        pixels = np.asarray(Image.open(sequence / "images" / row.name).convert("RGB"))
        focal = camera.fx * 43.267 / np.hypot(camera.width, camera.height)
        name = row.name.rsplit(".", 1)[0] + ".jpg"
        write_photo(folder / name, xmp, pixels=pixels, exif={_FOCAL_35: round(focal, 3)})
    return folder


def _run(*arguments):
    return CliRunner().invoke(app, ["try", *map(str, arguments)])


def test_photos_tell_what_is_wrong_with_their_tags(small_assets, small_sequence, tmp_path):
    frame = TileCache.open(small_assets.map_cache).frame
    camera = Camera.from_json(small_sequence / "camera.json")
    photos = _photos(tmp_path / "photos", small_sequence, frame, camera)
    report = tmp_path / "report"
    result = _run(photos, "--map", small_assets.map_cache, "--report", report, "--searches", 1,
                  "--camera", small_sequence / "camera.json")  # fmt: skip
    figures = json.loads((report / "trial.json").read_text())
    assert figures["accepted"] >= _FRAMES - 1, result.output
    assert figures["found_elsewhere"] == 0
    assert result.exit_code == 0, result.output
    estimated = figures["estimated"]
    assert estimated["mount_deg"][1] == pytest.approx(_UP_DEG, abs=1.0)
    assert estimated["shift_m"][:2] == pytest.approx([_EAST_M, 0.0], abs=1.5)
    assert "Vision works here" in result.output
    page = (report / "report.html").read_text()
    assert "Vision works here" in page
    assert "Estimated camera and map" in page
    assert "looks further up (ahead) than recorded" in page
    with (report / "frames.csv").open(newline="") as file:
        searched = [r["without_position"] for r in csv.DictReader(file) if r["without_position"]]
    assert searched.count("found") == figures["found"]
    assert len(searched) == figures["searched"] == 1
    config = load_config(report / "deployment.yaml")
    assert config.bridge.camera.mount == "gimbal"
    assert config.bridge.camera.mount_pitch_deg == pytest.approx(_UP_DEG, abs=1.0)


@pytest.mark.parametrize(("pitch_deg", "mount"), [(-60.0, "fixed"), (None, "gimbal")])
def test_a_camera_without_a_gimbal_is_written_as_fixed(small_assets, tmp_path, pitch_deg, mount):
    """With the log's attitude its view is as good as measured: the file said gimbal."""
    log = LogBeside(tmp_path / "a.bin", 0, pitch_deg)
    guess = CameraGuess(Camera.from_fov(320, 240, 65.0), 1.0, "--fov")
    trial = Trial(RecordedFlight("a", "video", (), guess, (), log), (), (), (), {}, None, (), ())
    file = write_trial_deployment(tmp_path / "deployment.yaml", trial, small_assets.map_cache)
    camera = load_config(file).bridge.camera
    assert camera.mount == mount
    assert camera.mount_pitch_deg == pytest.approx(pitch_deg or 0.0)
    write_trial_deployment(file, trial, small_assets.map_cache)  # its own file may be replaced
    file.write_text(edited := file.read_text().replace("5600", "5601"))
    with pytest.raises(ReportError, match="changed by hand"):
        write_trial_deployment(file, trial, small_assets.map_cache)
    told = _run(tmp_path, "--report", tmp_path)
    assert isinstance(told.exception, ReportError)  # before anything is computed
    assert file.read_text() == edited


def test_no_photo_fails_because_the_one_before_failed(small_assets, small_sequence, tmp_path):
    """Each photo's result is the same alone, in another order, and after photos that show
    nothing.
    """
    config = LocalizerConfig()
    stack = MapStack(small_assets.map_cache, config)
    camera = Camera.from_json(small_sequence / "camera.json")
    flight = read_footage(
        _photos(tmp_path / "photos", small_sequence, stack.cache.frame, camera),
        FootageOptions(tmp_path, camera=small_sequence / "camera.json"),
    )
    priors = priors_of(flight, stack.cache).priors
    good = list(zip(flight.frames, priors, strict=True))[:3]
    Image.new("RGB", (camera.width, camera.height)).save(tmp_path / "black.png")
    black = [(replace(frame, path=tmp_path / "black.png"), prior) for frame, prior in good]

    def localized(shots):
        def no_search() -> Relocalizer:
            raise AssertionError("every prior is complete")

        loader = FrameLocalizer(build_localizer(stack, camera, config), no_search, camera)
        return [loader.from_prior(frame, prior) for frame, prior in shots]

    alone = [localized([shot])[0] for shot in good]
    assert all(one.accepted for one in alone)
    backwards = localized(good[::-1])[::-1]
    mixed = localized([shot for pair in zip(black, good, strict=True) for shot in (*pair,)])
    assert not any(one.accepted for one in mixed[::2])
    for other in (backwards, mixed[1::2]):
        for one, same in zip(other, alone, strict=True):
            assert one.accepted
            assert one.pose.distance_to(same.pose)[0] < 1e-6
            assert one.quality == pytest.approx(same.quality, abs=0.01)
    stack.close()


def _silent(_what):
    return nullcontext(lambda _done, _total: None)


class _Finds(FrameLocalizer):
    """Localizes these of the frames that it is asked for, counted from 1, and remembers all."""

    def __init__(self, found):
        self.asked, self._found_ones = [], found

    def from_prior(self, recorded, prior):
        self.asked.append(int(recorded.name[:2]))
        return Localized(recorded.name, None, accepted=len(self.asked) in self._found_ones)


@pytest.mark.parametrize(("found", "tried"), [((), 6), ((6,), 24), ((7,), 6), (range(99), 24)])
def test_of_many_photos_that_need_a_search_a_sample_stands_for_all(
    small_assets, tmp_path, found, tried
):
    """They took longer than ten minutes where none could be found: 24 of up to 40 s each."""
    cache = TileCache.open(small_assets.map_cache)
    middle = cache.frame.position(np.zeros(3))
    for k in range(90):
        view = {} if k % 2 else {"GimbalRollDegree": 1, "GimbalPitchDegree": -89,
                                 "GimbalYawDegree": 5}  # fmt: skip
        xmp = dji(GpsLatitude=middle.latitude_deg, GpsLongitude=middle.longitude_deg + 1e-6 * k,
                  RelativeAltitude=60, **view)  # fmt: skip
        write_photo(tmp_path / f"{k:02d}.jpg", xmp, exif={_FOCAL_35: 24})
    flight = read_footage(tmp_path, FootageOptions(tmp_path, fov_deg=65.0))
    loader = _Finds(found)
    kept, known, first = localize_from_telemetry(flight, priors_of(flight, cache), loader, _silent)
    names = [int(frame.name[:2]) for frame in kept.frames]
    assert [k for k in names if not k % 2] == list(range(0, 90, 2))  # their heading is known
    odd = [k for k in names if k % 2]
    assert len(odd) == tried
    assert np.diff([0, *odd, 90]).max() <= 2 * 90 / tried  # spread over the flight
    assert sorted(loader.asked) == names
    assert [one.name for one in first] == [frame.name for frame in kept.frames]
    assert len(known.priors) == len(names)
    (note,) = [n for n in known.notes if "stand for all" in n]
    assert f"{tried} of them" in note
    assert f"{45 - tried} are not tried" in note
    assert ("none of them is found" in note) == (tried == 6)


def test_searches_end_where_none_of_the_first_finds_anything():
    chosen = evenly_spread(range(100), 20)

    def count(found, searched=chosen):
        return len(localize_each(chosen, searched, lambda k: Localized(str(k), None, accepted=k in
                                 found), _silent("")))  # fmt: skip

    assert count(()) == 6
    assert count((), ()) == 20
    assert count(range(100)) == 20
    assert count({chosen[5]}) == 20
    assert count({chosen[6]}) == 6


@pytest.fixture
def prior(small_assets, tmp_path):
    """Of a photo whose height is not known."""
    cache = TileCache.open(small_assets.map_cache)
    middle = cache.frame.position(np.zeros(3))
    write_photo(tmp_path / "a.jpg", place=(middle.latitude_deg, middle.longitude_deg, 0.0))
    flight = read_footage(tmp_path, FootageOptions(tmp_path, fov_deg=65.0))
    return priors_of(flight, cache).priors[0]


def test_an_unknown_height_is_searched_from_middles_near_any_true_one(prior):
    """From 82 m, the middle of the whole range, no photo that was taken at 49 m was found."""
    assert not prior.height_known
    ground = prior.height_m - prior.clearance_m
    bands = [(z - ground, sigma) for z, sigma in height_bands(prior)]
    for true in (15.5, 30.0, 49.0, 100.0, 149.0):
        ((height, _),) = [(h, s) for h, s in bands if abs(h - true) <= s]
        assert 2 / 3 < height / true < 3 / 2
    low = replace(prior, height_m=ground + 20.0, clearance_m=20.0, height_sigma_m=25.0)
    assert [round(z - s - ground, 1) for z, s in height_bands(low)] == [3.0, 5.9, 11.6, 22.9]


@pytest.mark.parametrize(
    ("found", "likely"),
    [((), None), ((31,), None), ((31, 50), None), ((31, 50, 49), 49), ((50, 49, 31), 49)],
)
def test_one_photo_of_the_climb_does_not_set_the_height_of_a_flight(prior, found, likely):
    """With the height of the first photo found, 11 of 12 real ones 20 m above it were lost."""
    ground = prior.height_m - prior.clearance_m
    bands = likely_height(prior, [ground + height for height in found])
    assert [round(z - ground) for z, _ in bands] == ([likely] if likely else [])
    assert all(5.0 <= sigma < 10.0 for _, sigma in bands)


def test_without_a_map_the_needed_one_is_named(tmp_path):
    for told, ground in (
        ({}, ""),
        ({"AbsoluteAltitude": "+316.2"}, "256 m above the sea"),
        ({"AbsoluteAltitude": "+316.2", "AltitudeType": "RtkAlt"}, "256 m above the ellipsoid"),
    ):
        xmp = dji(GpsLatitude=47.3, GpsLongitude=8.5, RelativeAltitude="+60.0", **told)
        photo = write_photo(tmp_path / "a.jpg", xmp, exif={_FOCAL_35: 24})
        result = _run(photo, "--report", tmp_path / "r")
        assert result.exit_code == 1
        assert "needs a map of latitude" in result.output
        assert "companion map fetch --rectangle" in result.output
        assert ("--flat-ground 256 --vertical-datum" in result.output) == bool(ground)
        assert ground in result.output


def test_without_map_and_position_the_file_of_other_photos_is_named(tmp_path):
    write_photo(tmp_path / "a.jpg", exif={_FOCAL_35: 24})
    (tmp_path / "places.csv").write_text("name,lat,lon\nb.jpg,47.0,8.0\n")
    result = _run(tmp_path, "--report", tmp_path / "r")
    assert "not used: places.csv names none of the photos" in result.output
    assert isinstance(result.exception, FootageError)
