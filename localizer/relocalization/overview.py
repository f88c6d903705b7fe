"""The map's features seen from above, computed once and stored beside the tiles.

Squares of the map are rendered from above. The network's features of each are projected onto the
map's principal components, weighted by confidence, and stored as bytes. One file per scale:
``overview/KEY/LEVEL.safetensors`` in the cache's folder; KEY depends on map, model and format.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import math
import os
import threading
import weakref
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.errors import MapCacheError
from localizer.features.extractor import FeatureExtractor, model_key
from localizer.geometry.pose import Array
from localizer.map.cache.cache import TileCache
from localizer.plain_files import open_plain
from localizer.relocalization.kept_overviews import drop_old, mark_used
from localizer.render.base import MapRenderer
from localizer.render.topview import render_top_view
from localizer.types import FeatureLevel, Float32, Image

logger = logging.getLogger(__name__)

GSD_M = (0.5, 1.0, 2.0)  # metres per pixel of the levels
STRIDE = 4  # pixels per cell: the network's level whose features are compared
CHANNELS = 16  # principal components that are kept
GROUND_CELLS = 16  # cells per sample of the ground's height

_FORMAT = 2
_SQUARE_CELLS = 128  # drawn at a time
_MARGIN_CELLS = 16  # around it, which the network needs to see and whose features are dropped
_QUANTUM = 0.01  # of a stored feature
# Cells (sigma) of the mean that is taken away: what kind of land it is says little of where it is,
# and without this one meadow scores as any other. Found in time: 12 of 12 instead of 9 among five.
_LOCAL_CELLS = 8.0
_LOCAL_REACH = 32  # cells: OpenCV's kernel ends at four sigmas
_STRIP_CELLS = 512  # rows whose mean is taken away at a time, for 100 km² take 0.4 GB as they are
_SAMPLE_SQUARES = 24  # that the principal components are computed from
_GROUND_PERCENTILE = 30  # of the heights in a sample: lower than roofs and trees
_LEAST_SHARE = 0.9  # of a square's cell that the map must cover to be compared

_READ_BYTES = 1 << 20  # at a time, while a file is checked
_SEARCHED_BYTES = 5  # of the finest level's cell: its scores, their trials, and copies
_MOST_OF_MEMORY = 0.5  # of what is free

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Projection:
    """Linear, from features (..., C) to the stored ones. mean: (C,); basis: (C, K)."""

    mean: Float32
    basis: Float32

    def __call__(self, features: Float32) -> Float32:
        """(..., K)."""
        return np.asarray((features - self.mean) @ self.basis, np.float32)


class FeatureFile:
    """An int8 array (K, H, W) in a file, of which only the rows read last are in memory.
    Thread-safe.
    """

    def __init__(self, file: BinaryIO, offset: int, shape: tuple[int, int, int]) -> None:
        self.shape, self.nbytes = shape, math.prod(shape)
        self._descriptor, self._offset, self._name = os.dup(file.fileno()), offset, file.name
        weakref.finalize(self, os.close, self._descriptor)
        self._rows, self._strip = (0, 0), np.empty((shape[0], 0, shape[2]), np.int8)
        self._lock = threading.Lock()

    def __getitem__(self, at: tuple[slice, slice, slice]) -> NDArray[np.int8]:
        """All channels of rows that follow each other, and of columns. `MapCacheError` if the file
        has become shorter or cannot be read.
        """
        channels, height, width = self.shape
        first, last, _ = at[1].indices(height)
        with self._lock:
            if self._rows != (first, last):
                size = (last - first) * width
                starts = (self._offset + (k * height + first) * width for k in range(channels))
                try:
                    data = b"".join(os.pread(self._descriptor, size, start) for start in starts)
                    strip = np.frombuffer(data, np.int8).reshape(channels, last - first, width)
                except (OSError, ValueError) as error:
                    text = f"{self._name}: cannot be read any more ({error}): start again"
                    raise MapCacheError(text) from error
                self._rows, self._strip = (first, last), strip
            return self._strip[:, :, at[2]]


@dataclass(frozen=True, eq=False)
class OverviewLevel:
    """One scale. features: (K, H, W) int8 times `quantum`, confidence included, less their local
    mean, row 0 in the north;
    ground: (H / 16, W / 16) float32 world z, NaN without map; west, north: world m of the corner.
    """

    features: NDArray[np.int8] | FeatureFile
    ground: Float32
    projection: Projection
    west: float
    north: float
    gsd_m: float
    quantum: float = _QUANTUM

    @property
    def cell_m(self) -> float:
        """Side of a cell, m."""
        return self.gsd_m * STRIDE

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of cells."""
        return self.features.shape[1], self.features.shape[2]


def without_local_mean(values: Float32, known: Float32) -> Float32:
    """Values (h, w) or (h, w, K) minus their local mean over the known cells (h, w)."""
    total = cv2.GaussianBlur(values, (0, 0), _LOCAL_CELLS, borderType=cv2.BORDER_CONSTANT)
    share = cv2.GaussianBlur(known, (0, 0), _LOCAL_CELLS, borderType=cv2.BORDER_CONSTANT)
    if values.ndim == 3:
        share, known = share[..., None], known[..., None]
    return np.asarray((values - total / np.maximum(share, 1e-3)) * known, np.float32)


@dataclass(frozen=True)
class MapOverview:
    """A map's features from above at every scale, finest first."""

    levels: tuple[OverviewLevel, ...]
    key: str

    @property
    def area_km2(self) -> float:
        """Area of the covered ground."""
        level = self.levels[0]
        cell = (level.cell_m * GROUND_CELLS) ** 2
        return float(np.isfinite(level.ground).sum()) * cell / 1e6

    @property
    def nbytes(self) -> int:
        """Bytes in memory or on disk."""
        return sum(level.features.nbytes + level.ground.nbytes for level in self.levels)


def comparable_level(extractor: FeatureExtractor, rgb: Image) -> FeatureLevel:
    """The features of an image at stride `STRIDE`, used for the comparison. `MapCacheError` if the
    network has none.
    """
    for level in extractor.extract(rgb).levels:
        if level.stride == STRIDE:
            return level
    raise MapCacheError(f"{extractor.name}: no features of stride {STRIDE} to compare places with")


def overview_key(cache: TileCache, model: str) -> str:
    """Key (16 hex digits) of map, model (`model_key`) and format: the overview's folder name."""
    settings = (_FORMAT, GSD_M, STRIDE, CHANNELS, GROUND_CELLS, _QUANTUM)
    text = f"{cache.manifest.index_sha256} {model} {settings}"
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def open_overview(
    cache: TileCache,
    renderer: MapRenderer,
    extractor: FeatureExtractor,
    *,
    progress: Progress = lambda _done, _total: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> MapOverview | None:
    """Read the map's overview from disk, or compute and store it; None if cancelled by
    `should_stop`.

    progress: called with the number of finished squares and of all squares. A damaged file is named
    in the log and computed again. If the folder cannot be written, the log says so, and the
    overview is computed again at every start. A new overview removes the longest unused ones.
    `MapCacheError` if a search would need more than half of the free memory, or if the network has
    no comparable level.
    """
    key = overview_key(cache, model_key(extractor))
    folder = cache.path / "overview" / key
    mark_used(folder)
    levels, is_new = [], False
    squares = [_squares(cache, gsd) for gsd in GSD_M]
    paths = [folder / f"{gsd:g}.safetensors" for gsd in GSD_M]
    _require_memory(squares, computed=not all(map(os.path.exists, paths)))
    total, done = sum(len(s.corners) for s in squares), 0
    for plan, path in zip(squares, paths, strict=True):
        level = _read(path, plan.gsd_m)
        if level is None:
            level = _compute(
                plan,
                renderer,
                extractor,
                partial(_advance, progress, done, total),
                should_stop,
            )
            if level is None:
                return None
            write_level(path, level)
            level = _read(path, plan.gsd_m) or level
            is_new = True
        done += len(plan.corners)
        progress(done, total)
        levels.append(level)
    if is_new:
        drop_old(folder)
    return MapOverview(tuple(levels), key)


def _advance(progress: Progress, before: int, total: int, done: int) -> None:
    progress(before + done, total)


@dataclass(frozen=True)
class _Squares:
    """The squares of a level. corners: row and column of each one's first cell."""

    rows: int
    columns: int
    west: float
    north: float
    base_m: float
    gsd_m: float
    corners: tuple[tuple[int, int], ...]

    def centre(self, corner: tuple[int, int]) -> Array:
        """(2,) world m."""
        half = _SQUARE_CELLS / 2
        cell = self.gsd_m * STRIDE
        return np.array(
            [self.west + (corner[1] + half) * cell, self.north - (corner[0] + half) * cell]
        )


def _require_memory(squares: Sequence[_Squares], computed: bool) -> None:
    """`MapCacheError` if a search would need more than half of the free memory. computed: the
    overview, too.
    """
    cells = [s.rows * s.columns for s in squares]
    wanted, free = _SEARCHED_BYTES * cells[0] + computed * CHANNELS * sum(cells), available_bytes()
    if free is not None and wanted > _MOST_OF_MEMORY * free:
        raise MapCacheError(
            f"a search of {cells[0] * (GSD_M[0] * STRIDE) ** 2 / 1e6:.0f} km² takes "
            f"{wanted / 2**20:.0f} MiB, more than half of the {free / 2**20:.0f} MiB that are "
            "free: build a smaller map, or one in parts"
        )


def available_bytes() -> int | None:
    """Memory available without swapping; None if unknown."""
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except (OSError, ValueError, IndexError):
        pass
    return None


def _squares(cache: TileCache, gsd_m: float) -> _Squares:
    low, high = cache.index.box_min[0], cache.index.box_max[0]
    side = _SQUARE_CELLS * STRIDE * gsd_m
    columns, rows = (max(1, math.ceil((high[k] - low[k]) / side)) for k in (0, 1))
    n = _SQUARE_CELLS
    corners = tuple((n * r, n * c) for r in range(rows) for c in range(columns))
    return _Squares(
        rows * n, columns * n, float(low[0]), float(high[1]), float(low[2]), gsd_m, corners
    )


@dataclass(frozen=True)
class _SquareFeatures:
    """Features (n, n, C) float16 of a square, their weights (n, n), and the ground's heights."""

    features: NDArray[np.float16]
    weight: Float32
    ground: Float32


def _raw(
    plan: _Squares, corner: tuple[int, int], r: MapRenderer, e: FeatureExtractor
) -> _SquareFeatures:
    m, n = _MARGIN_CELLS, _SQUARE_CELLS
    side = (n + 2 * m) * STRIDE
    view = render_top_view(r, plan.centre(corner), side, plan.gsd_m, plan.base_m)
    level = comparable_level(e, view.rgb)
    inner = slice(m, m + n)
    known = np.isfinite(view.height[m * STRIDE : -m * STRIDE, m * STRIDE : -m * STRIDE])
    share = known.reshape(n, STRIDE, n, STRIDE).mean(axis=(1, 3))
    weight = level.confidence[inner, inner] * (share > _LEAST_SHARE)
    return _SquareFeatures(
        level.features[inner, inner].astype(np.float16),
        weight.astype(np.float32),
        _ground(view.height[m * STRIDE : -m * STRIDE, m * STRIDE : -m * STRIDE]),
    )


def _ground(height: Float32) -> Float32:
    side = GROUND_CELLS * STRIDE
    n = height.shape[0] // side
    samples = height.reshape(n, side, n, side).transpose(0, 2, 1, 3).reshape(n, n, -1)
    ground = np.full((n, n), np.nan, np.float32)
    some = np.isfinite(samples).mean(axis=2) > 0.1
    ground[some] = np.nanpercentile(samples[some], _GROUND_PERCENTILE, axis=1)
    return ground


def _compute(
    plan: _Squares,
    renderer: MapRenderer,
    extractor: FeatureExtractor,
    progress: Callable[[int], None],
    should_stop: Callable[[], bool],
) -> OverviewLevel | None:
    chosen = np.linspace(0, len(plan.corners) - 1, _SAMPLE_SQUARES).round().astype(int)
    kept: dict[int, _SquareFeatures] = {}
    for k in np.unique(chosen).tolist():
        if should_stop():
            return None
        kept[k] = _raw(plan, plan.corners[k], renderer, extractor)
    projection = _principal(kept.values())
    n, g = _SQUARE_CELLS, _SQUARE_CELLS // GROUND_CELLS
    features = np.zeros((projection.basis.shape[1], plan.rows, plan.columns), np.int8)
    known = np.zeros((plan.rows, plan.columns), np.bool_)
    ground = np.full((plan.rows // GROUND_CELLS, plan.columns // GROUND_CELLS), np.nan, np.float32)
    for k, (row, column) in enumerate(plan.corners):
        if should_stop():
            return None
        raw = kept.pop(k, None) or _raw(plan, (row, column), renderer, extractor)
        values = projection(raw.features.astype(np.float32)) * (raw.weight[..., None] / _QUANTUM)
        square = np.rint(values).clip(-127, 127).astype(np.int8)
        features[:, row : row + n, column : column + n] = square.transpose(2, 0, 1)
        known[row : row + n, column : column + n] = raw.weight > 0
        i, j = row // GROUND_CELLS, column // GROUND_CELLS
        ground[i : i + g, j : j + g] = raw.ground
        progress(k + 1)
    for channel in features:
        stored = channel.copy()
        for row in range(0, plan.rows, _STRIP_CELLS):
            last, before = row + _STRIP_CELLS, min(row, _LOCAL_REACH)
            strip = slice(row - before, last + _LOCAL_REACH)
            local = without_local_mean(
                stored[strip].astype(np.float32), known[strip].astype(np.float32)
            )[before : before + _STRIP_CELLS]
            channel[row:last] = np.rint(local).clip(-127, 127).astype(np.int8)
    return OverviewLevel(features, ground, projection, plan.west, plan.north, plan.gsd_m)


def _principal(squares: Iterable[_SquareFeatures]) -> Projection:
    """Projection to the leading principal components; each feature counts by its weight squared."""
    total, mean, second = 0.0, None, None
    for raw in squares:
        x = raw.features.reshape(-1, raw.features.shape[-1]).astype(np.float64)
        w = raw.weight.reshape(-1).astype(np.float64) ** 2
        s1, s2 = w @ x, (x * w[:, None]).T @ x
        mean = s1 if mean is None else mean + s1
        second = s2 if second is None else second + s2
        total += float(w.sum())
    if mean is None or second is None or total <= 0:
        raise MapCacheError("the map shows nothing from above: no overview can be made of it")
    mean = mean / total
    _, vectors = np.linalg.eigh(second / total - np.outer(mean, mean))
    basis = vectors[:, ::-1][:, :CHANNELS]
    return Projection(mean.astype(np.float32), np.ascontiguousarray(basis, np.float32))


def _read(path: Path, gsd_m: float) -> OverviewLevel | None:
    """A level from disk; None if there is none, or a damaged one (named in the log)."""
    try:
        with open_plain(path) as file:
            stated, found = file.read(32), hashlib.sha256()
            while some := file.read(_READ_BYTES):
                found.update(some)
            if found.digest() == stated:
                return _level(file, gsd_m)
        logger.warning("%s: damaged: the overview is made again", path)
    except FileNotFoundError:
        pass
    except OSError as error:
        logger.warning("%s: cannot be read (%s): the overview is made again", path, error)
    return None


def _level(file: BinaryIO, gsd_m: float) -> OverviewLevel:
    """A level in the form of safetensors after the hash, without its features in memory."""
    file.seek(32)
    header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
    start = file.tell()

    def array(name: str, kind: type[np.floating[Any]]) -> NDArray[Any]:
        first, last = header[name]["data_offsets"]
        file.seek(start + first)
        values: NDArray[Any] = np.frombuffer(file.read(last - first), kind)
        shaped: NDArray[Any] = values.reshape(header[name]["shape"])
        return shaped

    corner = array("corner", np.float64)
    features = header["features"]
    return OverviewLevel(
        FeatureFile(file, start + features["data_offsets"][0], tuple(features["shape"])),
        array("ground", np.float32),
        Projection(array("mean", np.float32), array("basis", np.float32)),
        float(corner[0]),
        float(corner[1]),
        gsd_m,
    )


def write_level(path: Path, level: OverviewLevel) -> None:
    """Write hash and arrays atomically, with a temporary name; if impossible, only log it."""
    arrays: dict[str, NDArray[Any]] = {
        "corner": np.array([level.west, level.north], np.float64),
        "mean": level.projection.mean,
        "basis": level.projection.basis,
        "ground": np.ascontiguousarray(level.ground),
        "features": np.ascontiguousarray(level.features[:, :, :]),
    }
    header: dict[str, object] = {}
    end = 0
    for name, values in arrays.items():
        kind, end = f"{values.dtype.kind.upper()}{8 * values.itemsize}", end + values.nbytes
        offsets = (end - values.nbytes, end)
        header[name] = {"dtype": kind, "shape": values.shape, "data_offsets": offsets}
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    # Array by array: of 100 km² safetensors makes two copies of 400 MB.
    parts: list[Any] = [len(text).to_bytes(8, "little"), text, *arrays.values()]
    found = hashlib.sha256()
    for part in parts:
        found.update(part)
    new = path.with_name(f"{path.name}.{os.getpid()}.new")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with new.open("wb") as file:
            file.write(found.digest())
            for part in parts:
                file.write(part)
            file.flush()
            os.fsync(file.fileno())
        new.replace(path)
    except OSError as error:
        logger.warning(
            "%s: the overview cannot be kept (%s): it is computed at every start", path, error
        )
        with contextlib.suppress(OSError):  # of a file system that is only read
            new.unlink()
