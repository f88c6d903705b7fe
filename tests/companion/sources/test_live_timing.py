"""UDP loopback: when a picture of a real sender's stream was exposed, and how old it comes out."""

from __future__ import annotations

import time

import numpy as np
import pytest

from companion.sources import open_source
from tests.companion.sources.paced_sender import CAMERA, PacedSender, Watch, free_port, read_counter


@pytest.fixture
def url() -> str:
    return f"udp://127.0.0.1:{free_port()}"


def _compare(watch: Watch, sender: PacedSender, skip: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """(error of the exposure time, glass-to-glass latency) per frame, ms."""
    rows = []
    for frame, seen_ns in watch.frames[skip:]:
        true_ns = sender.exposed[read_counter(frame.image)]
        rows.append(((frame.exposure_time_ns - true_ns) / 1e6, (seen_ns - true_ns) / 1e6))
    error, latency = np.array(rows).T
    return error, latency


def test_exposure_times_by_misp_stamps_are_exact_and_latency_is_low(real_time, url):
    with real_time():
        with Watch(url) as watch, PacedSender(url, rate_hz=10.0, delay_s=0.02) as sender:
            watch.wait_for(25)
        error, latency = _compare(watch, sender)
        print(
            f"\nglass to glass, ms: median {np.median(latency):.1f}"
            f" p95 {np.percentile(latency, 95):.1f} (20 of them the sender's own);"
            f" exposure error max {np.abs(error).max():.4f}"
        )
        assert np.abs(error).max() < 0.1
        # One period is 100 ms: a receiver that held pictures back until the next one fails here.
        assert np.median(latency) < 20 + 80
    counters = watch.source.counters
    assert counters.delivered == len(watch.frames)
    assert counters.received - counters.delivered - counters.dropped in (0, 1)
    sequences = [f.sequence for f, _ in watch.frames]
    assert sequences == sorted(set(sequences))


def test_exposure_times_by_presentation_times_need_the_fixed_latency_only(real_time, url):
    delay = 0.03
    with real_time():
        with (
            Watch(url, timing="pts", latency_ms=1000 * delay + 20, time_offset_ms=-20) as watch,
            PacedSender(url, misp=False, delay_s=delay) as sender,
        ):
            watch.wait_for(40)
        # The smallest lag takes some frames to find: the first came in a burst after the probing.
        error, _ = _compare(watch, sender, skip=25)
        print(f"\nexposure error by pts, ms: {error.min():.2f} to {error.max():.2f}")
        assert error.min() > -1.0
        assert error.max() < 5.0
    times = [f.exposure_time_ns for f, _ in watch.frames]
    assert times == sorted(times)


def test_a_consumer_that_is_slow_gets_the_newest_frame_and_the_rest_are_counted(real_time, url):
    with real_time():
        with PacedSender(url, rate_hz=30.0):
            source = open_source(url, CAMERA)
            ages = []
            for _, frame in zip(range(6), source.frames(), strict=False):
                ages.append((time.monotonic_ns() - frame.exposure_time_ns) / 1e6)
                time.sleep(0.25)
            counters = source.counters
            source.close()
        assert np.median(ages[1:]) < 200  # a queue would make them grow by 200 ms a frame
        assert counters.dropped > counters.received / 2
    assert counters.delivered == 6
