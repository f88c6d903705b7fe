"""Long-wave infrared: what is warm when, and what a microbolometer makes of it."""

from dataclasses import replace

import numpy as np
import pytest

from localizer.synth.appearance.thermal import (
    SPAN_K,
    THERMAL_CONDITIONS,
    ThermalCover,
    ThermalDay,
    crossover_hour,
    draw_microbolometer,
    draw_thermal_day,
    film_thermal,
    level_surfaces,
)
from localizer.synth.heightfield.scene import Land, Prism, compose
from localizer.synth.heightfield.thermal import covers, thermal_scene

DAY = ThermalDay("thermal day", 13.0, 0.1, 1.0, np.radians(50), 0.0, 0.3)
GROUND = [ThermalCover.SOIL, ThermalCover.GRASS, ThermalCover.CROWN, ThermalCover.ASPHALT]
N, CELL = 128, 0.5


def at(hour: float) -> dict[ThermalCover, float]:
    return dict(zip(ThermalCover, level_surfaces(replace(DAY, hour=hour)), strict=True))


def test_surfaces_are_warm_in_the_order_that_is_known() -> None:
    noon, night = at(13.0), at(3.0)
    assert (
        noon[ThermalCover.BITUMEN]
        > noon[ThermalCover.ASPHALT]
        > noon[ThermalCover.SOIL]
        > noon[ThermalCover.GRASS]
    )
    assert (
        noon[ThermalCover.GRASS]
        > noon[ThermalCover.CROWN]
        > noon[ThermalCover.WATER]
        > noon[ThermalCover.METAL]
    )
    assert (
        night[ThermalCover.WATER]
        > night[ThermalCover.ASPHALT]
        > night[ThermalCover.CROWN]
        > night[ThermalCover.GRASS]
    )
    assert (
        night[ThermalCover.METAL]
        < min(v for k, v in night.items() if k is not ThermalCover.METAL) - 10
    )
    assert 8 < noon[ThermalCover.ASPHALT] - noon[ThermalCover.CROWN] < 25
    assert (
        at(19.0)[ThermalCover.ASPHALT] > at(7.0)[ThermalCover.ASPHALT] + 4
    )  # it holds the day's heat


def test_clouds_and_the_crossover_take_the_contrast() -> None:
    def spread(day: ThermalDay) -> float:
        return float(np.ptp(level_surfaces(day)[GROUND]))

    assert spread(replace(DAY, cloud=0.9)) < 0.8 * spread(DAY)
    for morning in (True, False):
        hour = crossover_hour(DAY, morning=morning)
        assert spread(replace(DAY, hour=hour)) < 0.55 * spread(DAY)
        assert hour < 11 if morning else hour > 16
    with pytest.raises(ValueError, match="sandstorm"):
        draw_thermal_day(np.random.default_rng(0), "sandstorm")


def made(day: ThermalDay):  # type: ignore[no-untyped-def]
    """Grass, a street, and a tower that throws a shadow."""
    albedo = np.full((N, N, 3), (0.3, 0.4, 0.18), np.float32)
    albedo[:, 100:110] = 0.3
    lasting = np.zeros((N, N), np.float32)
    lasting[:, 100:110] = 1.0
    corners = np.float32([[50, 50], [70, 50], [70, 70], [50, 70]])
    tower = Prism(corners, 20.0, 0.0, (0.2, 0.2, 0.2), (0.6, 0.6, 0.6), 3.0)
    scene = compose(Land(np.zeros((N, N), np.float32), albedo, CELL), [tower])
    rng = np.random.default_rng(1)
    lit = thermal_scene(scene, [tower], lasting, day, rng)
    kelvin = lit.mips[: N * N * 3].reshape(N, N, 3)[..., 0] * SPAN_K[day.condition]
    return kelvin, covers(scene, [tower], lasting, rng)


def test_a_place_has_slow_shadows_and_a_warm_street() -> None:
    kelvin, cover = made(DAY)
    assert (cover[:, 103:107] == ThermalCover.ASPHALT).all()
    assert cover[60, 60] == ThermalCover.BITUMEN
    assert kelvin[:, 103:107].mean() > kelvin[:, 10:40].mean() + 3
    north = kelvin[72:80, 55:65].mean(), kelvin[40:48, 55:65].mean()
    open_grass = float(np.median(kelvin[:, 5:30]))
    assert min(north) < open_grass - 2  # in shade for hours, whatever the hour is
    night, _ = made(replace(DAY, condition="thermal night", hour=2.0))
    shaded = min(night[72:80, 55:65].mean(), night[40:48, 55:65].mean())
    assert abs(shaded - np.median(night[:, 5:30])) < 2  # the grass has forgotten it


@pytest.mark.parametrize("condition", THERMAL_CONDITIONS)
def test_the_camera_is_grey_noisy_and_repeatable(condition: str) -> None:
    depth = np.full((60, 80), 100.0, np.float32)
    warmth = np.full((60, 80, 3), 120, np.uint8)
    warmth[:, 40:] = 150

    def film() -> np.ndarray:
        rng = np.random.default_rng(4)
        return film_thermal(warmth, depth, SPAN_K[condition], draw_microbolometer(rng), rng)

    image = film()
    assert image.shape == (60, 80, 3)
    assert np.array_equal(image, film())
    assert (image == image[..., :1]).all()
    assert image[:, 45:].mean() > image[:, :35].mean() + 40  # white-hot, stretched
    assert image[:, :30].std() > 0.3
