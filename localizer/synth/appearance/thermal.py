"""What a long-wave infrared camera (8 to 14 um, white-hot) sees of a surface, and what it adds.

A surface's temperature is the linear answer of a half-space to a day's heat: absorbed sun, the air
and the cold sky force it, ``1 / (exchange + inertia * sqrt(i w))`` is what it makes of each of the
day's harmonics (Price, "Thermal inertia mapping", J. Geophys. Res. 1977). So asphalt is warm in the
evening, shadows are those of the last hours, and surfaces cross each other twice a day. What is
seen is ``e T + (1 - e) T_sky``: bare metal shows the cold sky. Inertias are Oke's ("Boundary Layer
Climates", tables 2.1 and 7.4), emissivities Salisbury and D'Aria's (Remote Sens. Environ. 1992) and
Vollmer and Moellmann's ("Infrared Thermal Imaging"), what roofs and vehicles do is told by Jacobs
("Thermal Infrared Characterization of Ground Targets and Backgrounds"). Where a table gives a range
the values are in its middle; none was fitted to pictures.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array
from localizer.synth.appearance.model import motion_kernel
from localizer.types import Float32, Image

THERMAL_CONDITIONS = ("thermal day", "thermal night", "thermal crossover")
# Kelvin from black to white of a picture before its sensor: what the scene may span, in fine steps.
SPAN_K = {"thermal day": 64.0, "thermal night": 32.0, "thermal crossover": 24.0}
STEPS = 48  # of a day
_SOLAR = 1100.0  # W/m2 above the air, at the sensor's latitude and season


class ThermalCover(IntEnum):
    """Kinds of surface that heat differently; rows of `_COVERS`."""

    SOIL = 0
    GRASS = 1
    CROWN = 2
    WATER = 3
    ASPHALT = 4
    TILES = 5
    BITUMEN = 6
    METAL = 7
    CAR = 8
    WALL = 9


# emissivity; exchange with air and sky, W/(m2 K); inertia, J/(m2 K sqrt(s)); share of the absorbed
# sun that evaporates water. Leaves are well aired and hold nothing, a sward is still air over soil,
# water mixes, roofs are thin and lie on insulation.
_COVERS = np.array(
    [
        [0.95, 13, 800, 0.0], [0.97, 12, 350, 0.5], [0.98, 32, 250, 0.5], [0.985, 25, 9000, 0.3],
        [0.95, 13, 1250, 0.0], [0.93, 15, 650, 0.0], [0.93, 14, 350, 0.0], [0.35, 13, 200, 0.0],
        [0.90, 16, 250, 0.0], [0.93, 13, 1100, 0.0],
    ]
)  # fmt: skip


@dataclass(frozen=True)
class ThermalDay:
    """A day's weather, and the hour of the flight. cloud: 0 to 1. wind: factor of the exchange.
    highest: the sun's elevation at noon, radians; turn: where noon is, radians in the map.
    """

    condition: str
    hour: float
    cloud: float
    wind: float
    highest: float
    turn: float
    wet: float

    @property
    def sky_below_air_k(self) -> float:
        """How much colder than the air the sky is in this band; clouds are nearly as warm."""
        return 38.0 * (1.0 - self.cloud) + 2.0

    def sun(self, hour: float) -> tuple[float, float, float]:
        """Unit vector towards the sun, up between 6 and 18 h."""
        along = np.pi * (hour - 6.0) / 12.0
        east, south = np.cos(along), -np.sin(along) * np.cos(self.highest)
        c, s = np.cos(self.turn), np.sin(self.turn)
        up = np.sin(along) * np.sin(self.highest)
        return float(c * east - s * south), float(s * east + c * south), float(up)

    def beam(self, hour: float) -> float:
        """Direct sun on a surface that faces it, W/m2."""
        up = self.sun(hour)[2]
        if up <= 0.02:
            return 0.0
        return float(_SOLAR * 0.7 ** (1.0 / up) ** 0.678 * (1.0 - self.cloud) ** 0.8)

    def scattered(self, hour: float) -> float:
        """Light of the sky on level ground, W/m2."""
        up = max(self.sun(hour)[2], 0.0)
        return float((80.0 + 220.0 * self.cloud * (1.0 - 0.5 * self.cloud)) * up**0.5)

    def air_k(self, hour: Array) -> Array:
        """The air against its own mean: warmest at 15 h."""
        swing = 5.0 * (1.0 - 0.6 * self.cloud)
        out: Array = swing * np.cos(2 * np.pi * (np.asarray(hour) - 15.0) / 24.0)
        return out

    def answers(self) -> Array:
        """(covers, STEPS): kelvin now per W/m2 that came during each half-hour before."""
        omega = 2 * np.pi * np.arange(STEPS // 2 + 1) / 86400.0
        inertia = _COVERS[:, 2].copy()
        inertia[ThermalCover.SOIL] *= 1.0 + self.wet  # water in it stores heat
        exchange = self.exchange()[:, None]
        out: Array = np.fft.irfft(1.0 / (exchange + inertia[:, None] * np.sqrt(1j * omega)), STEPS)
        return out

    def heating(self) -> Array:
        """Of each cover: share of the absorbed sun that heats, the rest evaporates water."""
        share = _COVERS[:, 3].copy()
        share[ThermalCover.SOIL] = 0.5 * self.wet
        left: Array = 1.0 - share
        return left

    def emissivity(self) -> Array:
        """Of each cover."""
        out: Array = _COVERS[:, 0].copy()
        return out

    def exchange(self) -> Array:
        """Of each cover with the air alone, W/(m2 K)."""
        out: Array = _COVERS[:, 1] * self.wind
        return out


def draw_thermal_day(rng: np.random.Generator, condition: str) -> ThermalDay:
    """The day and hour of one of `THERMAL_CONDITIONS`."""
    if condition not in THERMAL_CONDITIONS:
        raise ValueError(f"condition {condition!r} is not one of {', '.join(THERMAL_CONDITIONS)}")
    cloud = float(rng.choice((rng.uniform(0.0, 0.3), rng.uniform(0.3, 1.0)), p=(0.6, 0.4)))
    day = ThermalDay(
        condition,
        hour=float(rng.uniform(10.0, 16.5)),
        cloud=cloud,
        wind=float(np.exp(rng.normal(0.0, 0.25))),
        highest=float(np.radians(rng.uniform(22, 66))),
        turn=float(rng.uniform(0, 2 * np.pi)),
        wet=float(rng.uniform(0.0, 1.0)),
    )
    night, morning, late = rng.uniform(21.5, 28.5), rng.random() < 0.5, rng.normal(0.0, 0.3)
    if condition == "thermal night":
        return _at(day, float(night) % 24.0)
    if condition == "thermal crossover":
        return _at(day, crossover_hour(day, morning=bool(morning)) + float(late))
    return day


def crossover_hour(day: ThermalDay, *, morning: bool) -> float:
    """When level, open grass, soil and asphalt look most alike, of the morning or the evening."""
    hours = np.arange(6.0, 11.0, 0.25) if morning else np.arange(16.5, 19.75, 0.25)
    kinds = [ThermalCover.SOIL, ThermalCover.GRASS, ThermalCover.CROWN, ThermalCover.ASPHALT]
    spread = [float(np.ptp(level_surfaces(_at(day, h))[kinds])) for h in hours]
    return float(hours[int(np.argmin(spread))])


def level_surfaces(day: ThermalDay, absorbed: float = 0.8) -> Array:
    """(covers,): apparent temperature of level, open ground of each, K against the air's mean."""
    hours = half_hours(day)
    sun = np.array([day.beam(h) * max(day.sun(h)[2], 0.0) + day.scattered(h) for h in hours])
    return day_apparent(day, absorbed * day.heating() * (day.answers() @ sun))


def half_hours(day: ThermalDay) -> Array:
    """(STEPS,): the hours before the flight, of `ThermalDay.answers`, the newest first."""
    return np.asarray((day.hour - 24.0 / STEPS * np.arange(STEPS)) % 24.0, np.float64)


def day_apparent(day: ThermalDay, by_sun: Array, open_sky: Array | float = 1.0) -> Array:
    """What is seen of each cover whose sun made it `by_sun` K warmer, (covers, ...)."""
    answers = day.answers()
    air = answers @ day.air_k(half_hours(day)) * day.exchange()
    # The sky's whole band is warmer than its window that is seen: 75 W/m2 are lost to a clear one.
    lost = 5.5 * 0.35 * day.sky_below_air_k * day.emissivity() * answers.sum(axis=1)
    shape = (-1, *(1,) * (np.ndim(by_sun) - 1))
    warmth: Array = by_sun + air.reshape(shape) - lost.reshape(shape) * open_sky
    seen_sky = float(day.air_k(np.array(day.hour))) - day.sky_below_air_k
    emissivity = day.emissivity().reshape(shape)
    out: Array = emissivity * warmth + (1 - emissivity) * seen_sky
    return out


@dataclass(frozen=True)
class Microbolometer:
    """One draw of an uncooled camera. Noise in kelvin (NETD: from frame to frame; columns: what the
    last shutter correction left), lengths in pixels. haze_per_m: of the air, whose own warmth it
    adds. gain_k: least span that its gain control stretches to the whole picture. plateau: its gain
    control equalises the histogram, as most do, else it stretches it.
    """

    noise_k: float
    columns_k: float
    shading_k: float
    blur_px: float
    smear_px: float
    smear_deg: float
    haze_per_m: float
    gain_k: float
    plateau: bool
    jpeg_quality: int


def draw_microbolometer(rng: np.random.Generator) -> Microbolometer:
    """A camera of 12 or 17 um pitch at f/1, its picture at 320 pixels width."""
    return Microbolometer(
        noise_k=float(rng.uniform(0.03, 0.08)),
        columns_k=float(rng.uniform(0.01, 0.05)),
        shading_k=float(rng.uniform(0.0, 0.4)),
        blur_px=float(rng.uniform(0.5, 1.0)),
        smear_px=float(rng.uniform(0.0, 3.0)),  # the pixel's own time constant is 8 to 12 ms
        smear_deg=float(rng.uniform(0.0, 360.0)),
        haze_per_m=float(rng.uniform(1e-4, 4e-4)),
        gain_k=float(rng.uniform(3.0, 8.0)),
        plateau=bool(rng.random() < 0.5),
        jpeg_quality=int(rng.integers(40, 96)),
    )


def film_thermal(
    warmth: Image, depth: Float32, span_k: float, sensor: Microbolometer, rng: np.random.Generator
) -> Image:
    """The camera's picture (H, W, 3), three equal channels. warmth: (H, W, 3), `span_k` kelvin from
    black to white; depth: (H, W), metres along the axis, 0 for sky.
    """
    kelvin: Float32 = warmth[..., 0].astype(np.float32) * np.float32(span_k / 255.0)
    ground = depth > 0
    air = np.float32(np.median(kelvin[ground])) if ground.any() else np.float32(0)
    clear = np.exp(-np.float32(sensor.haze_per_m) * np.where(ground, depth, np.float32(1e4)))
    kelvin = air + (kelvin - air) * clear
    kelvin = cv2.GaussianBlur(kelvin, (0, 0), sensor.blur_px)
    if sensor.smear_px > 1.0:
        kernel = motion_kernel(sensor.smear_px, sensor.smear_deg)
        kelvin = cv2.filter2D(kelvin, -1, kernel)
    height, width = kelvin.shape
    kelvin = kelvin + np.float32(sensor.noise_k) * rng.standard_normal(kelvin.shape, np.float32)
    kelvin = kelvin + np.float32(sensor.columns_k) * rng.standard_normal(width, np.float32)
    x, y = np.linspace(-1, 1, width)[None], np.linspace(-1, 1, height)[:, None]
    kelvin += np.float32(sensor.shading_k) * (x**2 + y**2).astype(np.float32)
    grey = _gain_controlled(kelvin, sensor)
    coded = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, sensor.jpeg_quality])[1]
    grey = np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def _gain_controlled(kelvin: Float32, sensor: Microbolometer) -> NDArray[np.uint8]:
    low, high = (float(k) for k in np.percentile(kelvin, (0.5, 99.5)))
    short = max(sensor.gain_k - (high - low), 0.0)
    low, high = low - short / 2, high + short / 2
    share = np.clip((kelvin - low) / (high - low), 0.0, 1.0)
    if sensor.plateau:
        counts, edges = np.histogram(share, 128, (0.0, 1.0))
        held = np.minimum(counts, 3.0 * share.size / 128)  # the plateau
        level = np.concatenate([[0.0], np.cumsum(held + 0.002 * share.size)])
        # Half of it linear, or a plain field would be stretched to noise.
        share = 0.5 * share + 0.5 * np.interp(share, edges, level / level[-1])
    out: NDArray[np.uint8] = (255.0 * share + 0.5).astype(np.uint8)
    return out


def _at(day: ThermalDay, hour: float) -> ThermalDay:
    return replace(day, hour=hour)
