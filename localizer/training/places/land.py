"""Land for training scenes: generated land cover, or real photos draped over generated relief."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from localizer.errors import SequenceError
from localizer.pictures import read_rgb
from localizer.plain_files import without_hidden
from localizer.synth.heightfield.scene import Land, Prism
from localizer.synth.visits.visit import hard_surfaces, noise
from localizer.training.places.objects import (
    TrainingPlace,
    building,
    buildings_along,
    plant,
    with_ground_color,
)
from localizer.types import Float32

_SEASONS = "neon_sjer_pairs"  # group whose plots were photographed at two dates


class PhotoLibrary:
    """Real textures below a folder, by group.

    Groups are kept apart for training and test by naming them. Of the cross-season plots, which are
    one group, every fourth is for tests: `held_out` takes those, otherwise the others are taken.
    """

    def __init__(self, root: Path, groups: tuple[str, ...], *, held_out: bool = False) -> None:
        self._files = {g: without_hidden((root / g).rglob("*.jpg")) for g in groups}
        if _SEASONS in self._files:
            plots = sorted({f.parent for f in self._files[_SEASONS]})
            mine = {p for k, p in enumerate(plots) if (k % 4 == 3) == held_out}
            self._files[_SEASONS] = [f for f in self._files[_SEASONS] if f.parent in mine]
        empty = [g for g, files in self._files.items() if not files]
        if empty:
            raise SequenceError(f"{root}: no *.jpg below {', '.join(empty)}")
        self.groups = groups

    def sample(self, rng: np.random.Generator, n: int) -> list[NDArray[np.uint8]]:
        """One place's texture layers, (n, n, 3) uint8 RGB each; several if its dates differ."""
        group = str(rng.choice(self.groups))
        files = self._files[group]
        if group == _SEASONS:
            return self._seasons(rng, n, files)
        if group == "neon_forest":
            chosen = rng.choice(len(files), 9, replace=True)
            return [_grid([read_rgb(files[i]) for i in chosen], n, 3)]
        image = read_rgb(files[int(rng.integers(len(files)))])
        short = min(image.shape[:2])
        side = int(rng.uniform(0.55, 1.0) * short)
        y = int(rng.integers(0, image.shape[0] - side + 1))
        x = int(rng.integers(0, image.shape[1] - side + 1))
        crop = image[y : y + side, x : x + side]
        resized = cv2.resize(crop, (n, n), interpolation=cv2.INTER_AREA if side > n else 1)
        turned = np.rot90(resized, int(rng.integers(4)))
        return [np.ascontiguousarray(turned[:, :: int(rng.choice((-1, 1)))])]

    def _seasons(
        self, rng: np.random.Generator, n: int, files: list[Path]
    ) -> list[NDArray[np.uint8]]:
        plots = sorted({f.parent for f in files})
        chosen = [plots[i] for i in rng.choice(len(plots), 9, replace=len(plots) < 9)]
        dates = [without_hidden(plot.glob("*.jpg")) for plot in chosen]
        layers = [_grid([read_rgb(d[k]) for d in dates], n, 3) for k in (0, -1)]
        return layers[:: int(rng.choice((-1, 1)))]


def _grid(images: list[NDArray[np.uint8]], n: int, per_side: int) -> NDArray[np.uint8]:
    """Square images tiled per_side x per_side and resized to (n, n, 3)."""
    side = n // per_side + 1
    small = [cv2.resize(i, (side, side), interpolation=cv2.INTER_AREA) for i in images]
    rows = [np.hstack(small[k : k + per_side]) for k in range(0, per_side**2, per_side)]
    return np.ascontiguousarray(np.vstack(rows)[:n, :n])


# RGB albedo of the land-cover classes: grass, crop, forest floor, soil, water, meadow.
_COVER = np.array(
    [
        [0.30, 0.40, 0.18],
        [0.45, 0.45, 0.20],
        [0.16, 0.24, 0.11],
        [0.50, 0.40, 0.28],
        [0.15, 0.22, 0.26],
        [0.40, 0.44, 0.24],
    ],
    np.float32,
)


def generated_place(rng: np.random.Generator, n: int, cell_m: float) -> TrainingPlace:
    """Draw a place of n x n cells: parcels, forest, water, a street net with buildings, farms."""
    height = noise(n, rng, 2, 5, 0.42) * _relief(rng, n, cell_m)
    cover, albedo = _parcels(rng, n)
    town = noise(n, rng, 3, 2, 0.5) > rng.uniform(-1.2, 1.2)
    height = np.where(cover == 4, cv2.GaussianBlur(height, (0, 0), 9), height)
    detail = noise(n, rng, 40, 5, 0.75)[..., None]
    albedo = albedo * (1 + 0.13 * detail) + 0.02 * noise(n, rng, 90, 3, 0.8)[..., None]
    albedo = np.clip(albedo, 0.03, 1.0)
    roads = _streets(rng, n, cell_m, town)
    buildings = buildings_along(rng, roads, n, cell_m, town)
    albedo, lasting = _paint_roads(rng, albedo, roads, cell_m)
    blocked = np.zeros((n, n), np.uint8)
    for road in roads:
        cv2.polylines(blocked, [np.rint(road).astype(np.int32)], False, 1, max(int(9 / cell_m), 1))
    for b in buildings:
        cv2.fillConvexPoly(blocked, np.rint(b.corners).astype(np.int32), 1)
    plant(rng, height, albedo, (cover == 2) & (blocked == 0), blocked, cell_m)
    land = Land(height.astype(np.float32), np.clip(albedo, 0.02, 1).astype(np.float32), cell_m)
    return TrainingPlace(land, buildings, roads, _with_roofs(lasting, buildings))


def photo_place(
    rng: np.random.Generator, n: int, cell_m: float, layers: list[NDArray[np.uint8]]
) -> TrainingPlace:
    """Lay textures (each (n, n, 3) uint8: the same ground on different dates) over drawn relief."""
    albedos = [(layer.astype(np.float32) / 255.0) * 0.85 for layer in layers]
    height = noise(n, rng, 2, 5, 0.4) * _relief(rng, n, cell_m)
    green = layers[0].astype(np.float32)
    leafy = cv2.GaussianBlur(green[..., 1] - 0.5 * (green[..., 0] + green[..., 2]), (0, 0), 2.0)
    dark = cv2.GaussianBlur(green.mean(-1), (0, 0), 2.0)
    trees = np.clip(leafy / 20.0, 0, 1) * (dark < np.median(dark))
    height += trees * np.clip(noise(n, rng, 90, 2, 0.7) + 0.8, 0, 2) * rng.uniform(1.0, 4.0)
    count = int(rng.integers(0, 60))
    buildings = [building(rng, rng.uniform(0, n, 2), rng.uniform(0, np.pi), cell_m)
                 for _ in range(count)]  # fmt: skip
    # A photographed roof is kept where there is one: the extrusion takes the texture's own colour.
    kept = [with_ground_color(b, layers[0], rng) for b in buildings]
    land = Land(height.astype(np.float32), np.clip(albedos[0], 0.02, 1.2), cell_m)
    others = tuple(np.clip(a, 0.02, 1.2) for a in albedos[1:])
    return TrainingPlace(land, kept, [], _with_roofs(hard_surfaces(layers[0]), kept), others)


def _with_roofs(lasting: Float32, prisms: list[Prism]) -> Float32:
    for prism in prisms:
        cv2.fillConvexPoly(lasting, np.rint(prism.corners).astype(np.int32), 1.0)
    return lasting


def _relief(rng: np.random.Generator, n: int, cell_m: float) -> float:
    """Amplitude of the terrain in metres: from flat to hilly, bounded by a share of the extent."""
    return float(min(rng.choice((1.0, 3.0, 8.0, 20.0)), 0.04 * n * cell_m))


def _parcels(rng: np.random.Generator, n: int) -> tuple[NDArray[np.int64], Float32]:
    """Land-cover class (n, n) and albedo (n, n, 3) of warped Voronoi parcels with crop rows."""
    count = int(rng.integers(12, 160))
    rows, cols = np.mgrid[0:n:2, 0:n:2].astype(np.float32)
    warp = n / 90.0
    x = cols + warp * noise(n // 2, rng, 6, 3, 0.5)
    y = rows + warp * noise(n // 2, rng, 6, 3, 0.5)
    seeds = rng.uniform(0, n, (count, 2))
    label = cKDTree(seeds).query(np.stack([x.ravel(), y.ravel()], 1), workers=1)[1]
    label = cv2.resize(
        label.reshape(n // 2, n // 2).astype(np.float32), (n, n), interpolation=cv2.INTER_NEAREST
    ).astype(int)
    cover = rng.choice(6, count, p=(0.22, 0.24, 0.2, 0.12, 0.06, 0.16))
    tint = rng.normal(0, 0.05, (count, 1)) + rng.normal(0, 0.02, (count, 3))
    albedo = (_COVER[cover] + tint)[label].astype(np.float32)
    angle, period = rng.uniform(0, np.pi, count), rng.uniform(4, 12, count)
    rows, cols = np.mgrid[0:n, 0:n].astype(np.float32)
    phase = (cols * np.cos(angle)[label] + rows * np.sin(angle)[label]) * 2 * np.pi
    stripes = np.sin(phase / period[label]) * rng.uniform(0, 0.08, count)[label]
    albedo += np.where((cover == 1)[label], stripes, 0)[..., None].astype(np.float32)
    return cover[label], albedo


def _streets(
    rng: np.random.Generator, n: int, cell_m: float, town: NDArray[np.bool_]
) -> list[Float32]:
    """Polylines (k, 2) in cells: a bent grid inside the town, a few country roads."""
    roads: list[Float32] = []
    angle = rng.uniform(0, np.pi)
    spacing = max(rng.uniform(45, 110) / cell_m, 40.0)
    count = int(n * 0.75 / spacing)
    bend = rng.uniform(0, 0.06) * n
    t = np.linspace(-0.75 * n, 0.75 * n, 64)
    for turn in (0.0, np.pi / 2):
        c, s = np.cos(angle + turn), np.sin(angle + turn)
        for k in range(-count, count + 1):
            offset = k * spacing + rng.normal(0, 0.1) * spacing
            curve = offset + bend * np.sin(t / n * 3 + k * 0.2)
            line = np.stack([n / 2 + c * t - s * curve, n / 2 + s * t + c * curve], 1)
            inside = ((line > 1) & (line < n - 2)).all(1)
            at = np.clip(line, 0, n - 1).astype(int)
            roads += _runs(line.astype(np.float32), inside & town[at[:, 1], at[:, 0]])
    for _ in range(int(rng.integers(2, 8))):
        a, b = rng.uniform(0, n, (2, 2))
        steps = np.linspace(-0.6, 1.6, 24)[:, None]
        line = a + steps * (b - a) + np.cumsum(rng.normal(0, 0.012 * n, (24, 2)), 0)
        roads.append(line.astype(np.float32))
    return roads


def _runs(line: Float32, keep: NDArray[np.bool_]) -> list[Float32]:
    """The stretches of a polyline whose vertices are kept, of two vertices or more."""
    cuts = np.flatnonzero(np.diff(keep.astype(np.int8))) + 1
    pieces = np.split(np.arange(len(line)), cuts)
    return [line[p] for p in pieces if len(p) > 1 and keep[p[0]]]


def _paint_roads(
    rng: np.random.Generator, albedo: Float32, roads: list[Float32], cell_m: float
) -> tuple[Float32, Float32]:
    """The albedo with roads, and (n, n) one on their surface."""
    paint, surface = albedo.copy(), np.zeros(albedo.shape[:2], np.float32)
    tone = rng.uniform(0.25, 0.5)
    for road in roads:
        points = [np.rint(road * 8).astype(np.int32)]
        asphalt = tone + rng.normal(0, 0.04)
        warm = rng.uniform(0, 0.08)
        width = rng.uniform(5, 10) / cell_m
        color = (asphalt + warm, asphalt, asphalt - warm)
        verge = tuple(min(1.0, c + 0.12) for c in color)
        cv2.polylines(paint, points, False, verge, max(round(width * 1.6), 1), cv2.LINE_AA, 3)
        cv2.polylines(paint, points, False, color, max(round(width), 1), cv2.LINE_AA, 3)
        cv2.polylines(surface, points, False, 1.0, max(round(width), 1), cv2.LINE_8, 3)
        if cell_m < 0.5 and rng.random() < 0.6:
            cv2.polylines(paint, points, False, (0.75, 0.75, 0.7), 1, cv2.LINE_AA, 3)
    grain = (albedo / np.maximum(cv2.GaussianBlur(albedo, (0, 0), 6), 0.05)) ** 0.5
    return paint * grain, surface
