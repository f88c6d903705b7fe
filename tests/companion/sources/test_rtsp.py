"""An RTSP camera: a small server of the test's own, RTP interleaved in the control connection."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from companion.sources import SourceSettings, StreamState, open_source
from tests.companion.sources.rtsp_camera import CAMERA, RATE_HZ, STEP, RtspCamera


def test_a_camera_that_refuses_tcp_is_received_by_udp() -> None:
    server = RtspCamera(by_udp=True)
    source = open_source(server.url, CAMERA)
    levels = [
        STEP * round(float(f.image[140:].mean()) / STEP)
        for f, _ in zip(source.frames(), "abc", strict=False)
    ]
    source.close()
    server.close()
    assert set(levels) <= set(server.sent)


def test_an_rtsp_camera_is_received_and_taken_up_again_when_it_hangs_up(real_time: Any) -> None:
    with real_time():
        server = RtspCamera()
        states: list[StreamState] = []
        # FFmpeg makes pictures of RTP packets, and sees a picture's end in the next one's start.
        period_ms = 1000 / RATE_HZ
        settings = SourceSettings(stall_timeout_s=1.0, latency_ms=period_ms)
        source = open_source(server.url, CAMERA, settings, lambda s, _: states.append(s))
        errors, latencies, ends_s = [], [], time.monotonic() + 120.0
        for count, frame in enumerate(source.frames()):
            sent = server.sent[STEP * round(float(frame.image[140:].mean()) / STEP)]
            errors.append((frame.exposure_time_ns - sent) / 1e6)
            latencies.append((time.monotonic_ns() - sent) / 1e6)
            if count == 15:
                server.hang_up()
            if count == 30:
                break
            assert time.monotonic() < ends_s, states
        source.close()
        server.close()
        print(f"\nRTSP: latency median {np.median(latencies):.1f} ms, exposure error "
              f"{np.median(errors):.1f} ms")  # fmt: skip
        assert source.counters.reconnects >= 1
        assert states.count(StreamState.LIVE) >= 2
        assert StreamState.STALLED in states
        # Half a period of room: a second picture held back would add a whole one.
        assert np.median(latencies) < 1.5 * period_ms
        assert abs(np.median(errors)) < 0.25 * period_ms
