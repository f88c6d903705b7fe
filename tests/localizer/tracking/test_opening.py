"""The parts that `run` and `eval` share, from a configuration."""

import threading

import pytest

from localizer.config import LocalizerConfig
from localizer.errors import ModelError, RenderError
from localizer.geometry.camera import Camera
from localizer.registration.config import JNGOConfig
from localizer.render import select
from localizer.tracking.opening import MapStack, build_localizer


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


@pytest.mark.parametrize("iterations", [(4, 4), (4, 4, 4, 4)])
def test_a_model_of_another_number_of_levels_ends_the_start(small_assets, iterations):
    registration = JNGOConfig(iterations=iterations)
    config = LocalizerConfig(renderer="numba", threads=1, registration=registration)
    stack = MapStack(small_assets.map_cache, config)
    with pytest.raises(ModelError, match="the model has 3 levels"):
        build_localizer(stack, Camera(64, 48, 60.0, 60.0, 32.0, 24.0), config)
    stack.close()
