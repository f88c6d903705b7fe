"""Selects a renderer, and runs OpenGL on one thread."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Literal

from localizer.errors import RenderError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.map.cache.tile import TileMesh
from localizer.render.base import MapRenderer, TileProvider
from localizer.render.numba_raster import NumbaRenderer
from localizer.types import RenderedView

RendererName = Literal["auto", "numba", "moderngl", "pyrender"]

_log = logging.getLogger(__name__)


def open_renderer(
    backend: RendererName, streamer: TileProvider, *, threads: int = 2
) -> MapRenderer:
    """A renderer that any thread may use, one at a time; see `make_renderer`.

    An OpenGL context belongs to the thread that made it. So an OpenGL renderer has a thread of its
    own, which makes it, draws with it and releases it.
    """
    owner = ThreadPoolExecutor(1, "opengl")
    try:
        renderer = owner.submit(make_renderer, backend, streamer, threads=threads).result()
    except BaseException:
        owner.shutdown()
        raise
    if isinstance(renderer, NumbaRenderer):
        owner.shutdown()
        return renderer
    return _OwnedRenderer(renderer, owner)


def make_renderer(
    backend: RendererName,
    streamer: TileProvider,
    *,
    threads: int = 2,
) -> MapRenderer:
    """A renderer that one thread makes and uses.

    auto: OpenGL if a GPU runs it, else numba, because a software OpenGL is slower than numba.
    Raises `RenderError` if the asked backend is not available.
    """
    if backend == "numba":
        return NumbaRenderer(streamer, threads)
    if backend == "pyrender":
        try:
            from localizer.render.pyrender_offscreen import PyrenderRenderer
        except ImportError as error:
            raise RenderError(f"pyrender is not installed (extra `pyrender`): {error}") from error
        return PyrenderRenderer(streamer)
    try:
        from localizer.render.moderngl_egl import ModernGLRenderer

        renderer = ModernGLRenderer(streamer)
    except ImportError as error:
        if backend == "moderngl":
            raise RenderError(f"moderngl is not installed (extra `gpu`): {error}") from error
        _log.info("no GPU renderer: moderngl is not installed (extra `gpu`)")
    except RenderError as error:
        if backend == "moderngl":
            raise
        _log.info("no GPU renderer: %s", error)
    else:
        if backend == "moderngl" or not renderer.is_software:
            return renderer
        _log.info("no GPU renderer: OpenGL runs on the CPU here (%s)", renderer.device)
        renderer.close()
    return NumbaRenderer(streamer, threads)


class _OwnedRenderer(MapRenderer):
    """A renderer on its own thread; callers wait for that thread."""

    def __init__(self, renderer: MapRenderer, owner: ThreadPoolExecutor) -> None:
        super().__init__(renderer.streamer)
        self.name = renderer.name
        self._renderer = renderer
        self._owner = owner

    def draw(
        self, meshes: Sequence[TileMesh], world_from_camera: Pose, camera: Camera
    ) -> RenderedView:
        """See `MapRenderer.draw`."""
        return self._owner.submit(self._renderer.draw, meshes, world_from_camera, camera).result()

    def close(self) -> None:
        """Release the context on its thread, and end the thread."""
        self._owner.submit(self._renderer.close).result()
        self._owner.shutdown()
