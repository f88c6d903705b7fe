"""Normalised correlation of one patch with a level of the overview, block by block, by FFT.

A block is `SIZE` cells wide; a patch is compared at every `ORIGIN_CELLS`th or `ROUGH_CELLS`th
origin of each at which the block contains it. They tile the map. What is summed over channels is a
product of spectra, so that a patch costs one transform per channel and each block one inverse
transform; the blocks' own spectra are kept within a budget.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.fft
from numba import njit
from numpy.typing import NDArray

from localizer.relocalization.overview import OverviewLevel
from localizer.types import Float32

SIZE = 256
MOST_CELLS = 96  # of a patch's side
_STEPS = (192, 160)  # origins of a block's side, for patches of up to 64 and 96 cells
# Frequencies that are kept on each side: a quarter of a cycle per cell. Above are 1 % of the energy
# of a map's features. So the scores at every second origin determine those between them.
_LOW = SIZE // 4
ORIGIN_CELLS = 2
ROUGH_CELLS = 4  # of a first pass, from the lower half of these frequencies: a quarter of the work
_COARSE = 8  # cells of the map's energy that are summed before it is correlated
# Spectra of so many blocks and patches are multiplied row by row, so that a row of all of them
# stays in the cache: one block and one patch after the other took more than twice as long.
BLOCKS_TOGETHER, PATCHES_TOGETHER = 8, 4
_LEAST_ENERGY = 0.3  # of the map's usual one under a patch: bare or missing ground scores less

Complex64 = NDArray[np.complex64]


@dataclass(frozen=True)
class Block:
    """Origins (row, column) to (row + step, column + step) of the map, in cells; may be < 0."""

    row: int
    column: int
    step: int


@dataclass(frozen=True)
class _Spectra:
    """features: (K, 2 _LOW, _LOW+1) complex64; energy: (SIZE/8, SIZE/16+1) complex64."""

    features: Complex64
    energy: Complex64


@dataclass(frozen=True)
class PatchSpectra:
    """A patch's Fourier transform. features: (K, 2 _LOW, SIZE / apart / 2 + 1); mask: as
    `_Spectra.energy`; norm: root of its energy; cells: side of the patch; weight: share of cells in
    view.
    """

    features: Complex64
    mask: Complex64
    norm: float
    cells: int
    weight: float


def transform_patch(features: Float32, mask: Float32, apart: int = ORIGIN_CELLS) -> PatchSpectra:
    """Transform a patch, to compare it at every `apart`th origin or less often. features: (n, n, K)
    weighted; mask: (n, n) in [0, 1].
    """
    n = features.shape[0]
    some = features[::ORIGIN_CELLS, ::ORIGIN_CELLS].transpose(2, 0, 1)
    # Row by row first: most rows are empty and stay so.
    lines = scipy.fft.rfft(some, 2 * _LOW, axis=2, workers=1)[..., : SIZE // apart // 2 + 1]
    spectra = scipy.fft.fft(lines, 2 * _LOW, axis=1, workers=1)
    sums = _summed(np.pad(mask, (0, -n % _COARSE))) / _COARSE**2
    coarse = scipy.fft.rfft2(sums, (SIZE // _COARSE,) * 2, workers=1)
    norm = float(np.sqrt((features**2).sum()))
    return PatchSpectra(
        spectra.astype(np.complex64, copy=False),
        np.ascontiguousarray(coarse, np.complex64),
        norm,
        n,
        float(mask.mean()),
    )


class LevelCorrelator:
    """Correlates patches with one level; caches spectra up to `byte_budget`. Thread-safe."""

    def __init__(self, level: OverviewLevel, byte_budget: int) -> None:
        self.level = level
        one = level.features.shape[0] * 2 * _LOW * (_LOW + 1) * np.dtype(np.complex64).itemsize
        self._most = max(1, byte_budget // one)
        self._kept: OrderedDict[Block, _Spectra] = OrderedDict()
        self._lock = threading.Lock()
        # Row by row, which may be in a file; int8 squares summed as such would wrap.
        rows = [level.features[:, r : r + 1, ::4] for r in range(0, level.shape[0], 4)]
        sample = np.concatenate(rows, axis=1).astype(np.float32) * level.quantum
        energy = (sample**2).sum(axis=0)
        self._usual = float(energy[energy > 0].mean()) if (energy > 0).any() else 1.0

    def blocks(self, cells: int) -> list[Block]:
        """All blocks for patches of up to so many cells a side; half of the largest patch may be
        beyond the map.
        """
        rows, columns = self.level.shape
        step = next(s for s in _STEPS if SIZE - s >= cells)
        lead = (SIZE - step) // 2
        return [
            Block(r, c, step) for r in range(-lead, rows - lead, step)
            for c in range(-lead, columns - lead, step)
        ]  # fmt: skip

    def shards(self, blocks: Sequence[Block]) -> list[Sequence[Block]]:
        """Parts of the blocks whose spectra are kept together: compare all patches with one before
        the next, so that each spectrum is computed once.
        """
        return [blocks[k : k + self._most] for k in range(0, len(blocks), self._most)]

    def correlate(self, patch: PatchSpectra, block: Block, apart: int = ORIGIN_CELLS) -> Float32:
        """Scores (n, n) of the patch at every `apart`th origin of the block."""
        scores: Float32 = self.correlate_all([patch], [(0, block)], apart)[0]
        return scores

    def correlate_all(
        self,
        patches: Sequence[PatchSpectra],
        pairs: Sequence[tuple[int, Block]],
        apart: int = ORIGIN_CELLS,
    ) -> Float32:
        """Scores (m, n, n) of m pairs: number of a patch, and the block. At most `PATCHES_TOGETHER`
        patches and `BLOCKS_TOGETHER` different blocks, of one size. apart: cells between compared
        origins, `ORIGIN_CELLS` or `ROUGH_CELLS`.
        """
        blocks = {b: k for k, b in enumerate(dict.fromkeys(b for _, b in pairs))}
        spectra = [self.prepare(b) for b in blocks]
        n = SIZE // apart
        products = np.empty((len(pairs), n, n // 2 + 1), np.complex64)
        _multiplied(
            _filled([s.features for s in spectra], BLOCKS_TOGETHER),
            _filled([p.features for p in patches], PATCHES_TOGETHER),
            np.array([(blocks[b], n, at) for at, (n, b) in enumerate(pairs)], np.int64),
            products.view(np.float32),
        )
        side = pairs[0][1].step // apart
        # Only the first rows are origins: the others' last transform is left out.
        columns = scipy.fft.ifft(products, axis=1, workers=1, overwrite_x=True)[:, :side]
        raws = scipy.fft.irfft(columns, n, axis=2, workers=1)
        below = np.stack([spectra[blocks[b]].energy * patches[k].mask.conj() for k, b in pairs])
        energies = scipy.fft.irfft2(below, (SIZE // _COARSE,) * 2, workers=1)
        least = [max(_LEAST_ENERGY * self._usual * p.weight * p.cells**2, 1e-9) for p in patches]
        # Fewer frequencies: a smaller divisor.
        norm = [max(p.norm, 1e-9) * (2 * _LOW / n) ** 2 for p in patches]
        of = [k for k, _ in pairs]
        scores = np.empty((len(pairs), side, side), np.float32)
        _normalised(raws, energies, *np.array([least, norm], np.float32)[:, of], scores)
        return scores

    def warm_up(self) -> None:
        """Compile the kernels of a search."""
        channels = self.level.features.shape[0]
        patch = transform_patch(np.ones((8, 8, channels), np.float32), np.ones((8, 8), np.float32))
        scores = self.correlate(patch, self.blocks(patch.cells)[0])
        mask_unsuited(scores[None], np.ones((1, 4, 4), np.bool_))

    def prepare(self, block: Block) -> _Spectra:
        """The block's spectra, from the cache or computed."""
        with self._lock:
            kept = self._kept.get(block)
            if kept is not None:
                self._kept.move_to_end(block)
                return kept
        made = self._transform(block)
        with self._lock:
            self._kept[block] = made
            if len(self._kept) > self._most:
                self._kept.popitem(last=False)
        return made

    def _transform(self, block: Block) -> _Spectra:
        level = self.level
        rows, columns = level.shape
        window = np.zeros((level.features.shape[0], SIZE, SIZE), np.float32)
        r0, r1 = max(block.row, 0), min(block.row + SIZE, rows)
        c0, c1 = max(block.column, 0), min(block.column + SIZE, columns)
        if r1 > r0 and c1 > c0:
            inside = level.features[:, r0:r1, c0:c1].astype(np.float32)
            window[:, r0 - block.row : r1 - block.row, c0 - block.column : c1 - block.column] = (
                inside * np.float32(level.quantum)
            )
        energy = _summed((window**2).sum(axis=0))
        return _Spectra(
            _low(scipy.fft.rfft(window, axis=2, workers=1)),
            scipy.fft.rfft2(energy, workers=1).astype(np.complex64, copy=False),
        )


def _low(lines: NDArray[Any]) -> Complex64:
    """The low frequencies (K, 2 _LOW, _LOW+1) of rows' spectra (K, SIZE, at least _LOW+1)."""
    spectra = scipy.fft.fft(lines[..., : _LOW + 1], axis=1, workers=1)
    kept = [spectra[:, :_LOW], spectra[:, -_LOW:]]
    return np.concatenate(kept, axis=1).astype(np.complex64, copy=False)


def _summed(values: Float32) -> Float32:
    n = values.shape[0] // _COARSE
    sums: Float32 = values.reshape(n, _COARSE, n, _COARSE).sum(axis=(1, 3)).astype(np.float32)
    return sums


def _filled(spectra: Sequence[Complex64], count: int) -> tuple[Float32, ...]:
    """As a tuple of one length, which is compiled once: real and imaginary parts in turn."""
    parts = tuple(x.view(np.float32) for x in spectra)
    return parts + parts[-1:] * (count - len(parts))


@njit(cache=True, fastmath=True, nogil=True)
def _multiplied(blocks, patches, pairs, out):  # type: ignore[no-untyped-def]
    """Sum over channels of block * conj(patch) for each pair (m, 3): block, patch, place in out.

    blocks, patches: (K, 2 _LOW, 2 _LOW + 2) each, out: (., n, n + 2) of the lowest frequencies;
    float32, real and imaginary in turn.
    """
    channels, all_rows, _ = blocks[0].shape
    _, rows, width = out.shape
    for r in range(rows):
        i = r if r < rows // 2 else r + all_rows - rows
        for m in range(pairs.shape[0]):
            a, b, o = blocks[pairs[m, 0]], patches[pairs[m, 1]], out[pairs[m, 2], r]
            o[:] = 0
            for k in range(channels):
                x, y = a[k, i], b[k, i]
                for j in range(width // 2):
                    o[2 * j] += x[2 * j] * y[2 * j] + x[2 * j + 1] * y[2 * j + 1]
                    o[2 * j + 1] += x[2 * j + 1] * y[2 * j] - x[2 * j] * y[2 * j + 1]


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def _normalised(raws, energies, least, norm, out):  # type: ignore[no-untyped-def]
    """Sample k of the coarse energy belongs to cell 8 k: between them it is interpolated."""
    each = _COARSE * raws.shape[2] // SIZE
    step = np.float32(1.0 / each)
    for m in range(out.shape[0]):
        raw, energy = raws[m], energies[m]
        for i in range(out.shape[1]):
            p = i // each
            a = (i - p * each) * step
            for q in range(out.shape[2] // each):
                west = energy[p, q] + a * (energy[p + 1, q] - energy[p, q])
                east = energy[p, q + 1] + a * (energy[p + 1, q + 1] - energy[p, q + 1])
                slope = (east - west) * step
                for b in range(each):
                    j = q * each + b
                    out[m, i, j] = raw[i, j] / (np.sqrt(max(west + b * slope, least[m])) * norm[m])


@njit(cache=True, nogil=True)
def mask_unsuited(scores, suited):  # type: ignore[no-untyped-def]
    """Set scores (m, n, n) to -1 where the suited cells (m, g, g) of n / g scores each, and one
    score about them, for the last maxima are interpolated, too, do not reach.
    """
    n, cells = scores.shape[1], suited.shape[1]
    side = n // cells
    for m in range(scores.shape[0]):
        for i in range(n):
            above = suited[m, max(i - 1, 0) // side]
            below = suited[m, min(i + 1, n - 1) // side]
            reached = above | below
            for q in range(cells):
                if not reached[q]:
                    first = q * side + (q > 0 and reached[q - 1])
                    last = (q + 1) * side - (q + 1 < cells and reached[q + 1])
                    scores[m, i, first:last] = -1
