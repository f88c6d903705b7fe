"""Choosing a renderer backend."""

from __future__ import annotations

import logging
from typing import Literal

from localizer.errors import RenderError
from localizer.render.base import SKY, MapRenderer, TileProvider
from localizer.render.numba_raster import NumbaRenderer

Backend = Literal["auto", "numba", "moderngl", "pyrender"]

_log = logging.getLogger(__name__)


def make_renderer(
    backend: Backend,
    streamer: TileProvider,
    *,
    threads: int = 2,
    sky: tuple[int, int, int] = SKY,
) -> MapRenderer:
    """A renderer, to be made and used by one thread.

    auto: OpenGL where a GPU drives it, else numba (a software OpenGL is slower than numba).
    Raises `RenderError` when the asked backend is not available.
    """
    if backend == "numba":
        return NumbaRenderer(streamer, threads, sky)
    if backend == "pyrender":
        try:
            from localizer.render.pyrender_offscreen import PyrenderRenderer
        except ImportError as error:
            raise RenderError(f"pyrender is not installed (extra `pyrender`): {error}") from error
        return PyrenderRenderer(streamer, sky)
    try:
        from localizer.render.moderngl_egl import ModernGLRenderer

        renderer = ModernGLRenderer(streamer, sky)
    except ImportError as error:
        if backend == "moderngl":
            raise RenderError(f"moderngl is not installed (extra `gpu`): {error}") from error
    except RenderError as error:
        if backend == "moderngl":
            raise
        _log.info("no GPU renderer: %s", error)
    else:
        if backend == "moderngl" or not renderer.is_software:
            return renderer
        renderer.close()
    return NumbaRenderer(streamer, threads, sky)
