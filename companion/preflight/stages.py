"""Time of each stage of a frame where nothing runs beside it."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from companion.integrity_monitor.video import FrozenVideoDetector
from localizer.config import LocalizerConfig
from localizer.features.detail import DetailExtractor
from localizer.features.extractor import FeatureExtractor
from localizer.registration.jngo import JNGO
from localizer.render.base import MapRenderer
from localizer.tracking.opening import MapStack
from localizer.tracking.pipeline import Localizer
from localizer.types import FeaturePyramid, Frame, Image, PosePrior, RenderedView

PASSES = 3  # over the first frame
STAGES = (
    "video check", "undistort and shrink", "features of the frame", "render", "anchors and holes",
    "features of the reference", "register, judge, bound", "odometry, off the map",
    "encode a recorded image",
)  # fmt: skip
_WARM = 5  # frames that are not counted
_SNAPSHOTS = 10


@dataclass(frozen=True)
class StageTime:
    """Mean time of a stage at a working width. cpu_ms: of the processor, all threads."""

    width: int
    stage: str
    cpu_ms: float
    wall_ms: float


class _Watch:
    """Milliseconds by stage: processor time on all threads (OpenVINO has its own), and time."""

    def __init__(self) -> None:
        self.spent: dict[str, list[tuple[float, float]]] = {}

    @contextmanager
    def of(self, stage: str) -> Iterator[None]:
        """Adds what is spent inside."""
        cpu, wall = time.process_time(), time.perf_counter()
        try:
            yield
        finally:
            ms = 1e3 * (time.process_time() - cpu), 1e3 * (time.perf_counter() - wall)
            self.spent.setdefault(stage, []).append(ms)


class _Renderer(MapRenderer):
    def __init__(self, base: MapRenderer, watch: _Watch) -> None:
        super().__init__(base.streamer)
        self._base, self._watch, self.name = base, watch, base.name

    def render(self, *args: Any, **named: Any) -> RenderedView:
        with self._watch.of("render"):
            return self._base.render(*args, **named)

    def draw(self, *args: Any) -> RenderedView:
        return self._base.draw(*args)

    def close(self) -> None:
        self._base.close()


class _Extractor:
    """Counts an extraction under the half of the pipeline that asks for it."""

    def __init__(self, base: FeatureExtractor, watch: _Watch) -> None:
        self._base, self._watch, self.name = DetailExtractor(base), watch, base.name
        self.stage = "features of the reference"

    def extract(self, rgb: Image) -> FeaturePyramid:
        with self._watch.of(self.stage):
            return self._base.extract(rgb)


def stage_times(
    stack: MapStack, frames: Sequence[Frame], start: PosePrior, config: LocalizerConfig,
    extractor: FeatureExtractor,
) -> list[StageTime]:  # fmt: skip
    """The stages over an open map, from `start` at the first frame on; every frame gets a reference
    of its own. The odometry runs over the last third, without a map.
    """
    watch = _Watch()
    features = _Extractor(extractor, watch)
    localizer = Localizer(
        _Renderer(stack.renderer, watch), features,
        JNGO(config.registration, threads=config.threads), frames[0].camera, config,
        map_frame=stack.cache.frame,
    )  # fmt: skip
    localizer.set_prior(start)
    localizer.track(frames[0], passes=PASSES)
    video = FrozenVideoDetector()
    for k, frame in enumerate(frames[1:], 1):
        if k == _WARM:
            watch.spent.clear()
        with watch.of("video check"):
            video.add(frame.exposure_time_ns, frame.image)
        prior = localizer.predict(frame.exposure_time_ns)
        assert prior is not None, "the first frame began"
        anchors = None
        if k < 2 * len(frames) // 3:
            features.stage = "features of the reference"
            with watch.of("reference"):
                anchors = localizer.make_reference(prior, wait=True).anchors
        features.stage = "features of the frame"
        with watch.of("query"):
            query = localizer.extract_query(frame)
        with watch.of("odometry, off the map" if anchors is None else "register, judge, bound"):
            localizer.localize(frame, query, anchors)
    for frame in frames[:_SNAPSHOTS]:
        with watch.of("encode a recorded image"):
            cv2.imencode(".jpg", cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR))
    mean = {stage: np.mean(ms, axis=0) for stage, ms in watch.spent.items()}
    render, reference = mean["render"], mean["features of the reference"]
    mean["anchors and holes"] = mean.pop("reference") - render - reference
    mean["undistort and shrink"] = mean.pop("query") - mean["features of the frame"]
    return [StageTime(config.width, stage, *mean[stage].round(2).tolist()) for stage in STAGES]
