"""The parts that `run` and `eval` share, from a configuration."""

import threading

import pytest

from companion.build import MapStack
from localizer.config import LocalizerConfig
from localizer.errors import RenderError
from localizer.render import select


def test_the_configured_renderer_serves(small_assets):
    stack = MapStack(small_assets.map_cache, LocalizerConfig(renderer="numba", threads=1))
    assert stack.renderer.name == "numba (CPU, 1 threads)"
    stack.close()


def test_opengl_serves_where_it_is_asked_for(small_assets):
    try:
        stack = MapStack(small_assets.map_cache, LocalizerConfig(renderer="moderngl"))
    except RenderError as error:
        pytest.skip(str(error))
    stack.renderer.warm_up()
    assert stack.renderer.name.startswith("moderngl (")
    stack.close()


def test_a_renderer_that_is_not_there_is_named_and_leaves_no_thread(small_assets, monkeypatch):
    def missing(*_args, **_options):
        raise RenderError("moderngl is not installed")

    monkeypatch.setattr(select, "make_renderer", missing)
    before = threading.active_count()
    with pytest.raises(RenderError, match="not installed"):
        MapStack(small_assets.map_cache, LocalizerConfig(renderer="moderngl"))
    assert threading.active_count() == before
