"""Pairs rendered while training: processes make the places, threads render the views.

The pairs are of the kind that `training.data.shards` keeps on disk, which 10^5 pairs at 512
pixels would fill with some 300 GB. Which places and views a step sees depends on seed, rank and
step alone, so that a run resumes exactly.
"""

from __future__ import annotations

from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context

import numpy as np

from localizer.training.data.batches import (
    BatchStream,
    LoaderConfig,
    TrainingSample,
    collate,
    crop_pair,
)
from localizer.training.data.lit_places import PlaceVisits, low_priority, make_place
from localizer.training.data.pairs import SceneConfig, draw_views, render_pair
from localizer.training.data.shards import PhotoSource
from localizer.training.losses import Batch

_SPARE = 1.25  # candidates for each sample: some see too little in common


@dataclass(frozen=True)
class LivePlan:
    """Schedule of the places that training steps draw from. active: number of places at a time; the
    oldest is replaced every `steps_per_place` steps. places: number of different places;
    flight_days: per place.
    """

    first_seed: int
    places: int
    active: int
    steps_per_place: int
    flight_days: int

    def window(self, step: int) -> range:
        """Running numbers of a step's places."""
        first = step // self.steps_per_place
        return range(first, first + self.active)

    def seed(self, number: int, rank: int, count: int) -> int:
        """Seed of place `number` of process `rank` of `count`; the processes' seeds differ."""
        return self.first_seed + (number * count + rank) % self.places


class LiveStream(BatchStream):
    """Makes batches like `ShardStream`, from pairs rendered on demand."""

    def __init__(  # noqa: PLR0913
        self,
        plan: LivePlan,
        scenes: SceneConfig,
        photos: PhotoSource | None,
        loader: LoaderConfig,
        seed: int,
        *,
        rank: int = 0,
        count: int = 1,
        workers: int = 1,
    ) -> None:
        super().__init__()
        self._plan, self._scenes, self._photos = plan, scenes, photos
        self._loader, self._seed, self._rank, self._count = loader, seed, rank, count
        self._ahead = workers
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
        while len(samples) < self._loader.batch:
            missing = self._loader.batch - len(samples)
            draws = rng.spawn(int(missing * _SPARE) + 1)
            made = self._renderers.map(partial(self._sample, self._plan.window(step)), draws)
            samples += [sample for sample in made if sample is not None]
        return collate(samples[: self._loader.batch])

    def _load_places(self, step: int) -> None:
        """Wait for the step's places; begin to make later ones."""
        window = self._plan.window(step)
        for number in range(window.start, window.stop + self._ahead):
            if number not in self._places and number not in self._coming:
                seed = self._plan.seed(number, self._rank, self._count)
                self._coming[number] = self._makers.submit(
                    make_place, seed, self._scenes, self._photos, self._plan.flight_days
                )
        self._places = {k: v for k, v in self._places.items() if k in window}
        for number in window:
            if number not in self._places:
                self._places[number] = self._coming.pop(number).result()

    def _sample(self, numbers: range, rng: np.random.Generator) -> TrainingSample | None:
        """A pair of one of the places; None if its views see too little in common."""
        place = self._places[int(rng.choice(numbers))]
        lit, visit, season = place.days[int(rng.integers(self._plan.flight_days))]
        views = draw_views(rng, place.survey, lit, self._scenes)
        if views is None:
            return None
        pair = render_pair(place.survey, lit, views, visit, place.source, season=season)
        return crop_pair(pair, self._loader, rng)
