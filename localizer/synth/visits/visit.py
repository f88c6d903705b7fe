"""A visit to a place: its look, buildings and trees changed since, and errors of the survey.

The map's texture was taken once. Until the flight, grass, crops, litter, bare soil and water get
another fine texture; their layout and hard surfaces stay. Each function of the texture models one
of these (model-card.md), for training places and for flown worlds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array
from localizer.synth.buildings.shell import Building, Kind
from localizer.synth.config import SURVEY, VisitLook, WorldConfig
from localizer.synth.plan.planner import Trees, WorldPlan
from localizer.types import Float32, Image

_HOUSES = (Kind.GABLE, Kind.HIP, Kind.FLAT)
_REBUILT_EAVES = (0.6, 1.8)  # of the old wall height
_REBUILT_SIDE = (0.85, 1.1)  # of the old length and width: the plot is the same
_GROWTH = (1.0, 1.2)  # of a crown's radius and height, in a few years


@dataclass(frozen=True)
class Changes:
    """Shares of changed objects. gone, rebuilt, new: shares of the buildings; felled: share of the
    trees (the others have grown); soft ground gets another fine texture. seed: selects the changed
    objects.
    """

    gone: float = 0.03
    rebuilt: float = 0.03
    new: float = 0.03
    felled: float = 0.05
    seed: int = 1


def apply_changes(plan: WorldPlan, changes: Changes) -> WorldPlan:
    """The plan after the changes; ground and streets stay. The fine texture is left to the
    tiles.
    """
    rng = plan.config.rng(61, changes.seed)
    draw = rng.random(len(plan.buildings))
    buildings = []
    for building, chance in zip(plan.buildings, draw, strict=True):
        if chance < changes.gone:
            continue
        again = chance < changes.gone + changes.rebuilt
        buildings.append(_rebuilt(building, rng) if again else building)
    count = min(round(changes.new * len(plan.buildings)), len(plan.sites))
    chosen = rng.choice(len(plan.sites), count, replace=False) if count else np.zeros(0, int)
    new = [plan.sites[k] for k in np.sort(chosen)]
    trees = _grown(plan.trees, changes, new, rng)
    return replace(plan, buildings=buildings + new, trees=trees)


def _rebuilt(building: Building, rng: np.random.Generator) -> Building:
    """Another house on the same plot; a building that is no house keeps its kind."""
    house = building.kind in _HOUSES or building.kind is Kind.L_GABLE
    return replace(
        building,
        kind=_HOUSES[int(rng.integers(len(_HOUSES)))] if house else building.kind,
        length=building.length * float(rng.uniform(*_REBUILT_SIDE)),
        width=building.width * float(rng.uniform(*_REBUILT_SIDE)),
        eaves_m=building.eaves_m * float(rng.uniform(*_REBUILT_EAVES)),
        seed=int(rng.integers(1 << 30)),
    )


def _grown(trees: Trees, changes: Changes, new: list[Building], rng: np.random.Generator) -> Trees:
    count = len(trees.xy)
    growth = rng.uniform(*_GROWTH, (2, count))
    keep = rng.random(count) >= changes.felled
    for building in new:
        reach = 0.5 * float(np.hypot(building.length, building.width)) + 2.0
        keep &= np.linalg.norm(trees.xy - building.centre, axis=1) > reach
    return Trees(
        trees.xy[keep],
        (trees.radius * growth[0])[keep],
        (trees.height * growth[1])[keep],
        trees.species[keep],
        trees.dense[keep],
        trees.seed[keep],
    )


_BUMP_WAVES = 6  # plane waves whose sum is the surface's error
_BUMP_M = (5.0, 25.0)  # their lengths
_HOLE_M = (1.0, 3.5)  # radius of a hole
_WALL = 0.35  # height of a wall's unit normal at most


@dataclass(frozen=True)
class SurveyErrors:
    """Errors of one survey. bumps_m: standard deviation of the surface per axis; holes_per_km2:
    number of holes; wall_blur_m: blur of the facades, which a survey sees at a flat angle; texel_m:
    ground size of a texel; seed: selects the positions of bumps and holes.
    """

    bumps_m: float = 0.0
    holes_per_km2: float = 0.0
    wall_blur_m: float = 0.0
    texel_m: float = 0.0
    seed: int = 0

    @classmethod
    def draw(cls, rng: np.random.Generator) -> SurveyErrors:
        """Draw the errors of a good to poor survey."""
        return cls(
            bumps_m=float(np.exp(rng.uniform(*np.log((0.03, 0.12))))),
            holes_per_km2=float(rng.uniform(20.0, 80.0)),
            wall_blur_m=float(rng.uniform(0.2, 0.8)),
            texel_m=float(np.exp(rng.uniform(*np.log((0.15, 0.4))))),
            seed=int(rng.integers(1 << 30)),
        )

    def displaced(self, positions: Array) -> Array:
        """Surface points (V, 3) ENU, displaced smoothly by the survey's errors."""
        if self.bumps_m <= 0:
            return positions
        rng = np.random.default_rng([self.seed, 1])
        direction = rng.standard_normal((_BUMP_WAVES, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        shortest, longest = np.log(_BUMP_M)
        lengths = np.exp(rng.uniform(shortest, longest, _BUMP_WAVES))
        phase = rng.uniform(0, 2 * np.pi, (3, _BUMP_WAVES))
        along = positions @ (2 * np.pi * direction / lengths[:, None]).T
        scale = self.bumps_m * np.sqrt(2.0 / _BUMP_WAVES)
        moved = [np.sin(along + phase[axis]).sum(axis=1) * scale for axis in range(3)]
        return np.asarray(positions + np.stack(moved, axis=1))

    def outside_holes(self, positions: Array, faces: NDArray[np.int64], side_m: float) -> Array:
        """Mask (F,) of the faces outside the survey's holes, in a world of `side_m`."""
        rng = np.random.default_rng([self.seed, 2])
        count = rng.poisson(self.holes_per_km2 * (side_m / 1000.0) ** 2)
        centres = rng.uniform(-side_m / 2, side_m / 2, (count, 2))
        radii = rng.uniform(*_HOLE_M, count)
        middle = positions[faces][:, :, :2].mean(axis=1)
        low, high = positions[:, :2].min(axis=0) - _HOLE_M[1], positions[:, :2].max(axis=0)
        near = ((centres >= low) & (centres <= high + _HOLE_M[1])).all(axis=1)
        kept = np.ones(len(faces), bool)
        for centre, radius in zip(centres[near], radii[near], strict=True):
            kept &= np.linalg.norm(middle - centre, axis=1) > radius
        return kept

    def apply_blur(self, chart: Image, gsd_m: float, normal_up: float = 1.0) -> Image:
        """A surface's image, blurred as by the survey. gsd_m: size of its pixel; normal_up: its
        normal's z.
        """
        if abs(normal_up) < _WALL and self.wall_blur_m > 0:
            sigma = self.wall_blur_m / gsd_m
            chart = np.asarray(cv2.GaussianBlur(chart, (0, 0), sigma), np.uint8)
        return coarser(chart, self.texel_m / gsd_m) if min(chart.shape[:2]) > 8 else chart


_BUILT = 0.04  # largest share of buildings gone, rebuilt, and new, each


@dataclass(frozen=True)
class Visit:
    """A visit to a place. name: of the variant. changes: since the survey; None: none. survey:
    errors of the map made at this visit; None: the true place.
    """

    name: str
    look: VisitLook
    changes: Changes | None = None
    survey: SurveyErrors | None = None


def draw_look(rng: np.random.Generator) -> VisitLook:
    """Draw the look of a random day: sun, season, traffic, missing buildings."""
    strength = rng.uniform(0.0, 1.0)
    warm = rng.uniform(0.8, 1.05)
    sky = 0.75 - 0.42 * strength
    return VisitLook(
        sun_azimuth_deg=float(rng.uniform(0, 360)),
        sun_elevation_deg=float(rng.uniform(12, 65)),
        sun_rgb=(0.95 * strength, 0.9 * strength * warm**0.5, 0.85 * strength * warm),
        sky_rgb=(sky * 0.93, sky, sky * 1.08),
        dryness=float(rng.uniform(0, 1)),
        crop=float(rng.uniform(0, 1)),
        leaf=float(rng.uniform(0, 1)),
        occupancy=float(rng.uniform(0.1, 0.9)),
        parking_seed=int(rng.integers(2, 1_000_000)),
        changed_buildings=float(rng.choice((0.0, 0.05))),
    )


def survey_and_flight_visits(config: WorldConfig) -> tuple[Visit, Visit]:
    """The visit from which the map is made, and the one that is flown over, both drawn from the
    world's seed.
    """
    rng = config.rng(62)
    survey = Visit("survey", SURVEY, survey=SurveyErrors.draw(rng))
    # What is gone is in the changes, beside what is new.
    look = replace(draw_look(rng), changed_buildings=0.0)
    gone, rebuilt, new = (float(x) for x in rng.uniform(0.01, _BUILT, 3))
    changes = Changes(
        gone, rebuilt, new, float(rng.uniform(0.02, 0.08)), seed=int(rng.integers(1 << 30))
    )
    return survey, Visit("live", look, changes)


_REGROWN_M = (0.6, 2.5)  # scale below which soft ground does not repeat
_KEPT = 0.35  # largest share of that fine texture which is still the map's own


def hard_surfaces(texture: Image) -> Float32:
    """Mask (H, W), 0 to 1, of pavement and roofs in a photo: grey, blue or strongly red, unlike
    vegetation or soil, which are green to yellow-brown.
    """
    smooth = cv2.GaussianBlur(texture.astype(np.float32), (0, 0), 1.5)
    red, green, blue = smooth[..., 0], smooth[..., 1], smooth[..., 2]
    soft = np.clip((green - blue - 4.0) / 10.0, 0, 1) * np.clip((40.0 - (red - green)) / 15.0, 0, 1)
    hard: Float32 = (1.0 - soft).astype(np.float32)
    return hard


def with_new_texture(
    albedo: Float32,
    lasting: Float32,
    cell_m: float,
    rng: np.random.Generator,
    other_texture: Float32 | None = None,
) -> Float32:
    """The albedo (n, n, 3) with new fine texture of the same strength on soft ground.

    lasting: (n, n) in 0..1, one on roads, roofs and pavement. other_texture: the same ground with
    another fine texture; None: texture from elsewhere in the place, or noise.
    """
    sigma = max(float(np.exp(rng.uniform(*np.log(_REGROWN_M)))) / cell_m, 0.7)
    base, detail, spread = _fine_texture(albedo, sigma)
    n = albedo.shape[0]
    if other_texture is not None:
        _, other, its_spread = _fine_texture(other_texture, sigma)
        other = other / its_spread
    elif rng.random() < 0.5:
        # Texture of the same place from elsewhere in it.
        shift = rng.integers(n // 4, 3 * n // 4, 2)
        other = np.roll(np.rot90(detail / spread, int(rng.integers(4))), shift, (0, 1))
    else:
        field = noise(n, rng, int(n / (3 * sigma)) + 1, 3, float(rng.uniform(0.6, 1.2)))
        other = (field / field.std())[..., None]
    kept = np.maximum(lasting, np.float32(rng.uniform(0, _KEPT)))[..., None]
    fresh = np.clip(other, -3, 3) * spread * np.float32(rng.uniform(0.7, 1.4))
    out = base + kept * detail + np.sqrt(1 - kept**2) * fresh
    changed: Float32 = np.clip(out, 0.02, 1.2).astype(np.float32)
    return changed


def _fine_texture(albedo: Float32, sigma: float) -> tuple[Float32, Float32, Float32]:
    """What is coarser than `sigma` (pixels), what is finer, and its strength (n, n, 1)."""
    base = cv2.GaussianBlur(albedo, (0, 0), sigma)
    detail = albedo - base
    power = cv2.GaussianBlur((detail**2).mean(-1), (0, 0), 2 * sigma)
    return np.asarray(base), np.asarray(detail), np.sqrt(power + 1e-8)[..., None]


def with_wet_patches(
    albedo: Float32,
    lasting: Float32,
    rng: np.random.Generator,
    patches: Float32 | None = None,
) -> Float32:
    """The albedo with patches of hard surface darker or paler: wet, dry, worn, dusty.

    patches: noise (n, n) that places them; None: drawn.
    """
    n = albedo.shape[0]
    field = noise(n, rng, 8, 3, 0.6) if patches is None else patches
    where = np.clip(0.5 + 0.6 * field, 0, 1)
    gain = 1 + lasting * (np.float32(rng.uniform(0.5, 1.25)) - 1) * where
    changed: Float32 = (albedo * gain[..., None]).astype(np.float32)
    return changed


def coarser(image: Image, texel_px: float) -> Image:
    """The image (same size) with one texture sample per `texel_px` pixels."""
    if texel_px <= 1.0:
        return image
    height, width = image.shape[:2]
    size = (max(int(width / texel_px), 8), max(int(height / texel_px), 8))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    out: Image = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
    return out


def draw_texel(rng: np.random.Generator) -> float:
    """Random ratio of map texel to query pixel on the ground, 1 to 4."""
    return float(np.exp(rng.uniform(0.0, np.log(4.0))))


def noise(n: int, rng: np.random.Generator, base: int, octaves: int, gain: float) -> Float32:
    """Fractal value noise (n, n) of zero mean. base: cells of the coarsest octave, doubled in each;
    gain: amplitude of an octave over the one before.
    """
    out: Float32 = np.zeros((n, n), np.float32)
    amplitude = np.float32(1.0)
    for octave in range(octaves):
        k = min(base * 2**octave, n) + 3
        grid = rng.standard_normal((k, k), dtype=np.float32)
        out += amplitude * cv2.resize(grid, (n, n), interpolation=cv2.INTER_CUBIC)
        amplitude *= np.float32(gain)
    return out
