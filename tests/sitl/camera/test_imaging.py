"""The fast appearance against the general one that it stands for."""

from __future__ import annotations

import itertools
import socket
from dataclasses import replace

import cv2
import numpy as np
import pytest

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose, so3_exp, so3_log
from localizer.synth.appearance.model import Appearance, apply_appearance, sample_appearance
from sitl.camera.faults import PictureFault, VideoFaultInjector
from sitl.camera.realism import CameraClock, CameraRealism, Vibration
from sitl.camera.stream import LossyLink
from sitl.camera.world_camera import RenderedLens, Sensor, row_motion


def _scene(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    rgb = cv2.resize(rng.integers(0, 256, (15, 20, 3), np.uint8), (160, 120))
    depth = np.linspace(60, 900, 120 * 160, dtype=np.float32).reshape(120, 160)
    depth[:10] = 0  # sky
    return rgb, depth


def _appearances() -> list[Appearance]:
    rng = np.random.default_rng(7)
    drawn = [sample_appearance(rng, name) for name in ("day", "day", "dusk", "fog")]
    return [Appearance(), *drawn]


@pytest.mark.parametrize("index", range(5))
def test_without_noise_the_fast_path_is_the_general_one(index: int) -> None:
    quiet = replace(
        _appearances()[index], shot_noise=0.0, read_noise=0.0, motion_blur_px=0.0, jpeg_quality=100
    )
    rgb, depth = _scene(index)
    expected = apply_appearance(rgb, depth, quiet, np.random.default_rng(0))
    result = Sensor(quiet).apply(rgb, depth, 0.0, 0.0)
    assert np.abs(result.astype(int) - expected).max() <= 2
    assert np.abs(result.astype(int) - expected).mean() < 0.1


def test_the_noise_has_the_general_ones_strength_and_differs_between_frames() -> None:
    noisy = Appearance(shot_noise=0.04, read_noise=0.02)
    sensor = Sensor(noisy, seed=3)
    depth = np.full((120, 160), 100, np.float32)
    for level in (20, 128, 220):
        rgb = np.full((120, 160, 3), level, np.uint8)
        expected = apply_appearance(rgb, depth, noisy, np.random.default_rng(0)).std()
        first, second = (sensor.apply(rgb, depth, 0.0, 0.0) for _ in range(2))
        assert first.std() == pytest.approx(expected, rel=0.05)
        correlation = np.corrcoef(first.ravel(), second.ravel())[0, 1]
        assert abs(correlation) < 0.05


@pytest.mark.parametrize("condition", ["rain", "snow"])
def test_weather_that_is_drawn_goes_through_the_general_function(condition: str) -> None:
    drawn = sample_appearance(np.random.default_rng(2), condition)
    quiet = replace(drawn, shot_noise=0.0, read_noise=0.0, jpeg_quality=100)
    rgb, depth = _scene()
    result = Sensor(quiet, seed=5).apply(rgb, depth, 0.0, 0.0)
    without = replace(quiet, rain_streaks=0, snow_flakes=0, snow_cover=0.0)
    bare = Sensor(without, seed=5).apply(rgb, depth, 0.0, 0.0)
    assert np.abs(result.astype(int) - bare).max() > 10  # dim rain is 20, snow 60


# --- realism ------------------------------------------------------------------------------------


CAMERA = Camera(320, 240, 260.0, 260.0, 160.0, 120.0, (-0.08, 0.02, 0.0, 0.0, 0.0))


def _picture(camera: Camera, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
    """A smooth pattern on the plane z = 0, seen by a pinhole; and its depth."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = pose.rotation @ camera.rays(np.stack([u, v], -1)).reshape(-1, 3).T
    depth = -pose.translation[2] / rays[2]
    x, y = pose.translation[:2, None] + rays[:2] * depth
    value = 127 + 60 * np.sin(x / 2.1) + 60 * np.sin(y / 1.7 + x / 5)
    rgb = np.repeat(value.reshape(camera.height, camera.width, 1), 3, 2).astype(np.uint8)
    return rgb, depth.reshape(camera.height, camera.width).astype(np.float32)


@pytest.mark.parametrize("supersample", [1.0, 2.0])
def test_every_row_shows_the_world_as_it_was_at_its_own_time(supersample: float) -> None:
    middle = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 60.0]))

    def pose_of_row(row: float) -> Pose:
        share = (row - 120.0) / 240.0
        turn = so3_exp([0.0, np.radians(0.8) * share, np.radians(0.5) * share])
        return Pose(middle.rotation @ turn, middle.translation + np.array([0.4 * share, 0.0, 0.1]))

    lens = RenderedLens.of(CAMERA, supersample, is_rolling=True)
    rgb, depth = _picture(lens.pinhole, middle)
    rolled, still = lens.roll(rgb, depth, row_motion(middle, pose_of_row, CAMERA.height))
    flat = RenderedLens.of(CAMERA, supersample)
    for row in (20, 120, 220):
        wanted = flat.distort(_picture(flat.pinhole, pose_of_row(row))[0])[row].astype(int)
        inside = np.s_[12:-12]
        assert np.abs(rolled[row].astype(int) - wanted)[inside].mean() < 1.5
    unrolled = flat.distort(_picture(flat.pinhole, middle)[0]).astype(int)
    assert np.abs(rolled.astype(int) - unrolled)[[20, 220]].mean() > 8.0
    assert still.shape == (240, 320)


def test_vibration_is_as_strong_as_said_and_a_function_of_time() -> None:
    vibration, pose = Vibration(0.05, seed=2), Pose.identity()
    times = np.arange(0, 4_000_000_000, 1_300_000)
    turns = np.degrees([so3_log(vibration.vibrating(pose, int(t)).rotation) for t in times])
    np.testing.assert_allclose(np.sqrt((turns**2).mean(axis=0)), 0.05, rtol=0.1)
    again = Vibration(0.05, seed=2).vibrating(pose, int(times[77]))
    np.testing.assert_array_equal(
        again.rotation, vibration.vibrating(pose, int(times[77])).rotation
    )
    assert Vibration(0.0, seed=2).vibrating(pose, 5) is pose


def test_stamps_are_off_by_what_was_drawn_and_never_run_backwards() -> None:
    stamps = CameraClock(CameraRealism(stamp_offset_ms=4.0, stamp_jitter_ms=2.0), seed=1)
    true = np.arange(0, 60_000_000_000, 100_000_000)
    late_ms = (np.array([stamps.of(int(t)) for t in true]) - true) * 1e-6
    assert late_ms.mean() == pytest.approx(4.0, abs=0.3)
    assert late_ms.std() == pytest.approx(2.0, rel=0.1)
    rough = CameraClock(CameraRealism(stamp_jitter_ms=50.0), seed=1)
    fast = [rough.of(t) for t in range(0, 10_000_000, 10_000)]
    assert all(b > a for a, b in itertools.pairwise(fast))
    assert CameraClock(CameraRealism(), seed=1).of(123) == 123


def test_exposure_follows_the_scene_and_the_noise_the_gain() -> None:
    dark = Sensor(Appearance(exposure=0.3, read_noise=0.01), seed=1, auto_exposure=True)
    fixed = Sensor(Appearance(exposure=0.3, read_noise=0.01), seed=1)
    rgb, depth = np.full((120, 160, 3), 110, np.uint8), np.full((120, 160), 50.0, np.float32)
    levels = [dark.apply(rgb, depth, 0.0, 0.0) for _ in range(20)]
    plain = fixed.apply(rgb, depth, 0.0, 0.0)
    assert levels[0].mean() == pytest.approx(plain.mean(), abs=1)
    assert levels[-1].mean() == pytest.approx(0.42 * 255, rel=0.1)
    assert np.all(np.diff([x.mean() for x in levels]) > -1.0)
    assert levels[-1].std() > 2 * plain.std()


def test_a_lossy_link_loses_its_share_and_sends_the_rest_in_whole_datagrams() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(0.0)
        link = LossyLink(f"udp://127.0.0.1:{receiver.getsockname()[1]}", 0.25, seed=3)
        got: list[bytes] = []
        for _ in range(150):
            assert link.write(b"G" * 188 * 10) == 1880
            for _ in range(2):
                try:
                    got.append(receiver.recv(4000))
                except BlockingIOError:
                    break
        link.close()
    assert {len(d) for d in got} == {1316, 564}
    assert link.lost + len(got) == 300
    assert link.lost == pytest.approx(75, abs=25)
    with pytest.raises(ValueError, match="udp://host:port"):
        LossyLink("rtsp://a/b", 0.1)


# --- What a faulty lens sends instead of the picture --------------------------------------------


def picture(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (24, 32, 3)).astype(np.uint8)


def test_a_frozen_picture_stays_the_last_good_one_until_it_ends() -> None:
    lens = VideoFaultInjector(0)
    first = lens.apply(picture(1), 0)
    lens.set(PictureFault("frozen"))
    assert np.array_equal(lens.apply(picture(2), 0), first)
    assert np.array_equal(lens.apply(picture(3), 0), first)
    lens.set(None)
    assert np.array_equal(lens.apply(picture(4), 0), picture(4))


@pytest.mark.parametrize(("kind", "low", "high"), [("covered", 0, 30), ("blinded", 190, 220)])
def test_a_covered_or_blinded_camera_shows_nothing(kind: str, low: int, high: int) -> None:
    lens = VideoFaultInjector(0)
    lens.set(PictureFault(kind))  # type: ignore[arg-type]
    shown = lens.apply(picture(1), 0)
    assert low <= shown.mean() <= high
    assert shown.std() < 8


def test_late_pictures_are_stamped_as_they_are_sent() -> None:
    lens = VideoFaultInjector(1)
    assert lens.delay_ns == 0
    lens.set(PictureFault("late", 0.3))
    assert (lens.delay_ns, lens.stamp(1_000_000_000)) == (300_000_000, 1_300_000_000)
    lens.set(None)
    assert (lens.delay_ns, lens.stamp(1_000_000_000)) == (0, 1_000_000_000)


def test_late_stamps_move_the_time_alone() -> None:
    lens = VideoFaultInjector(0)
    lens.set(PictureFault("stamped_late", 0.3))
    assert lens.stamp(1_000_000_000) == 1_300_000_000
    assert np.array_equal(lens.apply(picture(1), 0), picture(1))
    lens.set(PictureFault("silent"))
    assert lens.is_silent


def test_the_light_halves_and_the_gain_gives_out() -> None:
    lens = VideoFaultInjector(0)
    lens.set(PictureFault("darkens", 2.0))
    shown = [lens.apply(picture(1), k * 2_000_000_000).astype(float) for k in range(15)]
    means = [image.mean() for image in shown]
    assert means[4] == pytest.approx(means[0], rel=0.05)  # a gain of 16
    assert means[10] < means[4] / 4
    noise = [np.std(image - shown[0]) for image in shown[:5]]
    assert noise == sorted(noise)
