"""Pairs rendered while training: processes make the places, threads render the views.

The pairs are of the kind that `training.data.shards` keeps on disk, which 10^5 pairs at 512
pixels would fill with some 300 GB. Which places and views a step sees depends on seed, rank and
step alone, so that a run resumes exactly.
"""

from __future__ import annotations

from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import get_context

import numpy as np

from localizer.training.config import DataSection, LiveSection, TrainConfig
from localizer.training.data.batches import (
    BatchStream,
    Schedule,
    ShardStream,
    TrainingSample,
    collate,
    crop_pair,
)
from localizer.training.data.pairs import (
    FIRST_WORLD_SEED,
    PlaceVisits,
    draw_views,
    low_priority,
    make_place,
    render_pair,
)
from localizer.training.data.shards import shard_path, world_shard_paths
from localizer.training.losses import Batch


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
