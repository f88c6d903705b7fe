"""From a configuration to the localizer's parts: shared by ``run`` and ``eval``."""

from __future__ import annotations

from pathlib import Path

from localizer.camera import Camera
from localizer.config import LocalizerConfig
from localizer.features.extractor import load_extractor
from localizer.map.cache import TileCache
from localizer.map.stream import TileStreamer
from localizer.pipeline import Localizer, RotationAt
from localizer.registration.jngo import JNGO
from localizer.render.numba_raster import NumbaRenderer


class MapStack:
    """An open tile cache with its streamer and renderer; close it when done."""

    def __init__(self, path: Path, config: LocalizerConfig) -> None:
        self.cache = TileCache.open(path)
        self.streamer = TileStreamer(self.cache, byte_budget=config.cache_mib * 2**20)
        self.renderer = NumbaRenderer(self.streamer, threads=config.threads)

    def close(self) -> None:
        """Stop the loader thread."""
        self.streamer.close()


def build_localizer(
    stack: MapStack,
    camera: Camera,
    config: LocalizerConfig,
    rotation_at: RotationAt = lambda _time_ns: None,
) -> Localizer:
    """A localizer for one camera over an open map. rotation_at: see `Localizer`."""
    extractor = load_extractor(config.model, threads=config.feature_threads)
    optimizer = JNGO(config.registration, threads=config.threads)
    return Localizer(stack.renderer, extractor, optimizer, camera, config, rotation_at)
