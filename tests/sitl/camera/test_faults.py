"""What a faulty lens sends instead of the picture."""

from __future__ import annotations

import numpy as np
import pytest

from sitl.camera.faults import PictureFault, VideoFaultInjector


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
