"""Opens a localizer for a map, a camera and a configuration: builds and warms up its parts."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from localizer.config import LocalizerConfig
from localizer.errors import ModelError
from localizer.features.detail import DetailExtractor
from localizer.features.extractor import FeatureExtractor, load_extractor
from localizer.geometry.camera import Camera
from localizer.integrity.probability import place_model
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.map.inspection.kind import map_kind
from localizer.map.terrain import ground_uncertainty, open_terrain
from localizer.registration.devices import open_backend
from localizer.registration.jngo import JNGO
from localizer.render.base import MapRenderer
from localizer.render.select import open_renderer
from localizer.tracking.motion import AuxiliarySensors
from localizer.tracking.pipeline import Localizer, working_camera


class MapStack:
    """An open tile cache with its streamer and renderer; close it when done."""

    def __init__(self, path: Path, config: LocalizerConfig) -> None:
        self.cache = TileCache.open(path)
        self.streamer = TileStreamer(self.cache, byte_budget=config.cache_mib * 2**20)
        try:
            self.renderer = open_renderer(config.renderer, self.streamer, threads=config.threads)
        except BaseException:
            self.streamer.close()
            raise

    def close(self) -> None:
        """Release the renderer and stop the loader thread."""
        self.renderer.close()
        self.streamer.close()


def open_localizer(
    map_cache: Path | str,
    camera: Camera,
    config: LocalizerConfig | None = None,
    sensors: AuxiliarySensors | None = None,
) -> Localizer:
    """A localizer for one camera over a tile cache. Close it, or use it in a ``with``.

    map_cache: folder made by `build_cache` (``companion map build``). camera: of the frames as they
    arrive, with distortion. config: every setting has a default. sensors: see `Localizer`. The
    first call on a machine compiles for a minute. Any thread may use it, one at a time. Raises
    `LocalizerError`, such as `MapCacheError`.
    """
    config = config or LocalizerConfig()
    stack = MapStack(Path(map_cache), config)
    try:
        return build_localizer(stack, camera, config, sensors, on_close=stack.close)
    except BaseException:
        stack.close()
        raise


def build_localizer(
    stack: MapStack,
    camera: Camera,
    config: LocalizerConfig,
    sensors: AuxiliarySensors | None = None,
    *,
    on_close: Callable[[], None] = lambda: None,
) -> Localizer:
    """A localizer for one camera over an open map. The caller closes the map, after the localizer,
    unless on_close does. sensors, on_close: see `Localizer`.
    """
    size = working_camera(camera, config.width)
    features = load_extractor(
        config.model,
        threads=config.feature_threads or max(1, config.threads // 2),
        size=(size.width, size.height),
        half=config.feature_half,
    )
    extractor = DetailExtractor(features)
    optimizer = JNGO(
        config.registration, open_backend(config.device, config.threads), config.threads
    )
    terrain = None
    if config.terrain is not None and config.odometry is not None:
        terrain = open_terrain(config.terrain, stack.cache.frame)
    kind = map_kind(stack.cache)
    _warm_up(stack.renderer, extractor, optimizer, camera, config)
    return Localizer(
        stack.renderer, extractor, optimizer, camera, config, sensors,
        map_frame=stack.cache.frame, map_kind=kind, terrain=terrain,
        ground=ground_uncertainty(stack.cache.index, kind),
        on_close=on_close, is_loading=lambda: stack.streamer.lacks_tiles,
    )  # fmt: skip


def _warm_up(
    renderer: MapRenderer,
    extractor: FeatureExtractor,
    optimizer: JNGO,
    camera: Camera,
    config: LocalizerConfig,
) -> None:
    """Compile and load everything now; the first frame in flight must not wait ten seconds."""
    place_model()
    size = working_camera(camera, config.width)
    black = np.zeros((size.height, size.width, 3), np.uint8)
    pyramid = extractor.extract(black)
    given, wanted = len(pyramid.levels) - 1, len(config.registration.iterations)
    if given != wanted:  # every frame would be refused, or the detail taken for the finest level
        raise ModelError(
            f"{extractor.name}: the model has {given} levels of features, "
            f"localizer.registration.iterations {config.registration.iterations} need {wanted}"
        )
    for channels in {level.features.shape[-1] for level in pyramid.levels}:
        optimizer.warm_up(channels)
    renderer.warm_up()
