"""What seasons, weather of the days before, and light do to a training place beside recolouring.

Each style changes what a flight sees, never the geometry. None is drawn unless it is asked for
(`SceneConfig.styles`, or its name as a condition), so that places drawn before stay as they were.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from localizer.synth.heightfield.scene import SkyLight
from localizer.synth.visits.noise import noise
from localizer.training.places.place import TrainingPlace
from localizer.types import Float32

LAMPS = "lamp-lit night"
SUNNY = ("low sun", "cloud shadows")  # styles of a day whose sun shines
STYLES = ("leaf off", "mown", "snow patches", "wet soil", *SUNNY, LAMPS)
_TWIGS = np.array([0.33, 0.29, 0.25], np.float32)
_SNOW = np.array([0.86, 0.89, 0.95], np.float32)
_HAY = np.array([1.12, 1.03, 0.85], np.float32)
_LAMP_M, _POOL_M = (22.0, 40.0), (6.0, 12.0)  # between street lamps; sigma of what one lights


@dataclass(frozen=True)
class StyledLight:
    """sunlit: (n, n) share of the direct light that comes through the clouds, None for all; glow:
    (n, n) light of lamps, in units of the sun's, None for none.
    """

    light: SkyLight
    sunlit: Float32 | None = None
    glow: Float32 | None = None


def styled_ground(
    albedo: Float32, place: TrainingPlace, style: str, rng: np.random.Generator
) -> Float32:
    """The ground (n, n, 3) under one of `STYLES`; as it is under those of light alone."""
    n, cell = albedo.shape[0], place.land.cell_m
    soft = (1.0 - place.lasting)[..., None]
    leafy = np.clip(9.0 * (albedo[..., 1] - albedo[..., [0, 2]].max(-1)), 0, 1)[..., None]
    out: Float32 = albedo
    if style == "leaf off":
        kept = np.clip(2.0 * noise(n, rng, 8, 2, 0.6) - rng.uniform(-0.5, 1.0), 0, 1)  # evergreen
        twigs = _TWIGS * (1 + 0.35 * noise(n, rng, max(int(n * cell / 3), 8), 3, 0.8))[..., None]
        bare = leafy * soft * _standing(place)[..., None] * (1 - kept[..., None])
        out = albedo + np.float32(rng.uniform(0.6, 0.95)) * bare * (twigs - albedo)
    elif style == "mown":
        parcels = (noise(n, rng, 5, 2, 0.5) > rng.uniform(-0.4, 0.6)).astype(np.float32)
        angle, wide = rng.uniform(0, np.pi), rng.uniform(2.5, 9.0) / cell
        rows, cols = np.mgrid[0:n, 0:n].astype(np.float32)
        swath = np.sign(np.sin(np.pi * (cols * np.cos(angle) + rows * np.sin(angle)) / wide))
        tone = (1 + rng.uniform(0.03, 0.14) * swath)[..., None] * _HAY
        cut = (leafy * soft)[..., 0] * parcels * (1 - _standing(place))
        smooth = cv2.GaussianBlur(albedo, (0, 0), max(1.0 / cell, 0.7)) * rng.uniform(1.0, 1.35)
        out = albedo + cut[..., None] * (smooth * tone - albedo)
    elif style == "snow patches":
        drift = noise(n, rng, 12, 5, 0.65) - rng.uniform(-0.6, 0.8)
        north = np.gradient(place.land.height, cell)[0]  # lies longer where the sun comes flat
        cover = np.clip(4.0 * (drift + 1.5 * np.clip(north, -0.4, 0.4)), 0, 1)[..., None]
        cleared = 1 - np.float32(rng.uniform(0.5, 1.0)) * place.lasting[..., None]
        out = albedo + cover * cleared * (_SNOW - albedo)
    elif style == "wet soil":
        where = np.clip(0.6 + 0.8 * noise(n, rng, 9, 4, 0.6), 0, 1)[..., None]
        # Water in the pores: darker by a third to a half, and more saturated.
        dark = albedo ** np.float32(rng.uniform(1.1, 1.3)) * np.float32(rng.uniform(0.5, 0.75))
        out = albedo + (1 - 0.7 * leafy) * where * (dark - albedo)
    return np.clip(out, 0.02, 1.2).astype(np.float32)


def styled_light(
    light: SkyLight, place: TrainingPlace, style: str, rng: np.random.Generator
) -> StyledLight:  # fmt: skip
    """The light of a day under one of `STYLES`; as it is under those of the ground alone."""
    n, cell = place.land.height.shape[0], place.land.cell_m
    if style == "low sun":  # a clear winter's day: shadows five to twelve times as long as high
        azimuth, up = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(5, 12))
        flat = np.cos(up)
        sun = (float(flat * np.cos(azimuth)), float(flat * np.sin(azimuth)), float(np.sin(up)))
        # Exposed for level ground, so what faces the sun is overexposed.
        return StyledLight(SkyLight(sun, float(rng.uniform(0.25, 0.5) / np.sin(up)), 0.5))
    if style == "cloud shadows":
        cells = max(int(n * cell / rng.uniform(60, 400)), 1) + 1
        field = noise(n, rng, cells, 3, 0.45)
        edge = field - rng.uniform(-0.5, 0.5)
        through = np.clip(0.5 + edge / rng.uniform(0.1, 0.5), rng.uniform(0.05, 0.25), 1)
        return StyledLight(replace(light, direct=1.0, ambient=0.4), through.astype(np.float32))
    if style == LAMPS:
        dark = SkyLight(light.sun, 0.0, float(rng.uniform(0.12, 0.35)))
        return StyledLight(dark, glow=_lamps(place, n, cell, rng))
    return StyledLight(light)


def _standing(place: TrainingPlace) -> Float32:
    """(n, n): where the ground rises over what is about it: crowns, not meadows."""
    height, cell = place.land.height, place.land.cell_m
    rise = height - cv2.erode(cv2.GaussianBlur(height, (0, 0), 0.7), np.ones((9, 9)))
    steep = np.hypot(*np.gradient(cv2.GaussianBlur(height, (0, 0), 8.0), cell)) * 4.5 * cell
    return np.asarray(np.clip((rise - steep) / 0.8, 0, 1), np.float32)


def _lamps(place: TrainingPlace, n: int, cell: float, rng: np.random.Generator) -> Float32:
    glow = np.zeros((n, n), np.float32)
    pace = rng.uniform(*_LAMP_M) / cell
    roads = place.roads or [rng.uniform(0, n, (2, 2)).astype(np.float32) for _ in range(3)]
    for road in roads:
        length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(road, axis=0), axis=1))]
        for along in np.arange(rng.uniform(0, pace), length[-1], pace):
            x = int(np.interp(along, length, road[:, 0]))
            y = int(np.interp(along, length, road[:, 1]))
            if 0 <= x < n and 0 <= y < n and rng.random() < 0.85:
                glow[y, x] += rng.uniform(0.5, 1.5)
    sigma = rng.uniform(*_POOL_M) / cell
    # A pool's middle is as bright as the sky by day.
    pools = cv2.GaussianBlur(glow, (0, 0), sigma) * (2 * np.pi * sigma**2)
    return np.asarray(np.minimum(pools, 2.5), np.float32)
