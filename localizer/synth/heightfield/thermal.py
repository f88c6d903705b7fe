"""A height-field scene in the long-wave infrared: its surfaces' apparent temperatures as grey."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.synth.appearance.thermal import (
    SPAN_K,
    ThermalCover,
    ThermalDay,
    day_apparent,
    half_hours,
)
from localizer.synth.heightfield.scene import (
    LitScene,
    Prism,
    Scene,
    SkyLight,
    cast_shadows,
    openness,
    textured,
)
from localizer.synth.visits.noise import noise
from localizer.types import Float32

_SUNS = np.arange(6.75, 18.0, 1.5)  # hours at which shadows are cast; between them they move on
_CAR_M = 2.0  # lower prisms without windows are vehicles
_METAL_SHARE = 0.5  # of the roofs that are bright and grey
_COLD = 0.02  # the sky between the clouds, below every surface


def thermal_scene(
    scene: Scene, prisms: Sequence[Prism], lasting: Float32, day: ThermalDay,
    rng: np.random.Generator,
) -> LitScene:  # fmt: skip
    """What a white-hot camera sees, `SPAN_K` of the day's condition from 0 to 1, before its sensor.

    prisms: as the scene was composed of them; lasting: (n, n), one on roads, pavement and roofs.
    """
    cover = covers(scene, prisms, lasting, rng)
    # A photo's brightness is no albedo: pale pavement still takes up more than half.
    absorbs = 1.0 - np.clip(scene.albedo.mean(-1), 0.05, 0.45)
    # Polished metal takes up less than its grey says.
    absorbs = np.where(cover == ThermalCover.METAL, 0.4 * absorbs, absorbs).astype(np.float32)
    open_sky = openness(scene.height).astype(np.float32)
    by_sun = _warmed(scene, cover, day, absorbs, open_sky)
    apparent = np.zeros(cover.shape, np.float32)
    for kind in np.unique(cover):
        here = cover == kind
        lit = np.broadcast_to(by_sun[here], (len(ThermalCover), by_sun[here].size))
        every = day_apparent(day, lit, open_sky[here])
        apparent[here] = every[kind]
    apparent += _texture(cover, scene, rng) + _engines(scene, prisms, rng)
    walls, sun = _walls(scene, day, rng)
    middle = np.float32(np.median(apparent))
    span = SPAN_K[day.condition]

    def grey(kelvin: Float32) -> Float32:
        share = 0.5 + (kelvin - middle) / np.float32(span)
        return np.asarray(np.clip(share, 0.04, 1.0), np.float32)

    base, sunny = grey(walls[:, 0]), grey(walls[:, 1])
    facades = np.repeat(base[:, None], 4, axis=1)
    facades[:, 3] = 0.0  # panes are as cold as the wall is seldom; left out
    gain = float(np.median(sunny / base)) - 1.0 if len(base) > 1 else 0.0
    # The marcher shades walls by 0.8 ambient + direct * cosine.
    light = SkyLight(sun, max(gain, 0.0), 1.25)
    lit_facades = Scene(scene.height, scene.albedo, scene.prism, facades, scene.cell_m)
    texture = np.repeat(grey(apparent)[..., None], 3, axis=2)
    return textured(lit_facades, texture, light, (_COLD, _COLD, _COLD))


def covers(
    scene: Scene, prisms: Sequence[Prism], lasting: Float32, rng: np.random.Generator
) -> NDArray[np.int8]:
    """(n, n): the `ThermalCover` of every cell, by colour, height and what stands there."""
    red, green, blue = (cv2.GaussianBlur(scene.albedo[..., c], (0, 0), 1.0) for c in range(3))
    grey = (red + green + blue) / 3
    leafy = green - np.maximum(red, blue) > 0.02 * grey
    cover = np.where(leafy, ThermalCover.GRASS, ThermalCover.SOIL).astype(np.int8)
    high = scene.height - cv2.GaussianBlur(scene.height, (0, 0), max(3.0 / scene.cell_m, 1.5)) > 0.3
    cover[(leafy & (grey < 0.22)) | (high & leafy)] = ThermalCover.CROWN
    watery = (blue > red * 1.15) & (grey < 0.32) & (lasting < 0.5)
    cover[cv2.morphologyEx(watery.astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5))) > 0] = (
        ThermalCover.WATER
    )
    cover[(lasting > 0.5) & (scene.prism == 0)] = ThermalCover.ASPHALT
    kinds = np.array([ThermalCover.SOIL, *(_roof(p, rng) for p in prisms)], np.int8)
    return np.where(scene.prism > 0, kinds[scene.prism], cover).astype(np.int8)


def _roof(prism: Prism, rng: np.random.Generator) -> ThermalCover:
    bare = rng.random() < _METAL_SHARE
    if prism.height_m < _CAR_M and prism.window_m == 0.0:
        return ThermalCover.CAR
    red, green, blue = prism.roof
    if red > 1.15 * blue:
        return ThermalCover.TILES
    bright = (red + green + blue) / 3 > 0.45
    return ThermalCover.METAL if bright and bare else ThermalCover.BITUMEN


def _warmed(
    scene: Scene, cover: NDArray[np.int8], day: ThermalDay, absorbs: Float32, open_sky: Float32
) -> Float32:
    """(n, n): kelvin by the sun of the last day, each surface facing it as it lies, in the shadows
    that went over it.
    """
    height, cell = scene.height, scene.cell_m
    gy, gx = np.gradient(height, cell)
    length = np.sqrt(gx**2 + gy**2 + 1)
    answers, hours = day.heating()[:, None] * day.answers(), half_hours(day)
    nearest = np.abs(hours[:, None] - _SUNS[None]).argmin(axis=1)
    warmed = np.zeros(height.shape, np.float32)
    scattered = answers @ np.array([day.scattered(h) for h in hours])
    for number, hour in enumerate(_SUNS):
        beam = np.where(nearest == number, [day.beam(h) for h in hours], 0.0)
        by_cover = (answers @ beam).astype(np.float32)
        if not beam.any():
            continue
        sx, sy, sz = day.sun(float(hour))
        cosine = np.clip((-gx * sx - gy * sy + sz) / length, 0, 1)
        lit = cast_shadows(height, cell, sx, sy, sz, float(np.ptp(height)))
        warmed += by_cover[cover] * (cosine * cv2.GaussianBlur(lit, (0, 0), 1.0)).astype(np.float32)
    return np.asarray(absorbs * (warmed + scattered[cover] * open_sky), np.float32)


def _texture(cover: NDArray[np.int8], scene: Scene, rng: np.random.Generator) -> Float32:
    """(n, n): what the map cannot know: wet and dry places, leaves, wear, K."""
    n = cover.shape[0]
    patchy = noise(n, rng, 10, 4, 0.6)
    fine = noise(n, rng, max(int(n * scene.cell_m / 4.0), 8), 3, 0.7)
    strong = np.array([0.9, 0.7, 0.5, 0.1, 0.4, 0.5, 0.6, 1.2, 0.8, 0.4], np.float32)
    return np.asarray(strong[cover] * (0.8 * patchy + 0.5 * fine), np.float32)


def _engines(scene: Scene, prisms: Sequence[Prism], rng: np.random.Generator) -> Float32:
    """(n, n): vehicles that were driven, and what heated buildings lose through their roofs, K."""
    extra = np.zeros(len(prisms) + 1, np.float32)
    for number, prism in enumerate(prisms, start=1):
        driven, leak = rng.random() < 0.25, rng.uniform(0.0, 2.5)
        is_car = prism.height_m < _CAR_M and prism.window_m == 0.0
        extra[number] = (12.0 if driven else 0.0) if is_car else leak
    return np.asarray(extra[scene.prism], np.float32)


def _walls(
    scene: Scene, day: ThermalDay, rng: np.random.Generator
) -> tuple[Float32, tuple[float, float, float]]:
    """(prisms + 1, 2): apparent temperature of walls in shade and facing the day's sun, and where
    from the sun warmed them, by what they still hold of it.
    """
    answers, hours = day.answers(), half_hours(day)
    held = answers[ThermalCover.WALL] * [day.beam(h) for h in hours]
    suns = np.array([day.sun(h) for h in hours])
    flat = (held[:, None] * suns[:, :2]).sum(axis=0)
    strength = float(np.hypot(*flat))
    direction = flat / max(strength, 1e-9)
    count = len(scene.facades)
    tone = 1.0 - np.clip(scene.facades[:, :3].mean(axis=1), 0.05, 0.8)
    scattered = float(answers[ThermalCover.WALL] @ [day.scattered(h) for h in hours]) * 0.5
    # A wall sees half the sky, and half ground that is about as warm as itself.
    shade = day_apparent(day, np.full((len(ThermalCover), 1), 0.7 * scattered), 0.5)[
        ThermalCover.WALL, 0
    ]
    leak = rng.uniform(0.0, 1.5, count)
    walls = np.stack([shade + leak, shade + leak + tone * strength], axis=1)
    return walls.astype(np.float32), (float(direction[0]), float(direction[1]), 0.0)
