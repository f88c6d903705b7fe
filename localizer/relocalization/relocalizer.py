"""One frame against the whole map: search, then confirmation. Plain calls, no threads of its own
beyond `RelocalizationConfig.threads`, so that the caller decides when and how urgently it runs.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

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
from localizer.relocalization.align import FrameShift
from localizer.relocalization.correlate import LevelCorrelator
from localizer.relocalization.overview import MapOverview, Progress, open_overview
from localizer.relocalization.search import View, search
from localizer.relocalization.types import PlaceCandidate, PlaceQuery, Relocalization
from localizer.relocalization.verdict import NEARLY, Judged, answer, is_decisive
from localizer.relocalization.verify import Aligned, Verifier
from localizer.render.base import MapRenderer
from localizer.render.numba_raster import NumbaRenderer
from localizer.tracking.pipeline import Undistorter, working_camera
from localizer.types import FeaturePyramid, PosePrior

_SEARCH_WIDTH = 480  # px of the frame that the ground is rectified from
_BLUR_PX = 0.6  # the map is sampled more coarsely than the frame
# Grey levels (sigma) without fine noise. A covered lens has 0.5 and kept a busy computer searching
# until long after the cover was gone; the dullest of 190 views at night, dusk and fog has 1.8.
_COARSE_PX, _LEAST_CONTRAST = 2.0, 1.0
_LEAST_JUDGED = 3  # candidates


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
        return answer(query, candidates, judged, self._config, stages) if judged else None

    def search(
        self, query: PlaceQuery, should_stop: Callable[[], bool] = lambda: False
    ) -> list[PlaceCandidate]:
        """The places that look most like the frame from above, best first; none if stopped, or
        where the frame shows nothing.
        """
        camera = working_camera(query.frame.camera, min(_SEARCH_WIDTH, query.frame.camera.width))
        image = cv2.GaussianBlur(self._undistorted(query, camera), (0, 0), _BLUR_PX)
        if (
            float(cv2.GaussianBlur(image, (0, 0), _COARSE_PX).std(axis=(0, 1)).max())
            < _LEAST_CONTRAST
        ):
            return []
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
        first = self._first_pass(features, camera, query, candidates, should_stop)
        order = sorted(first, key=lambda j: -j.result.quality)
        final = []
        for k, begun in enumerate(order):
            j = begun
            hopeless = k > 0 and j.result.quality < 0.5 * order[0].result.quality
            hopeless = hopeless or k >= self._config.finalists
            for _ in range(0 if hopeless else self._config.passes - 1):
                if should_stop():
                    return []
                if not math.isfinite(j.result.score):
                    break
                prior = self._verifier.again(j.prior, j.result)
                result = self._verifier.register(features, camera, prior, query)
                j = self._judged(result, query, j.candidate, j.rank, prior)
            final.append(j)
        return sorted(final, key=lambda j: (-int(j.credible), -j.result.quality))

    def _first_pass(
        self,
        features: FeaturePyramid,
        camera: Camera,
        query: PlaceQuery,
        candidates: list[PlaceCandidate],
        should_stop: Callable[[], bool],
    ) -> list[Judged]:
        """Each aligned and registered; where none convinces, the best aligned from all sides. None
        if stopped.
        """
        frame = FrameShift(features.levels)
        judged: list[Judged] = []
        places: list[Aligned] = []
        for rank, candidate in enumerate(candidates[: self._config.candidates]):
            if should_stop():
                return []
            place = self._verifier.aligned(frame, camera, self._verifier.prior(candidate, query))
            result = self._verifier.register(features, camera, place.prior, query, place.reference)
            judged.append(self._judged(result, query, candidate, rank, place.prior))
            places.append(replace(place, reference=None))  # of so many, they are large
            if self._is_settled(judged, candidates[rank + 1 :]):
                break
        if any(j.credible for j in judged):
            return judged
        best = sorted(range(len(judged)), key=lambda k: -places[k].score)
        for k in best[: self._config.finalists]:
            if should_stop():
                return []
            result = self._verifier.around(features, camera, places[k], query)
            if result.quality > judged[k].result.quality:
                candidate = judged[k].candidate
                judged[k] = self._judged(result, query, candidate, k, places[k].prior)
        return judged

    def _is_settled(self, judged: list[Judged], left: list[PlaceCandidate]) -> bool:
        """Whether the rest need not be looked at: one of the first few is decisive, and nowhere
        else does the ground look nearly as much like the frame, as among equal roofs it does.
        """
        decisive = [j.candidate.score for j in judged if is_decisive(j, self._config)]
        if len(judged) < _LEAST_JUDGED or not decisive:
            return False
        return all(c.score < NEARLY * max(decisive) for c in left)

    def _judged(
        self,
        result: Registration,
        query: PlaceQuery,
        candidate: PlaceCandidate,
        rank: int,
        prior: PosePrior,
    ) -> Judged:
        credible = self._verifier.is_credible(result, candidate, query)
        return Judged(candidate, rank, result, prior, credible)

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
