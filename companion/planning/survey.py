"""Computes the forecasts along a mission, in several threads."""

from __future__ import annotations

import itertools
import os
import queue
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager

from companion.config import CompanionConfig
from companion.planning.verdicts import MissionLimits, SampleVerdict, sample_verdict
from companion.planning.way import Aim, PathSample, camera_pose
from localizer.features.detail import DetailExtractor
from localizer.features.extractor import load_extractor
from localizer.forecast.forecast import Forecaster
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.registration.jngo import JNGO
from localizer.render.numba_raster import NumbaRenderer

Progress = Callable[[int, int], None]
_MOST_THREADS = 8


class Surveyor:
    """Forecasts path samples in threads; create it by `surveyor`.

    Each thread uses its own forecaster, because a renderer, network or optimizer serves one thread
    at a time.
    """

    def __init__(
        self,
        cache: TileCache,
        aim: Aim,
        conditions: tuple[str, ...],
        limits: MissionLimits,
        forecasters: Sequence[Forecaster],
    ) -> None:
        self._cache, self._aim = cache, aim
        self._conditions, self._limits = conditions, limits
        self._idle: queue.SimpleQueue[Forecaster] = queue.SimpleQueue()
        for forecaster in forecasters:
            self._idle.put(forecaster)
        self._threads = len(forecasters)

    def verdicts(
        self, samples: Sequence[PathSample], progress: Progress | None = None
    ) -> list[SampleVerdict]:
        """Forecast the samples under all conditions, in their order; deterministic."""
        made = []
        with ThreadPoolExecutor(self._threads, "forecast") as pool:
            for done, judged in enumerate(pool.map(self._one, itertools.count(), samples), 1):
                made.append(judged)
                if progress is not None:
                    progress(done, len(samples))
        return made

    def _one(self, number: int, sample: PathSample) -> SampleVerdict:
        pose = camera_pose(sample, self._cache, self._aim)
        forecaster = self._idle.get()
        try:
            return sample_verdict(
                sample, forecaster.at(pose, self._conditions, number), self._limits
            )
        finally:
            self._idle.put(forecaster)


@contextmanager
def surveyor(
    cache: TileCache,
    deployment: CompanionConfig,
    aim: Aim,
    conditions: tuple[str, ...],
    limits: MissionLimits,
) -> Iterator[Surveyor]:
    """Context manager: a surveyor over an open map, one thread per available processor.

    It computes on the CPU, so that every machine forecasts alike.
    """
    threads = min(len(os.sched_getaffinity(0)), _MOST_THREADS)
    config, camera = deployment.localizer, deployment.camera.model.camera()
    forecasters = []
    with ExitStack() as stack:
        for _ in range(threads):
            budget = config.cache_mib * 2**20 // threads
            streamer = stack.enter_context(TileStreamer(cache, byte_budget=budget))
            renderer = NumbaRenderer(streamer, 1)
            stack.callback(renderer.close)
            extractor = DetailExtractor(load_extractor(config.model, threads=1))
            optimizer = JNGO(config.registration, threads=1)
            forecasters.append(Forecaster(renderer, extractor, optimizer, camera, config))
        yield Surveyor(cache, aim, conditions, limits, forecasters)
