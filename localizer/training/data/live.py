"""Pairs rendered while training, on the device that trains: places come from processes, views,
light, weather and sensor from torch.

The pairs are of the kind that `training.data.shards` keeps on disk, which 10^5 pairs at 512
pixels would fill with some 300 GB. Which places and views a step sees depends on seed, rank and
step alone, so that a run resumes exactly; pixels agree as far as the device repeats its arithmetic.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from typing import Any

import numpy as np
import torch

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.synth.appearance.model import sample_appearance
from localizer.synth.appearance.model_torch import apply_appearance
from localizer.synth.heightfield.render_torch import ScenePool, render
from localizer.training.data.batches import (
    LoaderConfig,
    TrainingSample,
    collate,
    limit_haze,
    survey_appearance,
    window_pair,
)
from localizer.training.data.lit_places import PlaceVisits, low_priority, make_place
from localizer.training.data.pairs import Pair, SceneConfig, draw_views
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
        """Running numbers of a step's places; place k uses slot ``k % active``."""
        first = step // self.steps_per_place
        return range(first, first + self.active)

    def seed(self, number: int, rank: int, count: int) -> int:
        """Seed of place `number` of process `rank` of `count`; the processes' seeds differ."""
        return self.first_seed + (number * count + rank) % self.places


class LiveStream:
    """Makes batches like `training.data.batches.ShardStream`, from pairs rendered on demand."""

    def __init__(
        self,
        plan: LivePlan,
        scenes: SceneConfig,
        photos: PhotoSource | None,
        loader: LoaderConfig,
        seed: int,
        device: torch.device,
        *,
        rank: int = 0,
        count: int = 1,
        workers: int = 1,
    ) -> None:
        self._plan, self._scenes, self._photos = plan, scenes, photos
        self._loader, self._seed, self._rank, self._count = loader, seed, rank, count
        self._ahead = workers
        # Forked processes would inherit a GPU's context, which does not work in them.
        self._makers = ProcessPoolExecutor(workers, get_context("spawn"), initializer=low_priority)
        self._views = plan.flight_days + 1  # slots of a place: its survey and its days
        self._pool = ScenePool(plan.active * self._views, scenes.cells, device)
        self._coming: dict[int, Future[PlaceVisits]] = {}
        self._places: dict[int, PlaceVisits] = {}
        self._thread = ThreadPoolExecutor(1)
        self._next: tuple[int, Future[Batch]] | None = None

    @property
    def device(self) -> torch.device:
        """Where the pairs are rendered."""
        return self._pool.device

    def batch(self, step: int) -> Batch:
        """The batch of a step; a thread prepares the next one meanwhile."""
        if self._next is not None and self._next[0] == step:
            current = self._next[1]
        else:
            current = self._thread.submit(self._make, step)
        self._next = (step + 1, self._thread.submit(self._make, step + 1))
        return current.result()

    def close(self) -> None:
        """End the thread and the processes; does not wait for them."""
        self._thread.shutdown(wait=False, cancel_futures=True)
        self._makers.shutdown(wait=False, cancel_futures=True)

    def _make(self, step: int) -> Batch:
        self.load_places(step)
        key = (self._seed, self._rank, step)
        rng = np.random.default_rng(key)
        noise = torch.Generator(self._pool.device)
        noise.manual_seed(int(rng.integers(2**62)))
        samples: list[TrainingSample] = []
        while len(samples) < self._loader.batch:
            missing = self._loader.batch - len(samples)
            for pair in self.pairs(step, int(missing * _SPARE) + 1, rng, noise):
                made = window_pair(pair, self._loader, rng)
                if made is not None:
                    samples.append(made)
        return collate(samples[: self._loader.batch])

    def load_places(self, step: int) -> None:
        """Wait for the step's places and copy them into their slots; begin to make later ones."""
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
                self.take(number, self._coming.pop(number).result())

    def take(self, number: int, place: PlaceVisits) -> None:
        """Put the place of a running number into its slot."""
        self._places[number] = place
        first = number % self._plan.active * self._views
        for k, scene in enumerate((place.survey, *(day[0] for day in place.days))):
            self._pool.put(first + k, scene)

    def pairs(
        self, step: int, count: int, rng: np.random.Generator, noise: torch.Generator
    ) -> Iterator[Pair]:
        """Up to `count` pairs of the step's places, which are loaded; degraded if `appearance`."""
        numbers = self._plan.window(step)
        drawn: list[tuple[int, int, Pose, Pose, Camera]] = []
        for _ in range(count):
            number = int(rng.choice(numbers))
            place, day = self._places[number], int(rng.integers(self._plan.flight_days))
            views = draw_views(rng, place.survey, place.days[day][0], self._scenes)
            if views is not None:
                drawn.append((number, day, *views))
        if not drawn:
            return
        slots = [number % self._plan.active * self._views for number, *_ in drawn]
        cameras = [camera for *_, camera in drawn]
        maps, map_depths = render(self._pool, slots, [d[2] for d in drawn], cameras)
        slots = [slot + 1 + d[1] for slot, d in zip(slots, drawn, strict=True)]
        seen, seen_depths = render(self._pool, slots, [d[3] for d in drawn], cameras, supersample=2)
        for k, (number, day, reference, query, camera) in enumerate(drawn):
            place = self._places[number]
            _, visit, season = place.days[day]
            clean = Pair(
                _host(maps[k]), _host(map_depths[k]), _host(seen[k]), _host(seen_depths[k]),
                reference, query, camera, visit.weather, visit.outdated, place.source, season,
            )  # fmt: skip
            if not self._loader.appearance:
                yield clean
                continue
            look = limit_haze(sample_appearance(rng, visit.weather), clean.query_depth)
            shown = apply_appearance(seen[k], seen_depths[k], look, rng, noise)
            survey = survey_appearance(rng)
            known = maps[k]
            if survey is not None:
                known = apply_appearance(known, map_depths[k], survey, rng, noise)
            yield replace(clean, reference=_host(known), query=_host(shown))


def _host(tensor: torch.Tensor) -> Any:
    return tensor.cpu().numpy()
