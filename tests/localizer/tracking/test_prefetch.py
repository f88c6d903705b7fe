"""Features ahead: what is prepared, when, and that no frame grows old in between."""

import threading

import numpy as np
import pytest

from localizer.geometry.camera import Camera
from localizer.tracking.prefetch import FeaturePrefetcher, ProcessingTimes
from localizer.types import FeaturePyramid, Frame

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
    assert taken is not None
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
