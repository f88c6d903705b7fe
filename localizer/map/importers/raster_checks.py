"""Checks DSM and orthophoto before the import."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio.enums
from rasterio.io import DatasetReader
from rasterio.windows import Window
from scipy.ndimage import find_objects, grey_opening, label

from localizer.errors import MapSourceError
from localizer.geometry.pose import Array
from localizer.map.importers.raster_file import HeightBand, apply_affine, has_own_mask, is_on_raster
from localizer.map.importers.rules import HIGHEST_M, LOWEST_M, ImportRules

_SAMPLES = 4000  # of a side
_FILL_SHARE, _FILL_GAP_M = 1e-3, 30.0
_WINDOW = 1500  # cells of a side, where slopes are measured
# Slender: height by width; the tallest chimneys have 25. From 500 m on nothing stands so, however
# coarse the cells; trees, lamps and aerials on a roof stay below 80 m.
_SLENDER, _SPIKE_LEAST_M, _SPIKE_M = 30.0, 80.0, 500.0
_SPIKE_CELLS = 3  # wide at most
_SPIKE_NEIGHBOURS = 3  # as many as a corner has
_DEGREE_M = 111_000.0
_STRIP_CELLS = 4_000_000  # read at once
_ONE_COLOUR = 2  # levels of 255 between a picture's darkest and brightest, and it shows nothing
_COLOUR_SAMPLES = 1000  # of a side
_STEEP, _STEEP_SHARE = 5.7, 0.25  # 80 degrees; photogrammetry of a dense town has 0.05 of it
_LEAST_OVERLAP, _GOOD_OVERLAP = 0.05, 0.5


def check_heights(
    path: Path, data: DatasetReader, band: HeightBand, rules: ImportRules
) -> list[str]:
    """Warnings about a DSM's values; `MapSourceError` if they cannot be heights, unless the user
    accepts this.
    """
    raw = _sampled(data, band)
    known = raw.compressed()
    if not len(known):
        raise MapSourceError(
            f"{path}: holds no height at all: every cell is nodata or not a number"
        )
    metres = band.metres(known)
    warnings = []
    odd = known[(metres < LOWEST_M) | (metres > HIGHEST_M)]
    if len(odd):
        values, counts = np.unique(odd, return_counts=True)
        value = float(values[counts.argmax()])
        warnings.append(
            rules.accept(
                "heights",
                f"{path}: {100 * len(odd) / len(known):.2g} % of its heights occur nowhere on "
                f"Earth, most often {value:g}: missing heights that are not marked so (--nodata="
                f"{value:g}), or another unit (--height-unit)",
            )
        )
    elif not has_own_mask(data) and band.missing is None:
        warnings += _fill(path, known, band, rules)
    return warnings + _steepness(path, data, band, rules) + _spikes(path, data, band)


def _sampled(data: DatasetReader, band: HeightBand) -> np.ma.MaskedArray:
    """The DSM's own numbers, (h, w) float64, subsampled if it is large."""
    shape = min(data.height, _SAMPLES), min(data.width, _SAMPLES)
    return _masked(data, band, out_shape=shape, resampling=rasterio.enums.Resampling.nearest)


def _masked(data: DatasetReader, band: HeightBand, **how: object) -> np.ma.MaskedArray:
    raw = data.read(1, masked=True, **how).astype(np.float64)
    bad = ~np.isfinite(raw.filled(np.nan))
    if band.missing is not None:
        bad |= np.isclose(raw.data, band.missing, rtol=1e-6)
    return np.ma.masked_array(raw.data, bad)


def _fill(path: Path, known: Array, band: HeightBand, rules: ImportRules) -> list[str]:
    """Warning about unmarked nodata: a frequent number at the end of the range, near no other."""
    warnings = []
    for extreme in (known.min(), known.max()):
        rest = known[known != extreme]
        share = 1 - len(rest) / len(known)
        if share < _FILL_SHARE or not len(rest):
            continue
        gap = abs(band.gain) * float(np.abs(rest - extreme).min())
        if gap > _FILL_GAP_M:
            warnings.append(
                rules.accept(
                    "nodata",
                    f"{path}: {100 * share:.2g} % of its heights are {extreme:g}, with nothing "
                    f"within {gap:.0f} m of it: missing heights that are not marked so? (--nodata="
                    f"{extreme:g})",
                )
            )
    return warnings


def _steepness(path: Path, data: DatasetReader, band: HeightBand, rules: ImportRules) -> list[str]:
    """Warning about noise or a wrong unit, by the steepness of cells near the DSM's centre."""
    width, height = min(data.width, _WINDOW), min(data.height, _WINDOW)
    window = Window((data.width - width) // 2, (data.height - height) // 2, width, height)
    raw = _masked(data, band, window=window)
    metres = band.metres(raw.filled(np.nan))
    rises = np.abs(np.diff(metres, axis=1)) / _step_m(data)
    rises = rises[np.isfinite(rises)]
    share = float((rises > _STEEP).mean()) if len(rises) else 0.0
    if share < _STEEP_SHARE:
        return []
    return [
        rules.accept(
            "slope",
            f"{path}: {100 * share:.0f} % of its cells rise by more than 80 degrees: noise, "
            "another unit (--height-unit), or not heights",
        )
    ]


def _spikes(path: Path, data: DatasetReader, band: HeightBand) -> list[str]:
    """Warning about few cells far above or below all around: a bird, a cloud, an error."""
    step = _step_m(data)
    found: list[tuple[float, float, float, float]] = []
    rows = max(1, _STRIP_CELLS // data.width)
    for first in range(0, data.height, rows):
        margin = _SPIKE_CELLS + 1
        top, bottom = max(first - margin, 0), min(first + rows + margin, data.height)
        window = Window(0, top, data.width, bottom - top)
        metres = band.metres(_masked(data, band, window=window).filled(np.nan))
        for row, column, gap in _stand_alone(metres, step):
            if first <= top + row < first + rows:  # else the strip beside it tells
                found.append((*data.xy(top + row, column), metres[row, column], gap))
    if not found:
        return []
    x, y, height, gap = max(found, key=lambda spike: abs(spike[3]))
    more = f", and {len(found) - 1} other places" if len(found) > 1 else ""
    side = "above" if gap > 0 else "below"
    return [
        f"{path.name}: {height:.0f} m at {x:.10g}, {y:.10g}, {abs(gap):.0f} m {side} all that is "
        f"about it and at most {_SPIKE_CELLS} cells wide{more}: no ground or building is like "
        "that, a guyed mast is; repair it or mark it as missing, unless one stands there"
    ]


def _step_m(data: DatasetReader) -> float:
    step: float = abs(data.transform.determinant) ** 0.5
    return step * _DEGREE_M if data.crs.is_geographic else step


def _stand_alone(metres: Array, step_m: float) -> list[tuple[int, int, float]]:
    """Row, column and height over its surroundings of each spike. metres: (h, w), NaN is unknown.

    A spike is at most three cells wide and more slender than any chimney: at least 80 m and 30
    times as high as wide. Everything higher than 500 m is a spike, too.
    """
    least = float(np.clip(_SLENDER * step_m, _SPIKE_LEAST_M, _SPIKE_M))
    steps = (np.abs(np.diff(metres, axis=axis)) > least for axis in (0, 1))
    if not any(step.any() for step in steps):
        return []
    found = []
    size = _SPIKE_CELLS + 1
    for sign in (1.0, -1.0):
        up = np.where(np.isfinite(metres), sign * metres, -np.inf)
        # What is left of a surface when all that is narrower than `size` is taken off it.
        bare = grey_opening(np.pad(up, size, constant_values=-np.inf), (size, size))
        with np.errstate(invalid="ignore"):
            groups, _ = label(up - bare[size:-size, size:-size] > least, np.ones((3, 3)))
        for number, box in enumerate(find_objects(groups), 1):
            extent = max(s.stop - s.start for s in box)
            if extent > _SPIKE_CELLS:
                continue
            rows, columns = (slice(max(s.start - 1, 0), s.stop + 1) for s in box)
            own = groups[rows, columns] == number
            about = up[rows, columns][~own]
            about = about[np.isfinite(about)]
            limit = float(np.clip(_SLENDER * extent * step_m, _SPIKE_LEAST_M, _SPIKE_M))
            heights = np.where(own, up[rows, columns], -np.inf)
            gap = heights.max() - about.max(initial=-np.inf)
            if len(about) >= _SPIKE_NEIGHBOURS and gap > limit:
                row, column = np.unravel_index(int(heights.argmax()), heights.shape)
                found.append((rows.start + int(row), columns.start + int(column), sign * gap))
    return found


def check_colours(path: Path, data: DatasetReader, bands: tuple[int, int, int]) -> list[str]:
    """A warning about a single-colour orthophoto, which cannot be registered against."""
    shape = min(data.height, _COLOUR_SAMPLES), min(data.width, _COLOUR_SAMPLES)
    how = {"out_shape": shape, "resampling": rasterio.enums.Resampling.nearest}
    shown = data.dataset_mask(**how) > 0
    colours = np.stack([data.read(band, **how)[shown] for band in bands], -1)
    if not len(colours) or np.ptp(colours, axis=0).max() > _ONE_COLOUR:
        return []
    colour = ", ".join(str(int(level)) for level in np.median(colours, axis=0))
    return [
        f"{path.name}: shows one colour ({colour}) all over: no image can be registered against "
        "it; is it the right file, and were its bands exported?"
    ]


def check_overlap(
    dsm: DatasetReader, band: HeightBand, ortho: DatasetReader, rules: ImportRules
) -> list[str]:
    """Warnings if the orthophoto covers less than half of the DSM; `MapSourceError` if nothing of
    it, or (unless the user accepts this) less than 5 %.
    """
    share = _covered_share(dsm, band, ortho)
    if share >= _GOOD_OVERLAP:
        return []
    text = f"{ortho.name}: shows {100 * share:.1f} % of the ground of {dsm.name}"
    if share == 0.0:
        raise MapSourceError(f"{text}: it lies beside it; check both places and CRS")
    if share < _LEAST_OVERLAP:
        return [rules.accept("overlap", f"{text}; check both places and CRS")]
    return [text]


def _covered_share(dsm: DatasetReader, band: HeightBand, ortho: DatasetReader) -> float:
    shape = min(dsm.height, 512), min(dsm.width, 512)
    known = ~_masked(
        dsm, band, out_shape=shape, resampling=rasterio.enums.Resampling.nearest
    ).mask  # fmt: skip
    rows, columns = np.nonzero(known)
    if not len(rows):
        return 0.0
    x, y = apply_affine(
        dsm.transform,
        (columns + 0.5) * dsm.width / shape[1],
        (rows + 0.5) * dsm.height / shape[0],
    )
    on = is_on_raster(ortho, dsm.crs.to_wkt(), x, y)
    return float(on.mean())
