"""Finds one frame on the whole map: search, then confirmation. It starts no threads beyond
`RelocalizationConfig.threads`; the caller decides when it runs.
"""

from __future__ import annotations

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
from localizer.integrity.height_error import MapHeightError
from localizer.integrity.patch_covariance import COMMON
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.map.inspection.kind import map_kind
from localizer.registration.jngo import JNGO
from localizer.relocalization.align import FrameShift
from localizer.relocalization.confirm import Confirmation, competitors
from localizer.relocalization.correlate import LevelCorrelator
from localizer.relocalization.overview import STRIDE, MapOverview, Progress, open_overview
from localizer.relocalization.search import (
    LEAST_HEIGHT_M,
    SearchView,
    above_roofs,
    ground_of,
    search,
)
from localizer.relocalization.strip import GroundStrip, GroundView, lay_together
from localizer.relocalization.types import (
    EarlierFrame,
    PlaceCandidate,
    PlaceQuery,
    Relocalization,
)
from localizer.relocalization.verdict import VerifiedCandidate, decide
from localizer.relocalization.verify import QueryFeatures, Verifier
from localizer.render.base import MapRenderer
from localizer.render.numba_raster import NumbaRenderer
from localizer.tracking.pipeline import Undistorter, working_camera
from localizer.types import Frame, Image

SEARCH_WIDTH = 480  # px of the frame that the ground is rectified from
_SCREEN_WIDTH = 160  # px, at which all candidates are rendered
_BLUR_PX = 0.6  # the map is sampled more coarsely than the frame
# Grey levels (sigma) without fine noise. A covered lens has 0.5 and kept a busy computer searching
# until long after the cover was gone; the dullest of 190 views at night, dusk and fog has 1.8.
_COARSE_PX, _LEAST_CONTRAST = 2.0, 1.0
_MOST_UNDISTORTERS = 8


class Relocalizer:
    """Finds the position of one frame's camera on a map. One thread uses it at a time.

    extractor: the network without the detail level; coarse: its levels from the overview's stride
    on, in a third of the time. The caller closes all arguments; no other thread may use the
    renderer. height_sigma_m: RMS of the object heights that the map lacks. should_stop: called
    all the time; True cancels.
    """

    def __init__(
        self,
        renderer: MapRenderer,
        extractor: FeatureExtractor,
        coarse: FeatureExtractor,
        optimizer: JNGO,
        overview: MapOverview,
        config: LocalizerConfig,
        height_sigma_m: float = 0.0,
    ) -> None:
        self.overview = overview
        self.extractor = coarse
        self._config = config.relocalization
        self._width = config.width
        self._missing_m = COMMON * height_sigma_m  # mean of what the map lacks
        self._detail = DetailExtractor(extractor)
        self._verifier = Verifier(
            renderer, self._detail, coarse, optimizer, self._config, config.integrity,
            height_sigma_m, config.anchors, config.seed,
        )  # fmt: skip
        budget = self._config.spectra_mib * 2**20 // 2  # a frame's level, and a strip's
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
        """The camera's pose with its evidence; None if no candidate convinces, or if cancelled."""
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
        """Register the query at the candidates, and return the position that is clearly better than
        all others; None if there is none, or if should_stop() became true.
        """
        began = time.perf_counter()
        registered = self.verify(query, candidates, should_stop) if candidates else []
        stages = {"confirm": time.perf_counter() - began}
        if not registered:
            return None
        return decide(query, competitors(candidates, registered), registered, stages)

    def search(
        self, query: PlaceQuery, should_stop: Callable[[], bool] = lambda: False
    ) -> list[PlaceCandidate]:
        """The most similar positions, in the order of `search.search`; empty if cancelled, without
        any, and for a frame without contrast (covered lens).
        """
        image, camera = self._ground_image(query.frame)
        if (
            float(cv2.GaussianBlur(image, (0, 0), _COARSE_PX).std(axis=(0, 1)).max())
            < _LEAST_CONTRAST
        ):
            return []
        over = above_roofs(query, self.overview.levels[0], self._missing_m, self._config)
        view = SearchView(image, camera, lambda: self._strip(over))
        threads = self._config.threads
        pool = ThreadPoolExecutor(threads, "place-search") if threads > 1 else None
        try:
            found = search(
                view, over, self._correlators, self.extractor, self._config,
                pool=pool, should_stop=should_stop,
            )  # fmt: skip
        finally:
            if pool is not None:
                pool.shutdown(cancel_futures=True)
        return found or []

    def _ground_image(self, frame: Frame) -> tuple[Image, Camera]:
        """What the ground is rectified from, and its pinhole."""
        camera = working_camera(frame.camera, min(SEARCH_WIDTH, frame.camera.width))
        image = cv2.GaussianBlur(self._undistorted(frame, camera), (0, 0), _BLUR_PX)
        return image.astype(np.uint8, copy=False), camera

    def _strip(self, query: PlaceQuery) -> GroundStrip | None:
        """The query's frame and the earlier ones laid together; None without any."""
        if not query.earlier:
            return None
        ground = float(np.nanmedian(ground_of(self.overview.levels[0], query)))
        above = max(query.height_m - ground, LEAST_HEIGHT_M)
        now = EarlierFrame(query.frame, query.rotation, 0.0)
        views = [
            GroundView(*self._ground_image(x.frame), x.rotation, above + x.higher_m)
            for x in (now, *query.earlier)
        ]
        larger = max(1.0, above / 120.0)
        return lay_together(
            views, larger * self._config.strip_m, larger * self.overview.levels[0].gsd_m
        )

    def verify(
        self,
        query: PlaceQuery,
        candidates: list[PlaceCandidate],
        should_stop: Callable[[], bool] = lambda: False,
    ) -> list[VerifiedCandidate]:
        """The registered candidates, best first and refined to the end; empty if cancelled."""
        full, small = self._sights(query)
        return Confirmation(
            self._verifier, full, small, query, candidates, self._config, should_stop
        ).run()

    def _sights(self, query: PlaceQuery) -> tuple[QueryFeatures, QueryFeatures]:
        """The frame's features at the tracker's size, and at the smaller size of the screening."""
        camera = working_camera(query.frame.camera, self._width)
        small = working_camera(query.frame.camera, min(_SCREEN_WIDTH, self._width))
        features = self._detail.extract(self._undistorted(query.frame, camera))
        few = self.extractor.extract(self._undistorted(query.frame, small))
        return (
            QueryFeatures(camera, features, FrameShift(features.levels)),
            QueryFeatures(small, few, FrameShift(few.levels)),
        )

    def _undistorted(self, frame: Frame, camera: Camera) -> np.ndarray:
        key = (frame.camera, camera.width)
        if key not in self._undistorters:
            if len(self._undistorters) >= _MOST_UNDISTORTERS:  # a camera that zooms
                self._undistorters.clear()
            self._undistorters[key] = Undistorter(frame.camera, camera)
        return self._undistorters[key](frame)


class OpenRelocalizer:
    """A relocalizer with its own renderer, network and optimizer; close it when done."""

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
    """Open a relocalizer with its own renderer and network, so that it and the tracker do not wait
    for each other. Computes the map's overview if it is missing, and stores it (`open_overview`,
    also for its arguments and errors). None if cancelled.
    """
    c = config.relocalization
    streamer = TileStreamer(cache, byte_budget=c.cache_mib * 2**20)
    renderer = NumbaRenderer(streamer, c.threads)
    try:
        extractor = load_extractor(config.model, threads=1)
        coarse = load_extractor(config.model, threads=1, finest=STRIDE)
        overview = open_overview(
            cache, renderer, coarse, progress=progress, should_stop=should_stop
        )
        if overview is not None:
            # Its places are laid over the map's picture first, so that the swarm reaches them.
            registration = replace(config.registration, preselected=0)
            optimizer = JNGO(registration, "numba", c.threads)
            height_sigma_m = MapHeightError.of_kind(map_kind(cache)).sigma_m
            relocalizer = Relocalizer(
                renderer, extractor, coarse, optimizer, overview, config, height_sigma_m
            )
            return OpenRelocalizer(relocalizer, streamer, renderer)
    except BaseException:
        renderer.close()
        streamer.close()
        raise
    renderer.close()
    streamer.close()
    return None


__all__ = ["OpenRelocalizer", "Relocalizer", "VerifiedCandidate", "open_relocalizer"]
