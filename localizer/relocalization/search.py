"""Exhaustive search over headings, heights above ground, and positions of the region.

If there is much to compare, every pair of a trial (heading and height) and a block of the map is
compared roughly first, and only the best pairs at the origins between them. The rough pass compares
the strip of the last seconds with a coarser level, if it is large enough for one.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from localizer.features.extractor import FeatureExtractor
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.relocalization.config import RelocalizationConfig
from localizer.relocalization.correlate import (
    BLOCKS_TOGETHER,
    MOST_CELLS,
    ORIGIN_CELLS,
    PATCHES_TOGETHER,
    ROUGH_CELLS,
    Block,
    LevelCorrelator,
    mask_unsuited,
    transform_patch,
)
from localizer.relocalization.overview import (
    GROUND_CELLS,
    STRIDE,
    OverviewLevel,
    comparable_level,
    without_local_mean,
)
from localizer.relocalization.patch import (
    FARTHEST,
    CameraFootprint,
    footprint,
    patch_side,
    rectify,
    with_heading,
)
from localizer.relocalization.strip import GroundStrip
from localizer.relocalization.types import PlaceCandidate, PlaceQuery
from localizer.render.topview import DOWN
from localizer.types import Float32, Image

Each = Callable[[Callable[[Any], Any], Iterable[Any]], Iterator[Any]]

_MOST_PX = MOST_CELLS * STRIDE  # of a patch's side
_UNSEEN_PX = 9  # next to what is not seen, features are of the filling
_SUPPRESSED_M = 12.0  # about a candidate, whose neighbours are no other place
LEAST_HEIGHT_M = 10.0
_MOST_PAIRS = 512  # of a trial and a block that are compared at every `ORIGIN_CELLS`th origin
_HEADINGS_TOGETHER = 3  # that share an extraction: its features are turned by up to 6 degrees
_AT = np.arange(-3.0, 4.0) - np.array([[-0.5], [0.0], [0.5]])
_TAPS = np.sinc(_AT) * np.sinc(_AT / 3) * (np.abs(_AT) < 3)  # Lanczos: half a sample to each side


@dataclass(frozen=True)
class SearchView:
    """The frame for the search: image (H, W, 3) of a pinhole camera, or (H, W, 4) as a strip's.
    strip: this frame and earlier ones laid together; called before a rough pass.
    """

    image: Image
    camera: Camera
    strip: Callable[[], GroundStrip | None] = lambda: None


@dataclass(frozen=True)
class Rectification:
    """One trial of the search. heading_rad: rotation of the query's attitude, counter-clockwise;
    height_m: above the ground; centre: (2,) m of the patch from the point below the camera; cells:
    side of the patch.
    """

    heading_rad: float
    height_m: float
    centre: Array
    cells: int


def heading_offsets(query: PlaceQuery, config: RelocalizationConfig) -> Array:
    """Rotations (n,) of the query to try, rad counter-clockwise about up: the whole circle if the
    heading is unknown.
    """
    step = math.radians(config.heading_step_deg)
    if query.heading_sigma_rad is None:
        reach = math.pi
    else:
        reach = min(config.heading_reach * query.heading_sigma_rad, math.pi)
    if reach >= math.pi - step / 2:
        count = math.ceil(2 * math.pi / step - 1e-9)
        return np.arange(count, dtype=np.float64) * (2 * math.pi / count)
    count = max(1, math.ceil(2 * reach / step - 1e-9))
    return (np.arange(count, dtype=np.float64) + 0.5) * (2 * reach / count) - reach


def level_for(levels: tuple[OverviewLevel, ...], side_m: float) -> OverviewLevel:
    """The finest level at which a patch of `side_m` can be compared, otherwise the coarsest."""
    for level in levels:
        if side_m / level.gsd_m <= _MOST_PX:
            return level
    return levels[-1]


def ground_of(level: OverviewLevel, query: PlaceQuery) -> Float32:
    """Ground heights (world z, m; NaN: unknown) of the level's grid cells that a camera in the
    query's region can see; of the whole map without a region.
    """
    if query.region is None or not np.isfinite(level.ground).any():
        return level.ground
    above = query.height_m + query.height_sigma_m - float(np.nanmin(level.ground))
    low, high = query.region.bounds
    reach = FARTHEST * max(above, LEAST_HEIGHT_M)
    cell = level.cell_m * GROUND_CELLS
    north, south = level.north - high[1] - reach, level.north - low[1] + reach
    west, east = low[0] - reach - level.west, high[0] + reach - level.west
    rows, columns = (
        slice(max(0, math.floor(first / cell)), max(0, math.ceil(last / cell)))
        for first, last in ((north, south), (west, east))
    )
    seen: Float32 = level.ground[rows, columns]
    return seen


def trial_heights(query: PlaceQuery, ground: Float32, config: RelocalizationConfig) -> Array:
    """Heights above ground (n,) in m, ascending, to rectify for, so that each position has one near
    its own; empty if no ground height is known.
    """
    known = ground[np.isfinite(ground)]
    if len(known) == 0:
        return np.empty(0)
    low = query.height_m - query.height_sigma_m - float(known.max())
    high = query.height_m + query.height_sigma_m - float(known.min())
    low, high = max(low, LEAST_HEIGHT_M), max(high, LEAST_HEIGHT_M)
    count = max(1, math.ceil(math.log(high / low) / math.log(config.scale_step)))
    edges = np.geomspace(low, high, count + 1)
    result: Array = np.sqrt(edges[:-1] * edges[1:])
    return result


def above_roofs(
    query: PlaceQuery, level: OverviewLevel, missing_m: float, config: RelocalizationConfig
) -> PlaceQuery:
    """The query with its height above roofs and trees, which stand `missing_m` above the ground of
    the map. It is lowered by at most half a step of scale, so that bare ground is still within a
    step.
    """
    ground = ground_of(level, query)
    known = ground[np.isfinite(ground)]
    above = query.height_m - float(np.median(known)) if len(known) else 0.0
    most = max(above, 0.0) * (1 - 1 / config.scale_step) / 2
    return replace(query, height_m=query.height_m - min(missing_m, most))


@dataclass
class Scores:
    """Best ratio of score to its trial's noise at each compared origin so far (rows, columns), and
    the number of that trial.
    """

    best: Float32
    trial: NDArray[np.int32]


def search(
    view: SearchView,
    query: PlaceQuery,
    correlators: tuple[LevelCorrelator, ...],
    extractor: FeatureExtractor,
    config: RelocalizationConfig,
    *,
    pool: ThreadPoolExecutor | None = None,
    should_stop: Callable[[], bool] = lambda: False,
) -> list[PlaceCandidate] | None:
    """The positions that look most like `view` from above, in the order of score divided by its
    trial's noise: a later one may have the higher score.

    At most `candidates` + 1; none if the map has no ground heights there; None if stopped.
    correlators: of the levels, finest first. A candidate's height is the query's. pool: threads
    that share the work and call should_stop; None: this thread only.
    """
    heights = trial_heights(query, ground_of(correlators[0].level, query), config)
    if len(heights) == 0:
        return []
    largest = config.patch_m * max(1.0, float(np.median(heights)) / 120.0)
    seen = footprint(view.camera, query.rotation, 1.0, largest / float(heights[-1]))
    levels = tuple(c.level for c in correlators)
    level = level_for(levels, seen.side_m * float(heights[0]))
    correlator = correlators[levels.index(level)]
    run = _MapSearch(view, query, correlator, extractor, config, seen, heights, ()).prepared()

    def each(work: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
        def one(item: Any) -> Any:
            if should_stop():
                raise _CancelledError
            return work(item)

        return map(one, items) if pool is None else pool.map(one, items)

    def coarser() -> _MapSearch | None:
        strip = view.strip()
        if strip is None:
            return None
        wanted = level_for(levels, strip.seen.side_m * float(np.median(heights)))
        if wanted.gsd_m <= level.gsd_m:
            return None
        return _MapSearch(
            SearchView(strip.image, strip.camera), replace(query, rotation=DOWN),
            correlators[levels.index(wanted)], extractor, config, strip.seen, heights, (),
        ).prepared()  # fmt: skip

    try:
        return run.found(each, coarser)
    except _CancelledError:
        return None


class _CancelledError(Exception):
    """The search was cancelled."""


def shared_extractions(heights: Array, ratio: float) -> list[list[int]]:
    """Indices of ascending heights in groups that share their features: in a group, the highest is
    at most `ratio` times the lowest.
    """
    groups: list[list[int]] = []
    for i, height in enumerate(heights):
        if groups and height <= heights[groups[-1][0]] * ratio:
            groups[-1].append(i)
        else:
            groups.append([i])
    return groups


@dataclass(frozen=True)
class SuitedOrigins:
    """A block's origins for one height. mask: those that it suits, every `GROUND_CELLS`; known:
    share of them all that is over ground.
    """

    mask: NDArray[np.bool_]
    known: float


@dataclass(frozen=True)
class Trial:
    """A heading and height, and the blocks with an origin that suits them."""

    number: int
    of: Rectification
    blocks: dict[Block, SuitedOrigins]


@dataclass(frozen=True)
class Look:
    """The trials that share one extraction. features: (n, n, K) of the ground as rectified `of`;
    mask: (n, n).
    """

    of: Rectification
    features: Float32
    mask: Float32
    trials: tuple[Trial, ...]


@dataclass(frozen=True)
class PairScores:
    """Scores (n, n) of a trial at a block's compared origins, -1 where they do not suit it. power:
    mean square of all its scores.
    """

    trial: int
    block: Block
    power: float
    scores: Float32


@dataclass(frozen=True)
class RoughPair:
    """A trial and a block, compared roughly. power: as `PairScores`; best: the highest of its
    scores, and at: its index among them.
    """

    trial: Trial
    block: Block
    power: float
    best: float
    at: int


def trial_noise(trials: Sequence[Trial], power: Iterable[Sequence[Any]]) -> Array:
    """Root mean square (n,) of each trial's scores over ground. Trials are compared by score
    divided by noise: low above a hill few cells are seen, and some position always looks similar.

    power: of each pair the number of the trial, the mean square, and more.
    """
    numbers, powers, *_ = zip(*power, strict=True)
    known = [sum(origins.known for origins in trial.blocks.values()) for trial in trials]
    total = np.bincount(numbers, powers, len(trials))
    return np.asarray(np.maximum(np.sqrt(total / np.array(known)), 1e-6))


@dataclass(frozen=True)
class _MapSearch:
    """Data of one search. blocks: of the map; suited: for each height, the blocks with an origin
    that it suits.

    Above 200 lines and 15 public methods: one correlation, from a heading's patch to the scores of
    all blocks. Where `each` is an argument, it is `map` that may be cancelled and use threads.
    """

    view: SearchView
    query: PlaceQuery
    correlator: LevelCorrelator
    extractor: FeatureExtractor
    config: RelocalizationConfig
    seen: CameraFootprint
    heights: Array
    blocks: tuple[Block, ...]
    suited: tuple[dict[Block, SuitedOrigins], ...] = ()

    @property
    def lead(self) -> int:
        """Cells from the first origin to the map's first cell."""
        return -self.blocks[0].row

    def empty(self) -> Scores:
        rows, columns = self.correlator.level.shape
        shape = tuple(-(-(n + 2 * self.lead) // ORIGIN_CELLS) for n in (rows, columns))
        return Scores(np.full(shape, -1.0, np.float32), np.zeros(shape, np.int32))

    def prepared(self) -> _MapSearch:
        """With its blocks and their suited origins."""
        blocks = self.correlator.blocks(self.cells(float(self.heights[-1])))
        run = replace(self, blocks=tuple(blocks))
        return replace(run, suited=tuple(run.suited_at(k) for k in range(len(self.heights))))

    def found(
        self, each: Each, coarser: Callable[[], _MapSearch | None]
    ) -> list[PlaceCandidate]:  # fmt: skip
        """The search's result. coarser: the search of a strip, None without."""
        looks = self.looks(each)
        trials = [trial for look in looks for trial in look.trials]
        if not trials:
            return []
        wanted = [trial.blocks for trial in trials]
        noise: Array | None = None
        if sum(map(len, wanted)) > 4 * _MOST_PAIRS:  # below, a rough pass saves nothing
            strip = coarser()
            if strip is None:
                noise, rough = self.rough(looks, each)
                wanted = [{} for _ in trials]
                for best in rough:
                    wanted[best.trial.number][best.block] = best.trial.blocks[best.block]
            else:
                noise, wanted = self.under(strip, trials, each)
        pairs = list(self.compare(looks, wanted, ORIGIN_CELLS, each))
        if noise is None:
            noise = trial_noise(trials, [(p.trial, p.power) for p in pairs])
        scores = self.empty()
        for pair in pairs:
            self.merge(scores, pair, float(noise[pair.trial]))
        return self.candidates(scores, trials, noise)

    def looks(self, each: Each) -> list[Look]:
        jobs = self.jobs()
        patches = each(self.patch, [middle for middle, _ in jobs])
        return [
            Look(of, features, mask, trials)
            for (of, trials), (features, mask) in zip(jobs, patches, strict=True)
        ]

    def rough(self, looks: Sequence[Look], each: Each) -> tuple[Array, list[RoughPair]]:
        """Noise of each trial, and the pairs that are most alike."""
        trials = [trial for look in looks for trial in look.trials]
        pairs = []
        for p in self.compare(looks, [t.blocks for t in trials], ROUGH_CELLS, each):
            at = int(p.scores.argmax())
            best = float(p.scores.flat[at])
            pairs.append(RoughPair(trials[p.trial], p.block, p.power, best, at))
        noise = trial_noise(trials, [(p.trial.number, p.power) for p in pairs])
        most = heapq.nlargest(_MOST_PAIRS, pairs, key=lambda p: p.best / noise[p.trial.number])
        return noise, most

    def under(
        self, strip: _MapSearch, trials: Sequence[Trial], each: Each
    ) -> tuple[Array, list[dict[Block, SuitedOrigins]]]:
        """Noise of each trial, and the origins about its best places, both by a strip."""
        reach = 2 * ROUGH_CELLS * strip.correlator.level.cell_m / self.correlator.level.cell_m
        looks = strip.looks(each)
        theirs, rough = strip.rough(looks, each)
        mine: dict[float, list[Trial]] = {}
        for trial in trials:
            mine.setdefault(trial.of.heading_rad, []).append(trial)
        noise = np.full(len(trials), theirs.mean())
        for other in (trial for look in looks for trial in look.trials):
            for trial in mine.get(other.of.heading_rad, ()):
                if trial.of.height_m == other.of.height_m:
                    noise[trial.number] = theirs[other.number]
        wanted: list[dict[Block, SuitedOrigins]] = [{} for _ in trials]
        corners = np.array([(b.row, b.column) for b in self.blocks])
        farthest = self.blocks[0].step + reach
        for pair in rough:
            corner = np.array([pair.block.row, pair.block.column])
            at = corner + ROUGH_CELLS * np.array(divmod(pair.at, pair.block.step // ROUGH_CELLS))
            place = strip.camera_at(at, pair.trial.of)
            # At every height, for the strip's middle may lie higher or lower than the frame.
            for trial in mine.get(pair.trial.of.heading_rad, ()):
                found = wanted[trial.number]
                away = self.origin_of(place, trial.of) - corners
                for k in np.flatnonzero(((-reach <= away) & (away <= farthest)).all(axis=1)):
                    block, (row, column) = self.blocks[k], away[k]
                    suited = trial.blocks.get(block)
                    if suited is None:
                        continue
                    middles = np.arange(GROUND_CELLS / 2, block.step, GROUND_CELLS)
                    near = np.outer(abs(middles - row) <= reach, abs(middles - column) <= reach)
                    near &= suited.mask
                    if near.any():
                        mask = near | found[block].mask if block in found else near
                        found[block] = replace(suited, mask=mask)
        return noise, wanted

    def jobs(self) -> list[tuple[Rectification, tuple[Trial, ...]]]:
        """What is extracted, and the trials that share it."""
        turns = heading_offsets(self.query, self.config)
        found, count = [], 0
        for group in shared_extractions(self.heights, self.config.extraction_ratio):
            for first in range(0, len(turns), _HEADINGS_TOGETHER):
                some, trials = turns[first : first + _HEADINGS_TOGETHER], []
                for heading, scale in product(some, group):
                    of = self.trial(float(heading), float(self.heights[scale]))
                    suited = self.suited[scale].items()
                    if blocks := {b: origins for b, origins in suited if self.meets(b, of)}:
                        trials.append(Trial(count, of, blocks))
                        count += 1
                if trials:
                    height = float(self.heights[group[len(group) // 2]])
                    found.append((self.trial(float(some.mean()), height), tuple(trials)))
        return found

    def compare(
        self, looks: Sequence[Look], wanted: Sequence[dict[Block, SuitedOrigins]], apart: int,
        each: Each,
    ) -> Iterator[PairScores]:  # fmt: skip
        """Compare each trial with its wanted blocks at every `apart`th origin."""
        union = set().union(*wanted)
        for shard in self.correlator.shards([b for b in self.blocks if b in union]):
            list(each(self.correlator.prepare, shard))

            def one(look: Look, shard: Sequence[Block] = shard) -> list[PairScores]:
                return self._correlate(look, wanted, shard, apart)

            for pairs in each(one, looks):
                yield from pairs

    def _correlate(
        self,
        look: Look,
        wanted: Sequence[dict[Block, SuitedOrigins]],
        shard: Sequence[Block],
        apart: int,
    ) -> list[PairScores]:
        found: list[PairScores] = []
        for first in range(0, len(look.trials), PATCHES_TOGETHER):
            some = look.trials[first : first + PATCHES_TOGETHER]
            blocks = [b for b in shard if any(b in wanted[trial.number] for trial in some)]
            if not blocks:
                continue
            patches = [
                transform_patch(
                    fitted(look.features, look.of, t.of), fitted(look.mask, look.of, t.of), apart
                )
                for t in some
            ]
            for k in range(0, len(blocks), BLOCKS_TOGETHER):
                pairs = [
                    (n, b) for b in blocks[k : k + BLOCKS_TOGETHER] for n, trial in enumerate(some)
                    if b in wanted[trial.number]
                ]  # fmt: skip
                scores = self.correlator.correlate_all(patches, pairs, apart)
                powers = np.einsum("mij,mij->m", scores, scores) / scores[0].size
                mask_unsuited(scores, np.stack([wanted[some[n].number][b].mask for n, b in pairs]))
                for (n, block), power, masked in zip(pairs, powers.tolist(), scores, strict=True):
                    self.mask_outside(masked, block, some[n].of, apart)
                    found.append(PairScores(some[n].number, block, power, masked))
        return found

    def trial(self, heading: float, height: float) -> Rectification:
        c, s = np.cos(heading), np.sin(heading)
        offset = np.array([[c, -s], [s, c]]) @ self.seen.centre * height
        return Rectification(heading, height, offset, self.cells(height))

    def cells(self, height: float) -> int:
        """Side of a patch in cells."""
        side = self.seen.side_m * height / self.correlator.level.cell_m
        return int(np.clip(round(side), 8, MOST_CELLS))

    def patch(self, trial: Rectification) -> tuple[Float32, Float32]:
        """Weighted features (n, n, K) of one rectification, and their mask (n, n)."""
        level = self.correlator.level
        side_px = patch_side(self.seen.side_m * trial.height_m, level.gsd_m, _MOST_PX)
        # Exactly the trial's ground, whatever the network's input has to be divisible by.
        gsd = trial.cells * level.cell_m / side_px
        patch = rectify(
            self.view.image, self.view.camera, with_heading(self.query.rotation, trial.heading_rad),
            trial.height_m, trial.centre, side_px, gsd,
        )  # fmt: skip
        features = comparable_level(self.extractor, patch.rgb)
        inner = cv2.erode(patch.seen.astype(np.uint8), np.ones((_UNSEEN_PX, _UNSEEN_PX), np.uint8))
        n = side_px // STRIDE
        mask = cv2.resize(inner.astype(np.float32), (n, n), interpolation=cv2.INTER_AREA)
        weighted = level.projection(features.features) * (mask * features.confidence)[..., None]
        known = (mask > 0.05).astype(np.float32)
        return without_local_mean(weighted.astype(np.float32), known), known

    def meets(self, block: Block, trial: Rectification) -> bool:
        """Whether any origin of a block is a camera position within the region."""
        region = self.query.region
        if region is None:
            return True
        low, high = region.bounds
        first = self.camera_at(np.array([block.row + block.step, block.column]), trial)
        last = self.camera_at(np.array([block.row, block.column + block.step]), trial)
        return not ((first > high).any() or (last < low).any())

    def suited_at(self, scale: int) -> dict[Block, SuitedOrigins]:
        """The blocks with an origin that suits the height `heights[scale]`, at any heading."""
        cells = self.cells(float(self.heights[scale]))
        origins = {b: self.suits(self.ground(b, cells), scale) for b in self.blocks}
        return {b: suited for b, suited in origins.items() if suited.mask.any()}

    def ground(self, block: Block, cells: int) -> Float32:
        """Ground heights below the centres of patches of this many cells, every `GROUND_CELLS`."""
        ground = self.correlator.level.ground
        at = np.arange(0, block.step, GROUND_CELLS) + (GROUND_CELLS + cells) // 2
        rows, columns = at + block.row, at + block.column
        i, j = rows // GROUND_CELLS, columns // GROUND_CELLS
        inside = np.ix_(i.clip(0, ground.shape[0] - 1), j.clip(0, ground.shape[1] - 1))
        out = ((i < 0) | (i >= ground.shape[0]))[:, None] | ((j < 0) | (j >= ground.shape[1]))
        return np.where(out, np.nan, ground[inside]).astype(np.float32)

    def suits(self, ground: Float32, scale: int) -> SuitedOrigins:
        """Where the scale fits the query's height, with its error. ground: heights."""
        reach = math.sqrt(self.config.scale_step)
        above = self.query.height_m - ground
        sigma = self.query.height_sigma_m
        low = np.maximum(above - sigma, LEAST_HEIGHT_M) / reach
        high = np.maximum(above + sigma, LEAST_HEIGHT_M) * reach
        height = self.heights[scale]
        mask = np.asarray((low <= height) & (height <= high))
        return SuitedOrigins(mask, float(np.isfinite(ground).mean()))

    def mask_outside(self, scores: Float32, block: Block, of: Rectification, apart: int) -> None:
        """Set scores of cameras outside the region to -1."""
        if self.query.region is not None:
            at = np.arange(0, block.step, apart)
            rows, columns = at + block.row, at + block.column
            grid = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1)
            scores[~self.query.region.contains(self.camera_at(grid, of))] = -1.0

    def camera_at(self, origin: NDArray[Any], trial: Rectification) -> Array:
        """East and north (..., 2) of the camera whose patch begins at cell (..., 2)."""
        level = self.correlator.level
        middle = (np.asarray(origin, np.float64) + trial.cells / 2) * level.cell_m
        east = level.west + middle[..., 1] - trial.centre[0]
        north = level.north - middle[..., 0] - trial.centre[1]
        return np.stack([east, north], axis=-1)

    def origin_of(self, place: Array, of: Rectification) -> Array:
        """Cell (2,) at which the patch of a camera at `place` (2,) begins."""
        level = self.correlator.level
        east, north = place + of.centre - np.array([level.west, level.north])
        return np.array([-north, east]) / level.cell_m - of.cells / 2

    def merge(self, scores: Scores, pair: PairScores, noise: float) -> None:
        rows, columns = scores.best.shape
        r, c = ((k + self.lead) // ORIGIN_CELLS for k in (pair.block.row, pair.block.column))
        h, w = (
            min(n, most) for n, most in zip(pair.scores.shape, (rows - r, columns - c), strict=True)
        )
        window = np.s_[r : r + h, c : c + w]
        weighed = pair.scores[:h, :w] / np.float32(noise)
        better = weighed > scores.best[window]
        scores.best[window][better] = weighed[better]
        scores.trial[window][better] = pair.trial

    def candidates(
        self, scores: Scores, trials: Sequence[Trial], noise: Array
    ) -> list[PlaceCandidate]:
        """The highest peaks of `scores`, no two closer than `_SUPPRESSED_M`, in their order."""
        best, moved = peaks(scores.best)
        reach = max(1, round(_SUPPRESSED_M / (self.correlator.level.cell_m * ORIGIN_CELLS)))
        found: list[PlaceCandidate] = []
        while len(found) < self.config.candidates + 1:
            i, j = np.unravel_index(int(np.argmax(best)), best.shape)
            if best[i, j] <= 0:
                break
            number = int(scores.trial[i, j])
            trial, score = trials[number].of, float(best[i, j] * noise[number])
            origin = np.array([i, j]) * ORIGIN_CELLS - self.lead
            place = self.camera_at(origin + moved[i, j] * ORIGIN_CELLS, trial)
            if self.query.region is not None and not self.query.region.contains(place):
                place = self.camera_at(origin, trial)
            pose = Pose(
                with_heading(self.query.rotation, trial.heading_rad),
                np.array([*place, self.query.height_m]),
            )
            found.append(PlaceCandidate(pose, score))
            best[max(i - reach, 0) : i + reach + 1, max(j - reach, 0) : j + reach + 1] = -1.0
        return found


def peaks(values: Float32) -> tuple[Float32, Array]:
    """Values (H, W) with their maxima interpolated at half a sample about each, and how far each
    value was moved for that (H, W, 2), in samples. What has half of the highest value is none.
    """
    least = np.float32(values.max() / 2)
    highest = values >= np.maximum(cv2.dilate(values, np.ones((3, 3))), least)
    margin = _TAPS.shape[1] // 2
    windows = sliding_window_view(np.pad(values, margin, mode="edge"), (_TAPS.shape[1],) * 2)
    about = np.einsum("ai,nij,bj->nab", _TAPS, windows[highest], _TAPS, optimize=True)
    flat = about.reshape(-1, 9)
    result, moved = values.copy(), np.zeros((*values.shape, 2))
    result[highest] = flat.max(axis=1)
    moved[highest] = np.stack(np.divmod(flat.argmax(axis=1), 3), axis=-1) / 2 - 0.5
    return result, moved


def fitted(values: Float32, of: Rectification, to: Rectification) -> Float32:
    """(m, m) or (m, m, K) of one rectification, turned and scaled to another's."""
    m, n = values.shape[0], to.cells
    turn = math.degrees(to.heading_rad - of.heading_rad)
    if m == n and turn == 0:
        return values
    fit = cv2.getRotationMatrix2D(((m - 1) / 2, (m - 1) / 2), turn, n / m)
    fit[:, 2] += (n - m) / 2
    fitted: Float32 = cv2.warpAffine(values, fit, (n, n), flags=cv2.INTER_LINEAR)
    return fitted
