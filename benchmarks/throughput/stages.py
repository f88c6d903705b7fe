"""Processor time of each stage of a frame, on one thread, where nothing runs beside it."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from localizer.config import LocalizerConfig
from localizer.evaluation.sequences import Perturbation
from localizer.evaluation.sequences import Sequence as Recorded
from localizer.features.detail import DetailExtractor
from localizer.features.extractor import load_extractor
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.map.cache.tile import TileMesh
from localizer.registration.jngo import JNGO
from localizer.render.base import MapRenderer
from localizer.tracking.opening import MapStack
from localizer.tracking.pipeline import Localizer
from localizer.types import FeaturePyramid, Frame, Image, RenderedView

PASSES = 3  # over the first frame
_WARM = 5  # frames that are not counted


class Watch:
    """Milliseconds of the process's time on all threads (OpenVINO has its own) by stage."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = defaultdict(float)

    @contextmanager
    def of(self, stage: str) -> Iterator[None]:
        """Adds what is spent inside."""
        began = time.process_time()
        try:
            yield
        finally:
            self.spent[stage] += 1e3 * (time.process_time() - began)


class _Renderer(MapRenderer):
    def __init__(self, base: MapRenderer, watch: Watch) -> None:
        super().__init__(base.streamer)
        self._base, self._watch, self.name = base, watch, base.name

    def render(
        self,
        world_from_camera: Pose,
        camera: Camera,
        extra: Sequence[TileMesh] = (),
        *,
        wait: bool = False,
    ) -> RenderedView:
        with self._watch.of("render"):
            return self._base.render(world_from_camera, camera, extra, wait=wait)

    def draw(
        self, meshes: Sequence[TileMesh], world_from_camera: Pose, camera: Camera
    ) -> RenderedView:
        return self._base.draw(meshes, world_from_camera, camera)

    def close(self) -> None:
        self._base.close()


class _Extractor:
    """Counts an extraction under the half of the pipeline that asks for it."""

    def __init__(self, base: DetailExtractor, watch: Watch) -> None:
        self._base, self._watch, self.name = base, watch, base.name
        self.stage = "features of the reference"

    def extract(self, rgb: Image) -> FeaturePyramid:
        with self._watch.of(self.stage):
            return self._base.extract(rgb)


def stage_times(
    map_cache: MapStack, sequence: Recorded, config: LocalizerConfig
) -> dict[str, float]:
    """Mean milliseconds of processor a frame by stage, and "all"."""
    watch = Watch()
    extractor = _Extractor(DetailExtractor(load_extractor(config.model, threads=1)), watch)
    localizer = Localizer(
        _Renderer(map_cache.renderer, watch), extractor, JNGO(config.registration, threads=1),
        sequence.camera, config, map_frame=map_cache.cache.frame,
    )  # fmt: skip
    whole = 0.0
    for index in range(len(sequence.images)):
        frame = sequence.frame(index)
        if index == 0:
            time_ns = frame.exposure_time_ns
            localizer.set_prior(Perturbation(1.0, 1.0).prior(sequence.truth[0], 0, time_ns))
            localizer.track(frame, passes=PASSES)
            continue
        if index == _WARM:
            watch.spent.clear()
            whole = 0.0
        began = time.process_time()
        _track(localizer, extractor, watch, frame)
        whole += 1e3 * (time.process_time() - began)
    counted = len(sequence.images) - _WARM
    spent = {stage: ms / counted for stage, ms in watch.spent.items()}
    spent["anchors and holes"] = spent.pop("reference") - (
        spent["render"] + spent["features of the reference"]
    )
    spent["undistort and shrink"] = spent.pop("query") - spent["features of the frame"]
    spent["all"] = whole / counted
    return {stage: round(ms, 2) for stage, ms in spent.items()}


def _track(localizer: Localizer, extractor: _Extractor, watch: Watch, frame: Frame) -> None:
    """`Localizer.track`, stage by stage."""
    prior = localizer.predict(frame.exposure_time_ns)
    assert prior is not None, "the first frame began"
    extractor.stage = "features of the reference"
    with watch.of("reference"):
        bundle = localizer.make_reference(prior, wait=True)
    extractor.stage = "features of the frame"
    with watch.of("query"):
        query = localizer.extract_query(frame)
    with watch.of("register, judge, bound"):
        localizer.localize(frame, query, bundle.anchors)
