"""One frame against the whole map: search, then confirmation. Plain calls, no threads of its own
beyond `RelocalizationConfig.threads`, so that the caller decides when and how urgently it runs.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np

from localizer.config import LocalizerConfig
from localizer.features.detail import DetailExtractor
from localizer.features.extractor import FeatureExtractor, load_extractor
from localizer.geometry.camera import Camera
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.registration.jngo import JNGO
from localizer.registration.result import Registration
from localizer.relocalization.correlate import LevelCorrelator
from localizer.relocalization.overview import MapOverview, Progress, open_overview
from localizer.relocalization.search import View, search
from localizer.relocalization.types import PlaceCandidate, PlaceQuery, Relocalization
from localizer.relocalization.verify import Verifier
from localizer.render.base import MapRenderer
from localizer.render.numba_raster import NumbaRenderer
from localizer.tracking.pipeline import Undistorter, working_camera
from localizer.types import FeaturePyramid, PosePrior

_SEARCH_WIDTH = 480  # px of the frame that the ground is rectified from
_BLUR_PX = 0.6  # the map is sampled more coarsely than the frame
_LEAST_JUDGED = 3  # candidates
_NEARLY = 0.8  # of the winner's correlation: a place that has to be looked at, too
_SAME_PLACE_M = 5.0  # answers that are closer are one


@dataclass(frozen=True)
class Judged:
    """A candidate after registration. prior: what the next pass begins from."""

    candidate: PlaceCandidate
    rank: int
    result: Registration
    prior: PosePrior
    credible: bool


class Relocalizer:
    """Finds a camera on a map from one frame. One thread uses it at a time.

    extractor: the network without the detail level. Everything that is handed in stays the
    caller's; the renderer must be no other thread's.
    """

    def __init__(
        self,
        renderer: MapRenderer,
        extractor: FeatureExtractor,
        optimizer: JNGO,
        overview: MapOverview,
        config: LocalizerConfig,
    ) -> None:
        self.overview = overview
        self.extractor = extractor
        self._config = config.relocalization
        self._width = config.width
        self._detail = DetailExtractor(extractor)
        self._verifier = Verifier(
            renderer, self._detail, optimizer, self._config, config.anchors, config.seed
        )
        budget = self._config.spectra_mib * 2**20
        self._correlators = tuple(LevelCorrelator(x, budget) for x in overview.levels)
        for correlator in self._correlators:
            correlator.warm_up()
        for channels in (overview.levels[0].projection.mean.size, 4):
            optimizer.warm_up(channels)
        renderer.warm_up()
        self._undistorters: dict[tuple[Camera, int], Undistorter] = {}

    def find(
        self, query: PlaceQuery, should_stop: Callable[[], bool] = lambda: False
    ) -> Relocalization | None:
        """The camera's pose with the evidence for it; None where nothing convinces, or stopped."""
        began = time.perf_counter()
        candidates = self.search(query, should_stop)
        searched = time.perf_counter() - began
        found = self.confirm(query, candidates, should_stop)
        if found is None:
            return None
        return replace(found, stage_s={"search": searched, **found.stage_s})

    def confirm(
        self,
        query: PlaceQuery,
        candidates: list[PlaceCandidate],
        should_stop: Callable[[], bool] = lambda: False,
    ) -> Relocalization | None:
        """The candidate that registration confirms, if it does so for one."""
        began = time.perf_counter()
        judged = self.verify(query, candidates, should_stop) if candidates else []
        stages = {"confirm": time.perf_counter() - began}
        return self._answer(query, candidates, judged, stages) if judged else None

    def search(
        self, query: PlaceQuery, should_stop: Callable[[], bool] = lambda: False
    ) -> list[PlaceCandidate]:
        """The places that look most like the frame from above, best first; none if stopped."""
        camera = working_camera(query.frame.camera, min(_SEARCH_WIDTH, query.frame.camera.width))
        image = cv2.GaussianBlur(self._undistorted(query, camera), (0, 0), _BLUR_PX)
        view = View(image.astype(np.uint8, copy=False), camera)
        threads = self._config.threads
        pool = ThreadPoolExecutor(threads, "place-search") if threads > 1 else None
        try:
            found = search(
                view, query, self._correlators, self.extractor, self._config,
                pool=pool, should_stop=should_stop,
            )  # fmt: skip
        finally:
            if pool is not None:
                pool.shutdown(cancel_futures=True)
        return found or []

    def verify(
        self,
        query: PlaceQuery,
        candidates: list[PlaceCandidate],
        should_stop: Callable[[], bool] = lambda: False,
    ) -> list[Judged]:
        """The candidates registered: all once, those that can win to the end; best first."""
        camera = working_camera(query.frame.camera, self._width)
        features = self._detail.extract(self._undistorted(query, camera))
        judged: list[Judged] = []
        for rank, candidate in enumerate(candidates[: self._config.candidates]):
            if should_stop():
                return []
            prior = self._verifier.prior(candidate, query)
            judged.append(self._judge(features, camera, query, candidate, rank, prior))
            if self._is_settled(judged, candidates[rank + 1 :]):
                break
        order = sorted(judged, key=lambda j: -j.result.quality)
        final = []
        for k, first in enumerate(order):
            j = first
            hopeless = k > 0 and j.result.quality < 0.5 * order[0].result.quality
            hopeless = hopeless or k >= self._config.finalists
            for _ in range(0 if hopeless else self._config.passes - 1):
                if should_stop():
                    return []
                if not math.isfinite(j.result.score):
                    break
                prior = self._verifier.again(j.prior, j.result)
                j = self._judge(features, camera, query, j.candidate, j.rank, prior)
            final.append(j)
        return sorted(final, key=lambda j: (-int(j.credible), -j.result.quality))

    def _is_settled(self, judged: list[Judged], left: list[PlaceCandidate]) -> bool:
        """Whether the rest need not be looked at: one of the first few is decisive, and nowhere
        else does the ground look nearly as much like the frame, as among equal roofs it does.
        """
        decisive = [j.candidate.score for j in judged if self._is_decisive(j)]
        if len(judged) < _LEAST_JUDGED or not decisive:
            return False
        return all(c.score < _NEARLY * max(decisive) for c in left)

    def _is_decisive(self, judged: Judged) -> bool:
        """Whether no other candidate can be better: all but a few parts of the image agree."""
        votes = judged.result.agreement
        least = self._config.decisive_agreement
        return judged.credible and votes is not None and votes.share >= least

    def _judge(
        self,
        features: FeaturePyramid,
        camera: Camera,
        query: PlaceQuery,
        candidate: PlaceCandidate,
        rank: int,
        prior: PosePrior,
    ) -> Judged:
        result = self._verifier.register(features, camera, prior, query)
        credible = self._verifier.is_credible(result, candidate, query)
        return Judged(candidate, rank, result, prior, credible)

    def _answer(
        self,
        query: PlaceQuery,
        candidates: list[PlaceCandidate],
        judged: list[Judged],
        stages: dict[str, float],
    ) -> Relocalization | None:
        best = judged[0]
        place = best.result.world_from_camera.translation
        rivals = [
            j.result.quality
            for j in judged[1:]
            if j.credible
            and np.linalg.norm(j.result.world_from_camera.translation - place) > _SAME_PLACE_M
        ]
        rival = max(rivals, default=0.0)
        if not best.credible or best.result.quality < rival + self._config.margin:
            return None
        # Candidates that registration brings to one place are one: its score is the best of theirs.
        same = {
            j.rank
            for j in judged
            if np.linalg.norm(j.result.world_from_camera.translation - place) <= _SAME_PLACE_M
        }
        own = max(candidates[rank].score for rank in same)
        runner_up = max((c.score for k, c in enumerate(candidates) if k not in same), default=0.0)
        # Where other ground looks nearly as much like the frame, the right place may be none of the
        # candidates: half-agreeing parts are what the next of many equal roofs gives.
        if runner_up >= _NEARLY * own and not self._is_decisive(best):
            return None
        return Relocalization(
            best.result.world_from_camera,
            best.result.covariance,
            query.frame.exposure_time_ns,
            best.result.quality,
            best.result.overlap,
            own,
            runner_up,
            best.rank,
            rival,
            stages,
        )

    def _undistorted(self, query: PlaceQuery, camera: Camera) -> np.ndarray:
        key = (query.frame.camera, camera.width)
        if key not in self._undistorters:
            self._undistorters[key] = Undistorter(query.frame.camera, camera)
        return self._undistorters[key](query.frame)


class OpenRelocalizer:
    """A relocalizer with a renderer, network and optimizer of its own; close it when done."""

    def __init__(self, relocalizer: Relocalizer, streamer: TileStreamer, renderer: MapRenderer):
        self.relocalizer = relocalizer
        self._streamer = streamer
        self._renderer = renderer

    def close(self) -> None:
        """Release the renderer and stop the loader thread."""
        self._renderer.close()
        self._streamer.close()

    def __enter__(self) -> Relocalizer:
        """The relocalizer, closed at the end of the block."""
        return self.relocalizer

    def __exit__(self, *_: object) -> None:
        self.close()


def open_relocalizer(
    cache: TileCache,
    config: LocalizerConfig,
    *,
    progress: Progress = lambda _done, _total: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> OpenRelocalizer | None:
    """Everything that a search needs, apart from the tracker's own parts, so that neither waits for
    the other; the map's overview is computed now if it is not there. None if stopped before.
    """
    c = config.relocalization
    streamer = TileStreamer(cache, byte_budget=c.cache_mib * 2**20)
    renderer = NumbaRenderer(streamer, c.threads)
    try:
        extractor = load_extractor(config.model, threads=1)
        overview = open_overview(
            cache, renderer, extractor, progress=progress, should_stop=should_stop
        )
        if overview is not None:
            optimizer = JNGO(config.registration, "numba", c.threads)
            relocalizer = Relocalizer(renderer, extractor, optimizer, overview, config)
            return OpenRelocalizer(relocalizer, streamer, renderer)
    except BaseException:
        renderer.close()
        streamer.close()
        raise
    renderer.close()
    streamer.close()
    return None


__all__ = ["Judged", "OpenRelocalizer", "Relocalizer", "open_relocalizer"]
