"""Pictures that stand still or come again, whatever is done to them, and those that do not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from companion.integrity_monitor.video import (
    FrameVerdict,
    FrozenVideoDetector,
    detail,
    thumbnail,
)
from localizer.types import Image

HZ = 10
WIDTH, HEIGHT = 320, 240


def scene(seed: int = 0) -> Image:
    """A ground with structure of every size, larger than a picture."""
    rng = np.random.default_rng(seed)
    ground = np.zeros((800, 1000), np.float32)
    for size in (3, 12, 50, 200):
        noise = rng.standard_normal((800 // size + 2, 1000 // size + 2)).astype(np.float32)
        ground += cv2.resize(noise, (1000, 800), interpolation=cv2.INTER_CUBIC)
    gray = np.clip(128 + 25 * ground, 0, 255)
    return np.repeat(gray[..., None], 3, axis=2).astype(np.uint8)


class Camera:
    """Looks at a scene from a place (pixels), with noise, a gain, and an encoder's quality."""

    def __init__(self, ground: Image, noise: float = 2.0, quality: int = 100) -> None:
        self._ground, self._quality = ground, quality
        rng = np.random.default_rng(1)
        self._fields = [
            noise * rng.standard_normal((HEIGHT, WIDTH, 3), np.float32) for _ in range(7)
        ]
        self._count = 0

    def look(self, x: float, y: float, gain: float = 1.0) -> Image:
        """One picture."""
        M = np.array([[1.0, 0.0, -150.0 - x], [0.0, 1.0, -150.0 - y]])
        view = cv2.warpAffine(self._ground, M, (WIDTH, HEIGHT)).astype(np.float32) * gain
        self._count += 1
        noise = np.roll(self._fields[self._count % 7], self._count, axis=1)
        picture = np.clip(view + noise, 0, 255).astype(np.uint8)
        if self._quality == 100:
            return picture
        _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, self._quality])
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def watch(pictures: list[Image]) -> list[FrameVerdict]:
    """What is said of pictures at 10 Hz."""
    watcher = FrozenVideoDetector()
    return [watcher.add(k * 1_000_000_000 // HZ, picture) for k, picture in enumerate(pictures)]


def sway(k: int) -> tuple[float, float]:
    """A hover from 60 m: 0.1 m is a pixel."""
    return 3.0 * np.sin(k / 23.0) + 0.8 * np.sin(k / 7.0), 2.0 * np.cos(k / 19.0)


@pytest.mark.parametrize(("noise", "quality"), [(0.0, 100), (2.0, 100), (1.0, 70), (6.0, 90)])
def test_a_hover_never_stands_still(noise: float, quality: int) -> None:
    """With a sensor's noise and an encoder's error, and without."""
    camera = Camera(scene(), noise, quality)
    verdicts = watch([camera.look(*sway(k)) for k in range(50)])
    assert max(v.still_s for v in verdicts) < 2.0
    assert max(v.identical_s for v in verdicts) == 0.0
    assert max(v.repeat_lag_s for v in verdicts) == 0.0


@pytest.mark.parametrize(("noise", "quality"), [(0.0, 100), (2.0, 100), (1.0, 70), (4.0, 90)])
def test_a_frozen_picture_stands_still_however_it_is_encoded_again(noise, quality):
    """Fresh noise and a fresh encoding do not move edges; neither does another exposure."""
    camera = Camera(scene(), noise, quality)
    moving = [camera.look(*sway(k)) for k in range(20)]
    held = [camera.look(*sway(20), gain=1.0 + 0.001 * k) for k in range(40)]
    verdicts = watch(moving + held)
    assert verdicts[-1].still_s > 3.5


def test_the_same_picture_is_told_from_one_that_stands_still() -> None:
    """To the bit: no sensor does that."""
    camera = Camera(scene())
    held = camera.look(0.0, 0.0)
    assert watch([held] * 30)[-1].identical_s == pytest.approx(2.9)
    assert watch([camera.look(0.0, 0.0) for _ in range(30)])[-1].identical_s == 0.0


def test_what_comes_after_a_covered_lens_is_new() -> None:
    """Any picture is a covered one's times a gain: it passed for frozen, then for a loop, and right
    fixes were withheld for 13 s (the flight covered-10s, seed 1).
    """
    camera, lens = Camera(scene()), Camera(np.full((800, 1000, 3), 9, np.uint8), noise=4.0)
    places = [(1.5 * k, 0.5 * k) for k in range(80)]
    flown = [lens.look(*at) if 10 <= k < 40 else camera.look(*at) for k, at in enumerate(places)]
    verdicts = watch(flown)
    assert max(v.still_s for v in verdicts[45:]) < 0.5
    assert max(v.repeat_lag_s for v in verdicts[40:]) == 0.0


def test_a_large_frames_thumbnail_is_its_average():
    """Halving first is faster, and changes neither brightness nor detail."""
    large = cv2.resize(scene(), (1920, 1080), interpolation=cv2.INTER_LINEAR)
    noise = 4.0 * np.random.default_rng(2).standard_normal(large.shape, np.float32)
    large = np.clip(large + noise, 0, 255).astype(np.uint8)
    gray = large.astype(np.float32).mean(axis=2)
    wanted = cv2.resize(gray - gray.mean(), (64, 48), interpolation=cv2.INTER_AREA)
    found = thumbnail(large)
    assert (found - wanted).std() < 0.02 * wanted.std()
    assert detail(found) == pytest.approx(detail(wanted), rel=0.02)
