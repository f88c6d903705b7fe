"""Features ahead: what is prepared, when, and that no frame grows old in between."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from localizer.config import LocalizerConfig
from localizer.errors import (
    MapCacheError,
    MapLoadingError,
    ModelError,
    OutsideMapError,
    RenderError,
)
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.registration.config import JNGOConfig
from localizer.render import select
from localizer.tracking.engine_health import HealthCounters
from localizer.tracking.mailbox import FeaturePrefetcher, Mailbox, ProcessingTimes
from localizer.tracking.opening import MapStack, build_localizer
from localizer.tracking.pipeline import Localizer
from localizer.types import FeaturePyramid, Frame, PosePrior

CAMERA = Camera.from_fov(64, 48, 60.0)
AT_ONCE = 0.0


def _frame(sequence: int) -> Frame:
    return Frame(np.zeros((48, 64, 3), np.uint8), sequence, CAMERA, sequence)


class Extraction:
    """Counts the frames whose features were asked for; or fails."""

    def __init__(self) -> None:
        self.of: list[int] = []
        self.fails = False

    def __call__(self, frame: Frame) -> FeaturePyramid:
        self.of.append(frame.sequence)
        if self.fails:
            raise ValueError("no picture")
        return FeaturePyramid((), 64, 48)


@pytest.fixture
def extraction() -> Extraction:
    return Extraction()


def test_the_next_frame_is_prepared_while_the_one_before_is_worked_on(extraction):
    stage = FeaturePrefetcher(extraction, lambda: True)
    stage.put(_frame(0))
    stage.prepare(AT_ONCE)
    taken = stage.take(AT_ONCE)
    assert taken.features is not None
    stage.put(_frame(1))
    stage.prepare(AT_ONCE)  # the taker has not come back yet
    assert extraction.of == [0, 1]
    assert stage.take(AT_ONCE).frame.sequence == 1


def test_one_is_prepared_at_most_and_the_newest_waits_in_front(extraction):
    """What is extracted is used: frames that come meanwhile displace each other in front."""
    stage = FeaturePrefetcher(extraction, lambda: True)
    for sequence in range(5):
        stage.put(_frame(sequence))
        stage.prepare(AT_ONCE)
    assert extraction.of == [0]
    assert stage.dropped == 3
    assert stage.take(AT_ONCE).frame.sequence == 0
    stage.prepare(AT_ONCE)
    assert extraction.of == [0, 4]


def test_a_slow_taker_finds_a_frame_that_is_new():
    """Registrations of 100 ms and extractions of 20: the next begins 80 ms into the registration,
    with the newest frame of that time. Where extraction is what takes long it begins at once.
    """
    pace = ProcessingTimes()
    for _ in range(40):
        pace.add_extraction(0.02)
        pace.add_registration(0.1)
    assert pace.pause_s(0.0) == pytest.approx(0.08, abs=1e-3)
    assert pace.pause_s(0.05) == pytest.approx(0.03, abs=1e-3)
    assert pace.pause_s(0.5) == 0.0
    for _ in range(40):
        pace.add_registration(0.013)
    assert pace.pause_s(0.0) == 0.0


def test_where_nothing_may_be_extracted_ahead_frames_come_without(extraction):
    stage = FeaturePrefetcher(extraction, lambda: False)
    stage.put(_frame(0))
    stage.prepare(AT_ONCE)
    assert stage.take(AT_ONCE) is None  # the taker was not waiting: a newer frame may yet come
    stage.put(_frame(1))
    stage.prepare(AT_ONCE)
    taken = stage.take(AT_ONCE)
    assert (taken.frame.sequence, taken.features) == (1, None)
    assert extraction.of == []


def test_an_extraction_that_fails_is_left_to_the_taker(extraction):
    extraction.fails = True
    stage = FeaturePrefetcher(extraction, lambda: True)
    stage.put(_frame(0))
    stage.prepare(AT_ONCE)
    taken = stage.take(AT_ONCE)
    assert (taken.frame.sequence, taken.features) == (0, None)
    stage.put(_frame(1))
    stage.prepare(AT_ONCE)
    assert stage.take(AT_ONCE).frame.sequence == 1


def test_closing_wakes_both_sides(extraction):
    stage = FeaturePrefetcher(extraction, lambda: True)
    threads = [
        threading.Thread(target=stage.take, args=(60.0,)),
        threading.Thread(target=stage.prepare, args=(60.0,)),
    ]
    for thread in threads:
        thread.start()
    stage.close()
    for thread in threads:
        thread.join(30.0)
        assert not thread.is_alive()


# --- A view of which nothing is in memory yet is no view off the map ----------------------------


def test_a_map_that_is_being_loaded_is_told_as_that() -> None:
    """Each start warned that the view does not meet the map."""
    camera = Camera.from_fov(320, 240, 60)
    empty: Any = SimpleNamespace(depth=np.zeros((240, 320), np.float32))
    renderer: Any = SimpleNamespace(render=lambda *_, **__: empty)
    optimizer: Any = SimpleNamespace(on_gpu=True)
    loading = [True]
    localizer = Localizer(
        renderer, None, optimizer, camera, LocalizerConfig(odometry=None),  # type: ignore[arg-type]
        is_loading=lambda: loading[0],
    )  # fmt: skip
    prior = PosePrior.around(Pose.identity())
    with pytest.raises(MapLoadingError, match="is being loaded"):
        localizer.make_reference(prior)
    loading[0] = False
    with pytest.raises(OutsideMapError, match="does not meet the map"):
        localizer.make_reference(prior)


@pytest.mark.parametrize("error", [MapLoadingError, OutsideMapError])
def test_a_view_without_map_is_no_failure_and_any_other_error_is(error):
    """On the ground the near surfaces are cut off; the ground station was advised to land."""
    book = HealthCounters("", "")
    book.report(error("nothing in view"))
    assert book.read(0, "").no_map_in_view
    book.report(MapCacheError("gone"))
    assert not book.read(0, "").no_map_in_view


def test_another_kind_of_error_is_logged_at_once(caplog):
    """The log that an alert referred to had the error of 3 s before only."""
    book = HealthCounters("", "")
    for error in (MapLoadingError("loading"), MapLoadingError("still"), MapCacheError("gone")):
        book.report(error)
    assert [r.message for r in caplog.records] == ["loading", "gone"]


# --- mailbox ------------------------------------------------------------------------------------


def test_newest_wins_and_drops_are_counted():
    box: Mailbox[int] = Mailbox()
    for item in (1, 2, 3):
        box.put(item)
    assert box.take() == 3
    assert box.dropped == 2
    assert box.take(timeout_s=0.01) is None


def test_close_wakes_a_waiting_reader():
    box: Mailbox[int] = Mailbox()
    got = []
    reader = threading.Thread(target=lambda: got.append(box.take()))
    reader.start()
    box.close()
    reader.join(timeout=60)
    assert got == [None]


def test_the_producers_failure_reaches_the_consumer_over_an_item_that_waits():
    box: Mailbox[int] = Mailbox()
    assert box.put(1)
    box.close(ValueError("the stream broke"))
    box.close(RuntimeError("later"))
    with pytest.raises(ValueError, match="the stream broke"):
        box.take()
    assert not box.put(2)
    assert box.dropped == 0


# --- The parts that `run` and `eval` share, from a configuration --------------------------------


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
