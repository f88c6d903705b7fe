"""Checks a map before a flight: coverage, holes, texel size, seams, imagery offset."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.errors import MapCacheError
from localizer.geometry.pose import Array
from localizer.map.cache.cache import TileCache
from localizer.map.cache.tile import orientation_fault, vector_area
from localizer.map.inspection.alignment import (
    ImageryOffset,
    Mosaic,
    UsableArea,
    measure_alignment,
    render_mosaic,
    usable_part,
)
from localizer.map.inspection.kind import map_kind
from localizer.map.kind import HEIGHTS_HOLD, MapKind
from localizer.types import Image

_LEAST_HOLE_M2 = 25.0
_LEAST_BLANK_M2 = 100.0  # of one flat white or black: no picture was taken there
_WHITE, _BLACK, _FLAT = 250, 5, 2  # grey values
_MOST_HOLES, _MOST_BLANK = 0.02, 0.02  # of the area covered
_MOST_FLAT = 0.5  # likewise, of one colour like its surroundings: a lake is, a map is not
_COARSE, _TOO_COARSE = 2.0, 4.0  # texels over the working pixel on the ground
# A working pixel finer than the imagery's detail costs evidence. On fengyuan and NEON 42 and 76 %
# of the right frames are accepted at 1.7 and 1.5 pixels of detail, 87 and 84 % at 0.8 and 1.0.
_DETAIL_PX = 1.0
_LEAST_WIDTH = 64  # of `localizer.width`
_LEAST_COVERED = 0.5  # of the rectangle about the map
_SEAM_M = 0.5  # median step of heights along a border of tiles
_SEAM_GREY = 12.0  # likewise of grey values
_LEAST_SEAM_PX = 20
_SHIFT_M = 1.5
_GROUND = "ground"


class Grade(Enum):
    """Rating of a finding."""

    GOOD = "good"
    ADVICE = "advice"
    BAD = "bad"


@dataclass(frozen=True)
class MapFinding:
    """Result of one check. name: of the check; found: with units; grade; words: explanation."""

    name: str
    found: str
    grade: Grade
    words: str


@dataclass(frozen=True)
class MapUse:
    """Planned use of the map. height_m: of the flight above the ground; pixel_rad: angle of a
    working pixel; half_view_deg: half of the camera's field of view.
    """

    height_m: float
    pixel_rad: float
    half_view_deg: float = 32.5

    @property
    def pixel_m(self) -> float:
        """Ground size of a working pixel, straight down."""
        return self.height_m * self.pixel_rad

    def width_px(self, pixel_m: float) -> int:
        """Largest working width (a multiple of 16, at least 64) at which a pixel covers pixel_m of
        ground or more.
        """
        ground_m = 2.0 * self.height_m * math.tan(math.radians(self.half_view_deg))
        return max(int(ground_m / pixel_m) // 16, _LEAST_WIDTH // 16) * 16


@dataclass(frozen=True)
class MapCheck:
    """Result of `companion map check`. findings: one for each check; pictures: RGB images by name;
    size_m: east and north extent of the map's bounding rectangle; usable: its largest part without
    gaps, blank areas and coarse texels; None without any.
    """

    findings: tuple[MapFinding, ...]
    pictures: dict[str, Image]
    size_m: tuple[float, float]
    usable: UsableArea | None

    @property
    def ok(self) -> bool:
        """Whether no finding is bad."""
        return all(f.grade is not Grade.BAD for f in self.findings)


@dataclass(frozen=True)
class Seam:
    """A border between tiles. ends: rows and columns of its ends; height_m, grey: median steps
    across it, minus those beside it.
    """

    ends: tuple[tuple[int, int], tuple[int, int]]
    height_m: float
    grey: float

    @property
    def seen(self) -> bool:
        """Whether it is visible."""
        return self.height_m > _SEAM_M or self.grey > _SEAM_GREY


def check_map(cache: TileCache, use: MapUse) -> MapCheck:
    """Run all checks, which reads every tile; images show coverage, texels, seams and alignment.
    `MapCacheError` if a tile that an image needs is damaged.
    """
    mosaic = render_mosaic(cache)
    gaps, holes = _holes(mosaic)
    ratio = _texel_ratio(cache, mosaic, use)
    blank = _blank(mosaic) | (~gaps & (ratio == 0.0))  # flat colours instead of imagery
    seams = find_seams(cache, mosaic)
    shift = measure_alignment(mosaic)
    kind = map_kind(cache)
    findings = (
        *_intact(cache),
        _heights_finding(kind, use),
        _coverage(mosaic, gaps),
        _holes_finding(mosaic, holes),
        _blank_finding(mosaic, blank),
        *_source_finding(cache),
        *_sharpness(cache, kind, use),
        _date(kind),
        _seam_finding(seams),
        _shift(shift),
    )
    pictures = {
        "coverage": _painted(mosaic, {(220, 0, 200): holes, (255, 140, 0): blank}, gaps & ~holes),
        "texels": _texel_picture(mosaic, ratio),
        "seams": _seam_picture(mosaic, seams),
        "alignment": _alignment_picture(mosaic),
    }
    rows, columns = gaps.shape
    faulty = gaps | blank | (ratio > _TOO_COARSE)
    usable = usable_part(mosaic, faulty, use.height_m, cache.frame)
    if any(f.name == _GROUND and f.grade is Grade.BAD for f in findings):
        usable = None
    return MapCheck(findings, pictures, (columns * mosaic.gsd_m, rows * mosaic.gsd_m), usable)


def find_seams(cache: TileCache, mosaic: Mosaic) -> list[Seam]:
    """Borders of the finest nodes inside the map, visible or not (`Seam.seen`)."""
    index, rows, columns = cache.index, *mosaic.height.shape
    grey = mosaic.rgb.astype(np.float32).mean(axis=2)
    found = []
    for node in index.leaves:
        top, left, bottom, right = _edges(cache, mosaic, int(node))
        a, b = (round(np.clip(x, 0, rows)) for x in (top, bottom))
        c, d = (round(np.clip(x, 0, columns)) for x in (left, right))
        for across, at, (begin, end) in ((1, d, (a, b)), (0, b, (c, d))):
            limit = (rows, columns)[across]
            if not 4 <= at < limit - 4 or end - begin < _LEAST_SEAM_PX:
                continue
            ends = ((begin, at), (end, at)) if across else ((at, begin), (at, end))
            steps = [_step(layer, at, (begin, end), across) for layer in (mosaic.height, grey)]
            found.append(Seam(ends, steps[0], steps[1]))
    return found


def _edges(cache: TileCache, mosaic: Mosaic, node: int) -> tuple[float, float, float, float]:
    """First row and column of a node's box in the mosaic, and their ends."""
    (west, south), (east, north) = cache.index.box_min[node, :2], cache.index.box_max[node, :2]
    return (*mosaic.pixel(float(west), float(north)), *mosaic.pixel(float(east), float(south)))


def _step(layer: NDArray[np.float32], at: int, ends: tuple[int, int], across: int) -> float:
    """Median step across a line of a layer, minus the steps beside it; 0 where unknown."""
    lines = layer if across else layer.T
    near = lines[ends[0] : ends[1], at - 4 : at + 4]
    over = np.abs(near[:, 4] - near[:, 3])
    beside = 0.5 * (np.abs(near[:, 1] - near[:, 0]) + np.abs(near[:, 7] - near[:, 6]))
    known = np.isfinite(over) & np.isfinite(beside)
    if known.sum() < _LEAST_SEAM_PX:
        return 0.0
    return float(np.median(over[known]) - np.median(beside[known]))


def _holes(mosaic: Mosaic) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Masks (h, w): where there is no map, and the part of that which map surrounds."""
    gaps = np.isnan(mosaic.height)
    framed = np.pad(gaps.astype(np.uint8), 1, constant_values=1)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(framed, connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] * mosaic.gsd_m**2 >= _LEAST_HOLE_M2
    inside = np.array([k not in (0, labels[0, 0]) for k in range(count)]) & large
    return gaps, inside[labels[1:-1, 1:-1]] & gaps


def _blank(mosaic: Mosaic) -> NDArray[np.bool_]:
    """Mask (h, w) of the surface with uniformly white or black imagery."""
    low, high = mosaic.rgb.min(axis=2), mosaic.rgb.max(axis=2)
    flat = (high - low <= _FLAT) & ((low >= _WHITE) | (high <= _BLACK))
    flat &= ~np.isnan(mosaic.height)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(flat.astype(np.uint8), connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] * mosaic.gsd_m**2 >= _LEAST_BLANK_M2
    large[0] = False
    return np.asarray(large[labels])


def _flat_share(mosaic: Mosaic) -> float:
    """Share of the surface that its most frequent single colour covers."""
    around = np.ones((3, 3), np.uint8)
    spread = cv2.dilate(mosaic.rgb, around).astype(np.int16) - cv2.erode(mosaic.rgb, around)
    known = ~np.isnan(mosaic.height)
    flat = ((spread.max(axis=2) <= _FLAT) & known).astype(np.uint8)
    _, _, stats, _ = cv2.connectedComponentsWithStats(flat, connectivity=4)
    return float(stats[1:, cv2.CC_STAT_AREA].max(initial=0) / max(known.sum(), 1))


def _intact(cache: TileCache) -> list[MapFinding]:
    """Findings: whether all tiles can be read (the images need one level), and which side is up."""
    damaged: list[str] = []
    area: Array = np.zeros(3)
    index = cache.index
    leaves = {tile for node in index.leaves for tile in index.tiles_of(node)}
    for number, tile in enumerate(cache.tile_ids):
        try:
            mesh = cache.load_geometry(tile)
        except MapCacheError as error:
            damaged.append(str(error))
            continue
        if number in leaves:
            local = vector_area(mesh.positions.astype(np.float64), mesh.faces)
            area += mesh.world_from_tile.rotation @ local
    fault = orientation_fault(area)
    found = f"{len(damaged)} of {len(cache.tile_ids)} tiles"
    words = f"build it again: {damaged[0]}" if damaged else "each as its hash says"
    return [
        MapFinding("damaged", found, Grade.BAD if damaged else Grade.GOOD, words),
        MapFinding(_GROUND, "faces up", Grade.GOOD, "as it should be")
        if fault is None
        else MapFinding(_GROUND, fault, Grade.BAD, "build it again with another --up-axis"),
    ]


def _source_finding(cache: TileCache) -> list[MapFinding]:
    """The warnings of the build."""
    warnings = cache.manifest.warnings
    if not warnings:
        return []
    more = f"; and {len(warnings) - 1} more (`map info`)" if len(warnings) > 1 else ""
    return [MapFinding("build warnings", str(len(warnings)), Grade.ADVICE, warnings[0] + more)]


def _coverage(mosaic: Mosaic, gaps: NDArray[np.bool_]) -> MapFinding:
    share = float(1 - gaps.mean())
    rows, columns = gaps.shape
    found = (
        f"{share * gaps.size * mosaic.gsd_m**2 / 1e6:.3f} km², {100 * share:.0f} % of "
        f"{columns * mosaic.gsd_m:.0f} x {rows * mosaic.gsd_m:.0f} m"
    )
    if share >= _LEAST_COVERED:
        return MapFinding("coverage", found, Grade.GOOD, "fly where the map is, with its margin")
    words = "less than half of its rectangle is covered: look whether the mission's part is"
    return MapFinding("coverage", found, Grade.ADVICE, words)


def _holes_finding(mosaic: Mosaic, holes: NDArray[np.bool_]) -> MapFinding:
    share = float(holes.sum() / max((~np.isnan(mosaic.height)).sum(), 1))
    count = cv2.connectedComponents(holes.astype(np.uint8), connectivity=4)[0] - 1
    found = f"{count} of {_LEAST_HOLE_M2:.0f} m² or more, {100 * share:.2f} % of the area"
    if share > _MOST_HOLES:
        return MapFinding("holes", found, Grade.BAD, "views over them have little to match")
    words = "small ones do no harm" if count else "none"
    return MapFinding("holes", found, Grade.GOOD, words)


def _blank_finding(mosaic: Mosaic, blank: NDArray[np.bool_]) -> MapFinding:
    share = float(blank.sum() / max((~np.isnan(mosaic.height)).sum(), 1))
    found = f"{100 * share:.2f} % of the area"
    if share > _MOST_BLANK:
        words = (
            "surface without imagery (plain white or black, or a colour without a texture): the "
            "source lacks imagery there"
        )
        return MapFinding("without imagery", found, Grade.BAD, words)
    if (flat := _flat_share(mosaic)) > _MOST_FLAT:
        words = "plain colours: the imagery shows nothing to match"
        return MapFinding("without imagery", f"{100 * flat:.0f} % of the area", Grade.BAD, words)
    return MapFinding("without imagery", found, Grade.GOOD, "as it should be")


def _sharpness(cache: TileCache, kind: MapKind, use: MapUse) -> list[MapFinding]:
    if not len(_leaf_gsd(cache)) and not cache.manifest.gsd_m:
        return [MapFinding("texel size", "none", Grade.BAD, "no tile has imagery")]
    return [_texels(cache, use), _detail(kind, use)]


def _texels(cache: TileCache, use: MapUse) -> MapFinding:
    gsd = _leaf_gsd(cache)
    typical = float(np.median(gsd)) if len(gsd) else cache.manifest.gsd_m
    ratio = typical / use.pixel_m
    found = f"{typical:.2f} m (median), a working pixel {use.pixel_m:.2f} m at {use.height_m:.0f} m"
    if ratio <= _COARSE:
        return MapFinding("texel size", found, Grade.GOOD, f"{ratio:.1f} working pixels")
    words = f"{ratio:.1f} working pixels: the map is blurred beside the video; fly higher"
    return MapFinding(
        "texel size", found, Grade.ADVICE if ratio <= _TOO_COARSE else Grade.BAD, words
    )


def _heights_finding(kind: MapKind, use: MapUse) -> MapFinding:
    advice = kind.advice(use.half_view_deg, use.height_m)
    grade = Grade.ADVICE if advice else Grade.GOOD
    words = advice or "they distinguish tilt from shift"
    return MapFinding("heights", HEIGHTS_HOLD[kind.heights], grade, words)


def _detail(kind: MapKind, use: MapUse) -> MapFinding:
    ratio = kind.effective_resolution_m / use.pixel_m
    found = f"{kind.effective_resolution_m:.2f} m are resolved, {ratio:.1f} working pixels"
    if ratio <= _DETAIL_PX:
        return MapFinding("imagery detail", found, Grade.GOOD, "as fine as the video")
    width = use.width_px(kind.effective_resolution_m)
    words = (
        f"blurred beside the video: fewer frames are accepted. Set localizer.width to {width}, "
        "fly higher, or find sharper imagery"
    )
    return MapFinding("imagery detail", found, Grade.ADVICE, words)


def _date(kind: MapKind) -> MapFinding:
    if kind.imagery_date:
        words = "what was built or felled since costs accuracy"
        found = ", ".join(part for part in (kind.imagery_date, kind.sensor) if part)
        return MapFinding("imagery of", found, Grade.GOOD, words)
    words = "give `map build` --imagery-date; what was built or felled since costs accuracy"
    return MapFinding("imagery of", "not known", Grade.ADVICE, words)


def _seam_finding(seams: list[Seam]) -> MapFinding:
    seen = [s for s in seams if s.seen]
    found = f"{len(seen)} of {len(seams)} borders of tiles"
    if not seen:
        return MapFinding("seams", found, Grade.GOOD, "none show")
    worst = max(seen, key=lambda s: s.height_m / _SEAM_M + s.grey / _SEAM_GREY)
    words = f"the worst steps by {worst.height_m:.2f} m and {worst.grey:.0f} grey values"
    return MapFinding("seams", found, Grade.ADVICE, words)


def _shift(shift: ImageryOffset) -> MapFinding:
    name = "imagery on surface"
    if not shift.known:
        words = f"{shift.edges} cells with a step: too few, or they do not meet; flat land"
        return MapFinding(name, "not known", Grade.GOOD, words)
    found = f"{shift.east_m:+.1f} m east, {shift.north_m:+.1f} m north (peak {shift.peak:.0f})"
    if shift.distance_m <= _SHIFT_M:
        return MapFinding(name, found, Grade.GOOD, "together, to about a metre")
    words = (
        f"the imagery lies {shift.distance_m:.1f} m beside its surface: roofs are painted on the "
        "ground. Check the CRS of orthophoto and surface, or take a true orthophoto"
    )
    return MapFinding(name, found, Grade.BAD, words)


def _leaf_gsd(cache: TileCache) -> NDArray[np.float64]:
    index = cache.index
    gsd: NDArray[np.float64] = index.gsd[index.leaves]
    return gsd[gsd > 0]


def _painted(
    mosaic: Mosaic, parts: dict[tuple[int, int, int], NDArray[np.bool_]], away: NDArray[np.bool_]
) -> Image:
    picture: Image = mosaic.rgb.copy()
    picture[away] = 210
    for colour, where in parts.items():
        picture[where] = colour
    return picture


def _texel_ratio(cache: TileCache, mosaic: Mosaic, use: MapUse) -> NDArray[np.float32]:
    """Texels over working pixels, (h, w)."""
    index = cache.index
    ratio = np.zeros(mosaic.height.shape, np.float32)
    for node in np.flatnonzero((index.child_count == 0) & (index.gsd > 0)):
        top, left, bottom, right = _edges(cache, mosaic, int(node))
        part = tuple(slice(max(int(a), 0), max(int(np.ceil(b)), 0)) for a, b in
                     ((top, bottom), (left, right)))  # fmt: skip
        ratio[part] = index.gsd[node] / use.pixel_m
    return ratio


def _texel_picture(mosaic: Mosaic, ratio: NDArray[np.float32]) -> Image:
    """Texels over working pixels, from green (fine) to red (four and more)."""
    level = np.clip(1 - ratio / _TOO_COARSE, 0, 1)
    colours = np.stack([255 * (1 - level), 200 * level, np.full_like(level, 40)], axis=2)
    mixed = 0.5 * mosaic.rgb + 0.5 * colours
    mixed[np.isnan(mosaic.height)] = 210
    return np.asarray(mixed, np.uint8)


def _seam_picture(mosaic: Mosaic, seams: list[Seam]) -> Image:
    picture: Image = mosaic.rgb.copy()
    for seam in seams:
        (a, b), (c, d) = seam.ends
        colour = (220, 0, 0) if seam.seen else (0, 170, 0)
        cv2.line(picture, (b, a), (d, c), colour, 3 if seam.seen else 1)
    return picture


def _alignment_picture(mosaic: Mosaic) -> Image:
    """The surface's steps in red over the picture."""
    height = np.nan_to_num(mosaic.height, nan=float(np.nanmin(mosaic.height)))
    dx, dy = (cv2.Sobel(height, cv2.CV_32F, *axis, scale=0.125) for axis in ((1, 0), (0, 1)))
    picture: Image = mosaic.rgb.copy()
    picture[np.hypot(dx, dy) > 1.0] = (230, 20, 20)
    return picture
