"""Batches of augmented crops, deterministic by seed, rank and step, from shards or rendered live.

Live: processes make the places, threads render the views. The pairs are of the kind that
`training.data.shards` keeps on disk, which 10^5 pairs at 512 pixels would fill with some 300 GB.
Which places and views a step sees depends on seed, rank and step alone, so that a run resumes
exactly.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from localizer.errors import SequenceError
from localizer.synth.appearance.model import (
    Appearance,
    apply_appearance,
    sample_appearance,
    weathered,
)
from localizer.training.config import DataSection, LiveSection, OptimizerSection, TrainConfig
from localizer.training.data.pairs import (
    FIRST_WORLD_SEED,
    Pair,
    PlaceVisits,
    draw_views,
    low_priority,
    make_place,
    relative_pose,
    render_pair,
)
from localizer.training.data.shards import read_shard, shard_path, world_shard_paths
from localizer.training.losses import Batch
from localizer.types import Float32, Image

_POLL_S = 0.5  # between looks for a shard that is still being generated
_CACHED_SHARDS = 700
_MOST_DRAWS = 200  # for one sample; most pairs give one


@dataclass(frozen=True)
class Schedule:
    """Shards that a step draws from. paths: in order of generation; the first `initial` plus
    `growth` per step are used; world_paths: of mesh worlds, with their share of the samples from
    `world_first` on.
    """

    paths: tuple[Path, ...]
    initial: int
    growth: float
    world_paths: tuple[Path, ...]
    world_share: float
    world_first: int = 0

    def draw(self, step: int, rng: np.random.Generator) -> Path:
        """Draw the shard of one sample."""
        if self.world_paths and step >= self.world_first and rng.random() < self.world_share:
            return self.world_paths[int(rng.integers(len(self.world_paths)))]
        count = min(len(self.paths), int(self.initial + step * self.growth))
        return self.paths[int(rng.integers(count))]


class BatchStream(ABC):
    """Makes the batches of a run, each while the step before is computed."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1)
        self._next: tuple[int, Future[Batch]] | None = None

    def batch(self, step: int) -> Batch:
        """The batch of a step; a thread prepares the next one meanwhile."""
        if self._next is not None and self._next[0] == step:
            current = self._next[1]
        else:
            current = self._thread.submit(self._make, step)
        self._next = (step + 1, self._thread.submit(self._make, step + 1))
        return current.result()

    def close(self) -> None:
        """Stop preparing batches; does not wait."""
        self._thread.shutdown(wait=False, cancel_futures=True)

    @abstractmethod
    def _make(self, step: int) -> Batch: ...


class ShardStream(BatchStream):
    """Makes batches from the shards that a schedule selects.

    A step waits until its shards exist. Training can therefore begin while later shards are still
    being generated, and it sees the same data in every run. generating: result of the generation;
    its failure is raised here.
    """

    def __init__(
        self,
        schedule: Schedule,
        config: OptimizerSection,
        seed: int,
        rank: int = 0,
        generating: Future[None] | None = None,
    ) -> None:
        super().__init__()
        self._schedule, self._config = schedule, config
        self._generating = generating
        self._closed = threading.Event()
        self._seed = (seed,) if rank == 0 else (seed, rank)
        self._shard = lru_cache(_CACHED_SHARDS)(self._read)

    def close(self) -> None:
        """See `BatchStream.close`; also stops waiting for a shard."""
        self._closed.set()
        super().close()

    def _make(self, step: int) -> Batch:
        rng = np.random.default_rng((*self._seed, step))
        samples: list[TrainingSample] = []
        for _ in range(_MOST_DRAWS * self._config.batch):
            pairs = self._shard(self._schedule.draw(step, rng))
            if not pairs:
                continue
            made = crop_pair(pairs[int(rng.integers(len(pairs)))], self._config, rng)
            if made is not None:
                samples.append(made)
            if len(samples) == self._config.batch:
                return collate(samples)
        raise SequenceError(
            f"step {step}: hardly a pair of the run's shards has {self._config.anchors} anchors "
            f"in a crop of {self._config.crop}: enlarge `crop`, or look at them "
            "with `contact-sheet`"
        )

    def _read(self, path: Path) -> list[Pair]:
        self._await(path)
        pairs = read_shard(path)
        width, height = self._config.crop
        if pairs and (pairs[0].camera.width < width or pairs[0].camera.height < height):
            size = f"{pairs[0].camera.width}x{pairs[0].camera.height}"
            raise SequenceError(
                f"{path}: its images are {size}, less than `crop` asks: {width}x{height}"
            )
        return pairs

    def _await(self, path: Path) -> None:
        while not path.exists():
            if self._generating is not None and self._generating.done() and not path.exists():
                self._generating.result()  # its error, if that is why
                raise SequenceError(f"{path}: was not generated; run `generate` again")
            if self._closed.wait(_POLL_S):
                raise SequenceError(f"{path}: is not there yet, and the run has ended")


@dataclass(frozen=True)
class TrainingSample:
    """One augmented crop pair; arrays as in `localizer.training.losses.Batch`, without B."""

    reference: Image
    query: Image
    points: Float32
    reference_pixels: Float32
    query_pixels: Float32
    visible: Float32
    query_from_reference: NDArray[np.float64]
    K_query: Float32


def crop_pair(
    pair: Pair, config: OptimizerSection, rng: np.random.Generator
) -> TrainingSample | None:
    """Crop as `window_pair` images that light, weather and sensor have degraded."""
    query, reference = weathered(pair.query, pair.query_depth, pair.condition, rng), pair.reference
    survey = survey_appearance(rng)
    if survey is not None:
        reference = apply_appearance(reference, pair.reference_depth, survey, rng)
    return window_pair(replace(pair, reference=reference, query=query), config, rng)


def window_pair(
    pair: Pair, config: OptimizerSection, rng: np.random.Generator
) -> TrainingSample | None:
    """Crop windows of the same ground from a degraded pair, with anchors, and mirror half of the
    crops. None if they share too little.
    """
    width, height = config.crop
    camera, reference, query = pair.camera, pair.reference, pair.query
    T = relative_pose(pair)
    rx = int(rng.integers(0, camera.width - width + 1))
    ry = int(rng.integers(0, camera.height - height + 1))
    window = pair.reference_depth[ry : ry + height, rx : rx + width]
    rows, cols = np.nonzero(window > 0)
    if len(rows) < 2 * config.anchors:
        return None
    pick = rng.choice(len(rows), 2 * config.anchors, replace=False)
    pixels = np.stack([cols[pick] + rx, rows[pick] + ry], 1) + 0.5
    points = camera.rays(pixels) * window[rows[pick], cols[pick]][:, None]
    local = points @ T[:3, :3].T + T[:3, 3]
    seen, inside = camera.project(local)
    if inside.sum() < config.anchors // 3:
        return None
    # The query's window follows the content, with some freedom, so that large motions stay in view.
    middle = np.median(seen[inside], axis=0) + rng.normal(0, 8, 2)
    qx = int(np.clip(middle[0] - width / 2, 0, camera.width - width))
    qy = int(np.clip(middle[1] - height / 2, 0, camera.height - height))
    visible = inside & _unoccluded(seen, local[:, 2], pair.query_depth)
    moved = seen - (qx, qy)
    visible &= ((moved > 3) & (moved < (width - 3, height - 3))).all(1)
    if visible.sum() < config.anchors // 4:
        return None
    order = np.r_[np.flatnonzero(visible)[: int(0.85 * config.anchors)], np.flatnonzero(~visible)]
    order = np.r_[order, np.flatnonzero(visible)[int(0.85 * config.anchors) :]][: config.anchors]
    sample = TrainingSample(
        reference[ry : ry + height, rx : rx + width],
        query[qy : qy + height, qx : qx + width],
        points[order].astype(np.float32),
        (pixels[order] - (rx, ry)).astype(np.float32),
        np.nan_to_num(moved[order]).astype(np.float32),
        visible[order].astype(np.float32),
        T,
        np.array([camera.fx, camera.fy, camera.cx - qx, camera.cy - qy], np.float32),
    )
    return mirrored(sample) if rng.random() < 0.5 else sample


def survey_appearance(rng: np.random.Generator) -> Appearance | None:
    """Draw the map's own sensor and light for a reference; None for half of them."""
    if rng.random() >= 0.5:
        return None
    return replace(sample_appearance(rng, "day"), motion_blur_px=0.0, extinction_per_m=0.0)


def mirrored(sample: TrainingSample) -> TrainingSample:
    """The mirrored pair: images flipped, x negated in both camera frames."""
    width = sample.query.shape[1]
    M = np.diag([-1.0, 1.0, 1.0, 1.0])
    flip = np.array([-1.0, 1.0], np.float32)
    return TrainingSample(
        sample.reference[:, ::-1],
        sample.query[:, ::-1],
        sample.points * np.array([-1, 1, 1], np.float32),
        sample.reference_pixels * flip + np.array([width, 0], np.float32),
        sample.query_pixels * flip + np.array([width, 0], np.float32),
        sample.visible,
        M @ sample.query_from_reference @ M,
        sample.K_query * np.array([1, 1, -1, 1], np.float32)
        + np.array([0, 0, width, 0], np.float32),
    )


def collate(samples: list[TrainingSample]) -> Batch:
    """Stack samples into tensors; images in 0..1, all references before all queries."""
    images = np.stack([s.reference for s in samples] + [s.query for s in samples])
    # channels_last tensors corrupt memory in torch 2.13's CPU backward pass.
    pixels = torch.from_numpy(np.ascontiguousarray(images.transpose(0, 3, 1, 2)))
    stacked = {
        name: torch.from_numpy(np.stack([getattr(s, name) for s in samples]).astype(np.float32))
        for name in Batch.__dataclass_fields__
        if name != "images"
    }
    return Batch(pixels.float() / 255.0, **stacked)


def _unoccluded(
    pixels: NDArray[np.float64], z: NDArray[np.float64], depth: Float32
) -> NDArray[np.bool_]:
    """Whether the surface seen at `pixels` is the one at distance `z`."""
    h, w = depth.shape
    col = np.nan_to_num(pixels[:, 0]).astype(int).clip(0, w - 1)
    row = np.nan_to_num(pixels[:, 1]).astype(int).clip(0, h - 1)
    same: NDArray[np.bool_] = np.abs(depth[row, col] - z) < 0.012 * z + 0.5
    return same


def open_stream(
    config: TrainConfig, rank: int, count: int, generating: Future[None] | None
) -> BatchStream:
    """The batches of the process `rank` of a run's `count`. generating: writes missing shards
    meanwhile.
    """
    data = config.data
    if isinstance(data, DataSection):
        shards = schedule(data)
        return ShardStream(shards, config.optimizer, config.seed, rank, generating)
    return LiveStream(config, rank, count)


def schedule(data: DataSection) -> Schedule:
    """Which shards each step of a run draws from."""
    seeds = range(data.first_seed, data.first_seed + data.scenes)
    worlds = range(FIRST_WORLD_SEED, FIRST_WORLD_SEED + data.worlds)
    return Schedule(
        tuple(shard_path(data.shards, seed) for seed in seeds),
        data.initial_scenes,
        data.scenes_per_step,
        tuple(path for seed in worlds for path in world_shard_paths(data.shards, seed)),
        data.world_share,
        data.world_first_step,
    )


_SPARE = 1.25  # candidates for each sample: some see too little in common


class LiveStream(BatchStream):
    """Makes batches like `ShardStream`, from pairs rendered on demand. rank: of this process among
    `count`. The oldest of the places is replaced every `steps_per_scene` steps.
    """

    def __init__(self, config: TrainConfig, rank: int = 0, count: int = 1) -> None:
        super().__init__()
        assert isinstance(config.data, LiveSection)
        self._data = config.data
        self._scenes, self._photos = self._data.scene_config(), self._data.library()
        self._optimizer, self._seed = config.optimizer, config.seed
        self._rank, self._count = rank, count
        workers = self._data.workers
        # Forked processes would inherit a GPU's context, which does not work in them.
        self._makers = ProcessPoolExecutor(workers, get_context("spawn"), initializer=low_priority)
        self._renderers = ThreadPoolExecutor(workers)
        self._coming: dict[int, Future[PlaceVisits]] = {}
        self._places: dict[int, PlaceVisits] = {}

    def close(self) -> None:
        """End the processes that make places, and the threads; does not wait for them."""
        super().close()
        for pool in (self._renderers, self._makers):
            pool.shutdown(wait=False, cancel_futures=True)

    def _make(self, step: int) -> Batch:
        self._load_places(step)
        rng = np.random.default_rng((self._seed, self._rank, step))
        samples: list[TrainingSample] = []
        while len(samples) < self._optimizer.batch:
            missing = self._optimizer.batch - len(samples)
            draws = rng.spawn(int(missing * _SPARE) + 1)
            made = self._renderers.map(partial(self._sample, self._window(step)), draws)
            samples += [sample for sample in made if sample is not None]
        return collate(samples[: self._optimizer.batch])

    def _window(self, step: int) -> range:
        """Running numbers of a step's places."""
        first = step // self._data.steps_per_scene
        return range(first, first + self._data.active)

    def _place_seed(self, number: int) -> int:
        """Seed of a place by its running number; those of the processes differ."""
        own = number * self._count + self._rank
        return self._data.first_seed + own % self._data.scenes

    def _load_places(self, step: int) -> None:
        """Wait for the step's places; begin to make later ones."""
        window = self._window(step)
        for number in range(window.start, window.stop + self._data.workers):
            if number not in self._places and number not in self._coming:
                seed = self._place_seed(number)
                self._coming[number] = self._makers.submit(
                    make_place, seed, self._scenes, self._photos, self._data.flight_days
                )
        self._places = {k: v for k, v in self._places.items() if k in window}
        for number in window:
            if number not in self._places:
                self._places[number] = self._coming.pop(number).result()

    def _sample(self, numbers: range, rng: np.random.Generator) -> TrainingSample | None:
        """A pair of one of the places; None if its views see too little in common."""
        place = self._places[int(rng.choice(numbers))]
        lit, visit, season = place.days[int(rng.integers(self._data.flight_days))]
        views = draw_views(rng, place.survey, lit, self._scenes)
        if views is None:
            return None
        pair = render_pair(place.survey, lit, views, visit, place.source, season=season)
        return crop_pair(pair, self._optimizer, rng)
